"""From masks to affinity features: the masks as targets, and the training."""

import hashlib
from collections.abc import Sequence
from dataclasses import asdict

import numpy as np
import torch
from jaxtyping import Int64
from torch import Tensor

from splatseg.core import (
    Features,
    FeatureSource,
    Gaussians,
    LayerInfo,
    MaskSet,
    View,
)
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, ShapeError
from splatseg.lift.affinity import AffinityHead
from splatseg.lift.training import (
    MaskSets,
    MaskTargets,
    PixelChoice,
    Ragged,
    RowSampler,
    Target,
    Targets,
    TrainingResult,
    train,
)
from splatseg.lift.voting.features import read_features_at
from splatseg.lift.voting.uplift import voting_views
from splatseg.methods._trained import TrainingContext, training_details
from splatseg.methods.associate import associate_masks
from splatseg.methods.saga.masks import (
    GROUP_SCALE,
    OBJECT_SCALE,
    PART_SCALE,
    LevelMasks,
    MaskSegments,
    association_start,
    level_masks,
)
from splatseg.methods.saga.model import PROJECTOR, SagaModel
from splatseg.methods.saga.options import CHANNELS, SagaOptions


class StoredMasks:
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

    Targets: ``masks``, the numbers of these masks through all views in their order; and
    ``guidance``, the 2D features, where there are any.

    Groups are the masks and, as one more, the pixels outside all masks: what is no thing is to be
    unlike things, too.

    Args:
        evidence: The masks.
        views: The views to learn from, in the order of their names.
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
        features: FeatureSource | None = None,
        *,
        grid: int = 0,
    ) -> None:
        self._grid = grid
        self._masks = MaskTargets(evidence, [view.name for view in views])
        self._views = {view.name: view for view in views}
        counts = [len(evidence.masks(view.name)) for view in views]
        starts = np.cumsum([0, *counts[:-1]]).tolist()
        self._first = {view.name: start for view, start in zip(views, starts, strict=True)}
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
        self.fingerprint: str = digest.hexdigest()
        """A digest of all masks and features."""

    @property
    def channels(self) -> int:
        """Width of the 2D features, 0 without."""
        return self._channels

    @property
    def view_names(self) -> Sequence[str]:
        """The views to learn from."""
        return self._masks.view_names

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


_START = 0x5A6A
"""What the generator of first values is seeded with besides the seed."""


@boundary
def train_saga(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: MaskSets,
    *,
    features: FeatureSource | None = None,
    options: SagaOptions | None = None,
    context: TrainingContext | None = None,
) -> Features:
    """Train affinity features on masks, see `methods.saga`.

    Masks need not mean the same in all views. Same seed, same result, whatever the number of
    threads; the order of the views does not matter.

    Args:
        gaussians: The Gaussians of the scene; their geometry stays as it is.
        views: Those to learn from: a method that is to be measured uses train views only.
        evidence: Their masks, as large as the photographs or reduced in proportion.
        features: 2D features of the same views, which guide the queries of masks; None is
            without. They count where `SagaOptions.guidance_weight` is above 0.
        options: How features are trained.
        context: Seed, backend, checkpoints and whom to tell.

    Returns:
        A feature a Gaussian, its visibility in the views as the weight, and in the info the
        `AffinityHead` that reads it.

    Raises:
        InputError: If there are no views, one has no masks or no features, no pixel has a mask,
            or a checkpoint is of another training.
        ShapeError: If masks or features do not have their photograph's proportions.
        KeyboardInterrupt: If it was cancelled.
    """
    options, context = options or SagaOptions(), context or TrainingContext()
    if options.guidance is not None and features is None:
        raise InputError(
            f"features: expected 2D features, as guidance by {options.guidance} was asked for, "
            "got none; guidance=None trains without."
        )
    ordered = voting_views(views, evidence, "masks")
    kept = StoredMasks(evidence)
    source = SagaTargets(kept, ordered, features, grid=options.grid)
    rng = np.random.default_rng((context.seed, _START))
    start, levels = _started(gaussians, ordered, kept, options=options, context=context, rng=rng)
    sampler = RowSampler(
        gaussians,
        ordered,
        source,
        options=options.drawing(),
        backend=context.backend,
    )
    model = SagaModel(
        start,
        levels if options.gated else None,
        options,
        guidance=source.channels,
        rng=rng,
    )
    result = train(
        model,
        sampler,
        options=options.training(),
        seed=context.seed,
        checkpoints=context.checkpoints,
        settings={"method": "saga"} | _settings(options),
        defaults=_settings(SagaOptions()),
        progress=context.progress,
    )
    trained, unit = result.rows["features"], not options.is_published
    head = AffinityHead(
        channels=CHANNELS,
        unit=unit,
        gate_weight=result.shared.get("gate_weight"),
        gate_bias=result.shared.get("gate_bias"),
        levels=(GROUP_SCALE, OBJECT_SCALE, PART_SCALE) if options.gated else (0.5, 0.5, 0.5),
        projector={
            name.removeprefix(PROJECTOR): value
            for name, value in result.shared.items()
            if name.startswith(PROJECTOR)
        },
    )
    return Features(
        values=torch.nn.functional.normalize(trained, dim=1) if unit else trained,
        weights=result.visibility,
        info=_info(options, ordered, result, head, context.seed),
    )


def _started(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: StoredMasks,
    *,
    options: SagaOptions,
    context: TrainingContext,
    rng: np.random.Generator,
) -> tuple[Tensor, LevelMasks | None]:
    """What features start as, and the nodes of the masks where these are associated."""
    if options.is_published:
        drawn = rng.standard_normal((len(gaussians), CHANNELS), dtype=np.float32)
        return torch.from_numpy(drawn), None
    found = associate_masks(
        gaussians,
        views,
        MaskSegments(evidence),
        backend=context.backend,
        executor=context.executor,
    )
    nodes = np.concatenate([found.nodes[view.name] for view in views])
    start = association_start(found.tree, CHANNELS, rng)
    return start, level_masks(found.tree, torch.from_numpy(nodes))


def _settings(options: SagaOptions) -> dict[str, object]:
    """Options without those that change nothing that is trained."""
    return {name: value for name, value in asdict(options).items() if name != "memory"}


def _info(
    options: SagaOptions,
    views: Sequence[View],
    result: TrainingResult,
    head: AffinityHead,
    seed: int,
) -> LayerInfo:
    return LayerInfo(
        method="saga",
        options=asdict(options),
        views=tuple(view.name for view in views),
        seed=seed,
        head=head.to_json(),
        details={
            "published": options.is_published,
            "trained": options.trained(len(result.losses)),
            **training_details(result),
        },
    )
