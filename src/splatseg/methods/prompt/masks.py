r"""The masks of the initial views: what each shows, and which are masks of one thing.

Masks of two views are of one thing if they hold the same Gaussians. With :math:`m_{ki}` the
blending weight of Gaussian i summed over the pixels of mask k of view u, and :math:`v_{ui}` that
over all of its pixels,

.. math:: I_{kl} = \sum_i \sqrt{m_{ki} m_{li}}, \qquad
          S_{k|v} = \sum_i \sqrt{m_{ki} v_{vi}}, \qquad
          \mathrm{IoU}(k, l) = \frac{I_{kl}}{S_{k|v} + S_{l|u} - I_{kl}}

for mask l of view v: what only one of the views sees counts for neither.

Features of masks are solved for together over the cells of all initial views, with the masks
painted over each other, the smallest last (`methods.objects`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import (
    FeatureMap,
    FeatureSource,
    Gaussians,
    MaskSet,
    Prompt,
    PromptableMasks,
    Rle,
    View,
)
from splatseg.core.models import Image
from splatseg.errors import InputError, ShapeError
from splatseg.io.evidence import Evidence
from splatseg.lift.phrases import ThingLooks, thing_looks
from splatseg.lift.voting.features import checked_grid
from splatseg.lift.voting.segment_masses import ViewMasses, view_masses
from splatseg.methods.objects import MixingModel
from splatseg.render import prepare

_MIN_PIXELS = 16
"""Masks with fewer are no candidates."""

_MOSTLY = 0.5
"""Share of what a view sees of a Gaussian from which on it is of a mask."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MaskTable:
    """All masks of some views, one row each."""

    views: tuple[View, ...]
    masks: tuple[MaskSet, ...]
    """Of each view."""

    view: Int64[Tensor, "m"]
    """Index of the view of each row."""

    index: Int64[Tensor, "m"]
    """Its index in the masks of the view."""

    values: Float[Tensor, "m channels"]
    """Its feature, in the channels of the feature maps."""

    cells: Float[Tensor, "m"]
    """How many cells it covers."""

    iou: Float[Tensor, "m m"]
    """On the Gaussians that both views see, float32; 0 where they see none in common."""

    contained: Float[Tensor, "m m"]
    """Share of what the row's mask holds of these Gaussians that the column's holds, too."""

    looks: ThingLooks | None
    """Colour and place of what each mask holds; None where nobody asks."""

    def __len__(self) -> int:
        return len(self.view)

    def rle(self, row: int) -> Rle:
        """The mask of a row."""
        return self.masks[int(self.view[row])].masks[int(self.index[row])]


def mask_table(
    gaussians: Gaussians,
    views: Sequence[View],
    features: FeatureSource,
    masks: Evidence,
    *,
    looks: bool = True,
    up: tuple[float, float, float] | None = None,
    backend: str = "auto",
) -> MaskTable:
    """The masks of some views.

    Args:
        gaussians: The Gaussians of the scene.
        views: The initial views.
        features: Their feature maps.
        masks: Their masks.
        looks: Whether colours and places are asked for: a tenth of the time.
        up: Where up is; None where nobody knows.
        backend: Name of the rendering backend.

    Raises:
        InputError: If a view has no masks or features, none of the views a mask, or a feature is
            not finite.
        ShapeError: If masks or features do not have the photograph's size.
    """
    for name, source in (("features", features), ("masks", masks)):
        lacking = [view.name for view in views if view.name not in source.view_names]
        if lacking:
            raise InputError(f"{name}: expected some of every initial view, {lacking[0]} has none.")
    sets = tuple(masks.masks(view.name) for view in views)
    held = [
        view_masses(gaussians, view.camera, found, backend=backend)
        for view, found in zip(views, sets, strict=True)
    ]
    rows = [
        (at, index)
        for at, found in enumerate(sets)
        for index, rle in enumerate(found.masks)
        if rle.area >= _MIN_PIXELS
    ]
    if not rows:
        raise InputError(
            f"masks: expected a mask in at least one of the {len(views)} initial views, got none."
        )
    view, index = torch.tensor(rows).unbind(dim=1)
    values, cells = _features(views, sets, features, rows)
    iou, contained = mask_overlaps(held, rows, len(gaussians))
    return MaskTable(
        views=tuple(views),
        masks=sets,
        view=view,
        index=index,
        values=values,
        cells=cells,
        iou=iou,
        contained=contained,
        looks=_looks(gaussians, held, rows, up) if looks else None,
    )


def _looks(
    gaussians: Gaussians,
    held: Sequence[ViewMasses],
    rows: Sequence[tuple[int, int]],
    up: tuple[float, float, float] | None,
) -> ThingLooks:
    """Of the Gaussians that masks hold for the most part."""
    parts: list[tuple[Tensor, Tensor, Tensor]] = []
    for at, found in enumerate(held):
        row_of = torch.full((int(found.segment.max()) + 1 if len(found.segment) else 0,), -1)
        for row, (view, index) in enumerate(rows):
            if view == at and index < len(row_of):
                row_of[index] = row
        row = row_of[found.segment]
        mostly = (row >= 0) & (found.weight >= _MOSTLY * found.visible[found.gaussian])
        parts.append((row[mostly], found.gaussian[mostly], found.weight[mostly]))
    things, of, weights = (torch.cat(columns) for columns in zip(*parts, strict=True))
    return thing_looks(gaussians, things, of, weights, count=len(rows), up=up)


def painted(masks: MaskSet) -> NDArray[np.int64]:
    """The smallest mask at each pixel (height, width), -1 where there is none."""
    found = np.full((masks.height, masks.width), -1, np.int64)
    areas = [mask.area for mask in masks.masks]
    for index in sorted(range(len(masks)), key=lambda one: (-areas[one], one)):
        found[masks.dense(index).numpy()] = index
    return found


def _features(
    views: Sequence[View],
    sets: Sequence[MaskSet],
    features: FeatureSource,
    rows: Sequence[tuple[int, int]],
) -> tuple[Tensor, Tensor]:
    """Feature of each mask: the mean over its pixels of those of the painted masks there."""
    starts = np.cumsum([0, *(len(one) for one in sets)])
    rest = int(starts[-1])
    maps = [painted(one) for one in sets]
    grids = [checked_grid(view, features.features(view.name)) for view in views]
    solved = _unmixed(grids, maps, starts, rest)
    values: list[Tensor] = []
    cells: list[float] = []
    for at, index in rows:
        inside = maps[at][sets[at].dense(index).numpy()]
        # A mask that is painted over at every pixel is of what lies over it.
        local, counts = np.unique(inside, return_counts=True)
        weights = counts / counts.sum()
        values.append(torch.from_numpy(weights @ solved[local + starts[at]]))
        cells.append(float(counts.sum()) / grids[at].stride ** 2)
    return torch.stack(values).float(), torch.tensor(cells, dtype=torch.float32)


def _unmixed(
    grids: Sequence[FeatureMap],
    maps: Sequence[NDArray[np.int64]],
    starts: NDArray[np.int64],
    rest: int,
) -> NDArray[np.float64]:
    """Features of all painted masks and, behind them, of what no mask has."""
    model = MixingModel(rest + 1, grids[0].channels)
    for at, (grid, found) in enumerate(zip(grids, maps, strict=True)):
        model.add(np.where(found < 0, rest, found + starts[at]), grid)
    return model.solved()[0]


def mask_overlaps(
    held: Sequence[ViewMasses], rows: Sequence[tuple[int, int]], gaussians: int
) -> tuple[Float[Tensor, "m m"], Float[Tensor, "m m"]]:
    """IoU and containment of all pairs of masks, see `MaskTable`.

    Args:
        held: The masses of the masks of each view.
        rows: View and mask of each row, by their indices; views ascend.
        gaussians: How many Gaussians there are.
    """
    import scipy.sparse

    roots: list[Any] = []
    visibility_of_masks: list[Any] = []
    for at, found in enumerate(held):
        own = np.array([index for view, index in rows if view == at], dtype=np.int64)
        segment, gaussian = found.segment.numpy(), found.gaussian.numpy()
        count = max(int(own.max(initial=-1)), int(segment.max(initial=-1))) + 1
        entries = (found.weight.double().sqrt().numpy(), (segment, gaussian))
        roots.append(scipy.sparse.csr_matrix(entries, shape=(count, gaussians))[own])
        visibility_of_masks.append(
            scipy.sparse.csr_matrix(found.visible.double().sqrt().numpy()[None])
        )
    masks: Any = scipy.sparse.vstack(roots, format="csr")
    shared = np.asarray((masks @ masks.T).todense())
    seen = np.asarray((masks @ scipy.sparse.vstack(visibility_of_masks, format="csr").T).todense())
    # Of each mask, what the view of each other mask sees.
    size = seen[:, [view for view, _ in rows]]
    iou = shared / np.maximum(size + size.T - shared, 1e-9)
    contained = shared / np.maximum(size, 1e-9)
    return torch.from_numpy(iou).float(), torch.from_numpy(contained).float()


_MOST = 0.5

_AT_ONCE = 32
"""Masks that are drawn at a time."""

_PER_FOLD = 0.1
"""What an area that is e times another counts, in shares of points."""

_SMALLER = 1e-9
"""What a pixel counts where no area is expected: it decides between equals alone."""


class PromptedMasks(Protocol):
    """Makes masks of points."""

    @property
    def calls(self) -> int:
        """How many masks were asked for so far."""
        ...

    def masks(
        self, view: View, prompts: Sequence[Prompt], areas: Sequence[float | None]
    ) -> list[Rle | None]:
        """The mask that each prompt means in a view; None where there is none.

        Args:
            view: The view.
            prompts: Points in it, or what is selected so far as a mask.
            areas: Pixels that each object covers there, about; None where nobody knows.
        """
        ...


class RecordedMasks:
    """Chooses among recorded masks the one that holds most points and fewest negative ones.

    It holds more than half of the positive points, and less than half of the negative ones. With
    the shares of positive points that it misses and of negative ones that it holds counts how far
    its area is from that of the initial masks, seen from the view's distance; without those, of
    equals the smaller is taken.

    Args:
        evidence: The masks of all views.
    """

    def __init__(self, evidence: Evidence) -> None:
        self._evidence = evidence
        self.calls = 0

    def masks(
        self, view: View, prompts: Sequence[Prompt], areas: Sequence[float | None]
    ) -> list[Rle | None]:
        """See `PromptedMasks`."""
        found = self._evidence.masks(view.name)
        if (found.height, found.width) != (view.camera.height, view.camera.width):
            raise ShapeError(
                f"masks: expected {view.camera.width}x{view.camera.height} pixels as view "
                f"{view.name} has, got {found.width}x{found.height}."
            )
        self.calls += len(prompts)
        if any(prompt.mask is not None for prompt in prompts):
            return _overlapping(found, prompts)
        return [
            self._chosen(found, prompt, area) for prompt, area in zip(prompts, areas, strict=True)
        ]

    @staticmethod
    def _chosen(masks: MaskSet, prompt: Prompt, area: float | None) -> Rle | None:
        inside = holds(masks, prompt.points)
        signs = prompt.signs
        missed = 1 - _share(inside, signs)
        wrong = _share(inside, ~signs)
        fitting = [
            (float(missed[i] + wrong[i]) + _unlike(masks.masks[i].area, area), i)
            for i in range(len(masks))
            if float(missed[i]) < _MOST and float(wrong[i]) < _MOST and masks.masks[i].area
        ]
        return masks.masks[min(fitting)[1]] if fitting else None


class ModelMasks:
    """Asks a promptable model, such as SAM, about the photograph of each view, or its render.

    Args:
        model: Who answers.
        gaussians: The Gaussians, to render views without a photograph.
        backend: Name of the rendering backend.
    """

    def __init__(
        self, model: PromptableMasks, gaussians: Gaussians, *, backend: str = "auto"
    ) -> None:
        self._model, self._gaussians, self._backend = model, gaussians, backend
        self.calls = 0

    def masks(
        self, view: View, prompts: Sequence[Prompt], areas: Sequence[float | None]
    ) -> list[Rle | None]:
        """See `PromptedMasks`. The image is encoded once; of several masks the best is taken."""
        if not prompts:
            return []
        embedding = self._model.embed(image_of(self._gaussians, view, self._backend))
        chosen: list[Rle | None] = []
        for prompt in prompts:
            self.calls += 1
            found = self._model.prompted_masks(embedding, prompt)
            size = (view.camera.height, view.camera.width)
            if len(found) and (found.height, found.width) != size:
                raise InputError(
                    f"prompter: expected masks of {size[1]}x{size[0]} pixels, "
                    f"got {found.width}x{found.height}."
                )
            chosen.append(found.masks[0] if len(found) else None)
        return chosen


def _overlapping(masks: MaskSet, prompts: Sequence[Prompt]) -> list[Rle | None]:
    """The mask with the best IoU with that of each prompt, at least one half."""
    shown = torch.stack([one.mask.reshape(-1) for one in prompts if one.mask is not None]).float()
    best = torch.zeros(len(shown))
    chosen: list[Rle | None] = [None] * len(shown)
    sizes = shown.sum(dim=1)
    for start in range(0, len(masks), _AT_ONCE):
        part = masks.masks[start : start + _AT_ONCE]
        inside = torch.stack([mask.decode().reshape(-1) for mask in part]).float()
        # Counts of pixels, which float32 adds up exactly.
        both = shown @ inside.T
        iou = both / (sizes[:, None] + inside.sum(dim=1) - both).clamp_min(1)
        value, index = iou.max(dim=1)
        for at in torch.nonzero((value > best) & (value >= _MOST)).squeeze(1).tolist():
            chosen[at] = part[int(index[at])]
        best = torch.maximum(best, value)
    return chosen


def _unlike(area: int, wanted: float | None) -> float:
    """How far an area is from the one that is expected; without one the smaller is better."""
    if wanted is None:
        return _SMALLER * area
    return _PER_FOLD * abs(math.log(area / max(wanted, 1.0)))


def holds(masks: MaskSet, points: Tensor) -> Bool[Tensor, "m p"]:
    """Which masks hold which points, found in their run lengths without drawing them."""
    column = points[:, 0].long().clamp(0, masks.width - 1)
    row = points[:, 1].long().clamp(0, masks.height - 1)
    place = (column * masks.height + row).numpy()
    found = [np.searchsorted(np.cumsum(one.counts), place, "right") % 2 == 1 for one in masks.masks]
    if not found:
        return torch.zeros(0, len(points), dtype=torch.bool)
    return torch.from_numpy(np.stack(found))


def _share(inside: Tensor, which: Tensor) -> Tensor:
    """Share of some points that each mask holds; 0 where there are no such points."""
    return inside[:, which].double().sum(dim=1) / max(int(which.sum()), 1)


def image_of(gaussians: Gaussians, view: View, backend: str) -> Image:
    """The photograph of a view, or its render where it has none."""
    if view.image is not None:
        return view.read_image()
    with prepare(gaussians, view.camera, backend=backend) as prepared, torch.no_grad():
        colour = prepared.render().image
    return (colour.cpu().clamp(0, 1) * 255 + 0.5).to(torch.uint8)
