"""Masks as targets, numbered through all views, with 2D features where there are any."""

import hashlib
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Int64
from torch import Tensor

from splatseg.core import FeatureSource, MaskSet, View
from splatseg.errors import ShapeError
from splatseg.lift.training import MaskSets, MaskTargets, PixelChoice, Ragged, Target, Targets
from splatseg.lift.voting.features import read_features_at
from splatseg.lift.voting.uplift import voting_views


class KeptMasks:
    """Masks that are read once, as run lengths: a few MB for a hundred views.

    Args:
        evidence: Where they are read.
    """

    def __init__(self, evidence: MaskSets) -> None:
        self._evidence = evidence
        self._kept: dict[str, MaskSet] = {}

    @property
    def view_names(self) -> Sequence[str]:
        """Views that have masks."""
        return self._evidence.view_names

    def masks(self, name: str) -> MaskSet:
        """The masks of a view."""
        if name not in self._kept:
            self._kept[name] = self._evidence.masks(name)
        return self._kept[name]


class SagaTargets:
    """The masks that contain a pixel, and what 2D features say there.

    Targets: ``masks``, the numbers of these masks, see `MaskTable`; and ``guidance``, the 2D
    features, where there are any.

    Groups are the masks and, as one more, the pixels outside all masks: what is no thing is to be
    unlike things, too.

    Args:
        evidence: The masks.
        views: The views to learn from, in the order of their names.
        first: The number of each view's first mask.
        features: 2D features of the same views.
        grid: Cells a side of the grid that views are learnt on: a cell has the masks of the pixel
            in its middle, and the features of its centre. 0 learns from the pixels of the masks.

    Raises:
        InputError: If these views have no mask with a pixel, or one has no features.
        ShapeError: If the widths of features differ between views.
    """

    def __init__(
        self,
        evidence: MaskSets,
        views: Sequence[View],
        first: Mapping[str, int],
        features: FeatureSource | None = None,
        *,
        grid: int = 0,
    ) -> None:
        self._grid = grid
        self._masks = MaskTargets(evidence, [view.name for view in views])
        self._views = {view.name: view for view in views}
        self._first = first
        self._features = features
        self._channels = 0
        digest = hashlib.sha256(self._masks.fingerprint.encode())
        if features is not None:
            for view in voting_views(views, features, "2D features"):
                found = features.features(view.name)
                self._channels = self._channels or found.channels
                if found.channels != self._channels:
                    raise ShapeError(
                        f"guidance: expected {self._channels} channels of view {view.name}, as of "
                        f"view {views[0].name}, got {found.channels}."
                    )
                digest.update(repr((view.name, found.stride, found.height, found.width)).encode())
                digest.update(found.features.float().cpu().numpy().tobytes())
        self._fingerprint = digest.hexdigest()

    @property
    def channels(self) -> int:
        """Width of the 2D features, 0 without."""
        return self._channels

    @property
    def view_names(self) -> Sequence[str]:
        """The views to learn from."""
        return self._masks.view_names

    @property
    def fingerprint(self) -> str:
        """A digest of all masks and features."""
        return self._fingerprint

    def choice(self, name: str) -> PixelChoice:
        """All pixels, or all cells of the grid."""
        if not self._grid:
            return self._masks.choice(name)
        cells = torch.arange(self._grid**2)
        return PixelChoice(height=self._grid, width=self._grid, pixels=cells, grid=True)

    def groups(self, name: str) -> Ragged:
        """Pixels by mask, and those outside all masks."""
        inside = self._masks.groups(name)
        choice = self._masks.choice(name)
        outside = torch.ones(choice.height * choice.width, dtype=torch.bool)
        outside[inside.values] = False
        rest = torch.nonzero(outside).squeeze(1)
        if not len(rest):
            return inside
        return Ragged.concatenate([inside, Ragged.of([rest])])

    def targets(self, name: str, pixels: Int64[Tensor, "p"]) -> Targets:
        """``masks`` of some pixels, and their ``guidance``."""
        choice = self.choice(name)
        local = self._masks.targets(name, self._read_at(name, pixels))["masks"]
        if not isinstance(local, Ragged):
            raise TypeError("masks: expected any number of them a pixel.")
        found: dict[str, Target] = {
            "masks": Ragged(starts=local.starts, values=local.values + self._first[name])
        }
        if self._features is not None:
            found["guidance"] = read_features_at(
                self._views[name],
                self._features.features(name),
                size=(choice.height, choice.width),
                pixels=pixels,
            ).half()
        return found

    def _read_at(self, name: str, cells: Int64[Tensor, "p"]) -> Int64[Tensor, "p"]:
        """The pixels of the masks that cells have: those in the middle; of pixels themselves."""
        if not self._grid:
            return cells
        whole = self._masks.choice(name)
        row = (2 * (cells // self._grid) + 1) * whole.height // (2 * self._grid)
        column = (2 * (cells % self._grid) + 1) * whole.width // (2 * self._grid)
        return row * whole.width + column
