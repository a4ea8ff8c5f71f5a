"""From masks to affinity features."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict

import numpy as np
import torch
from torch import Tensor

from splatseg.core import (
    LEARNED_BYTES,
    LOSS_CURVE,
    Features,
    FeatureSource,
    Gaussians,
    LayerInfo,
    View,
)
from splatseg.core.boundary import boundary
from splatseg.core.threads import one_torch_thread
from splatseg.errors import InputError
from splatseg.lift.affinity import AffinityHead
from splatseg.lift.training import MaskSets, RowSampler, TrainingResult, train
from splatseg.lift.voting.uplift import voting_views
from splatseg.methods._trained import TrainingContext, loss_curve
from splatseg.methods.associate import associate_masks
from splatseg.methods.saga._association import MaskSegments, association_start
from splatseg.methods.saga._mask_table import MaskTable, mask_table
from splatseg.methods.saga._model import PROJECTOR, SagaModel
from splatseg.methods.saga._options import SagaOptions
from splatseg.methods.saga._smoothing import Smoother
from splatseg.methods.saga._targets import KeptMasks, SagaTargets

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
    kept = KeptMasks(evidence)
    # Sums in one order, and no threads for the many small ones.
    with one_torch_thread():
        masks = mask_table(
            gaussians,
            ordered,
            kept,
            render_options=context.render_options,
            backend=context.backend,
        )
        source = SagaTargets(kept, ordered, masks.first, features, grid=options.grid)
    rng = np.random.default_rng((context.seed, _START))
    start, masks = _started(
        gaussians, ordered, kept, masks, options=options, context=context, rng=rng
    )
    sampler = RowSampler(
        gaussians,
        ordered,
        source,
        options=options.drawing(),
        render_options=context.render_options,
        backend=context.backend,
    )
    smoother = None
    if options.unit and options.smoothing > 1:
        smoother = Smoother(gaussians.means.detach().cpu(), neighbours=options.smoothing)
    model = SagaModel(
        start,
        masks,
        options,
        smoother=smoother,
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
    head = _head(options, masks, result.shared)
    return Features(
        values=_values(result.rows["features"], options, smoother),
        weights=result.visibility,
        info=_info(options, ordered, result, head, context.seed),
    )


def _started(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: KeptMasks,
    masks: MaskTable,
    *,
    options: SagaOptions,
    context: TrainingContext,
    rng: np.random.Generator,
) -> tuple[Tensor, MaskTable]:
    """What features start as, and the masks with the scales that they are to have."""
    found = None
    if options.associated:
        found = associate_masks(gaussians, views, MaskSegments(evidence), backend=context.backend)
    if found is not None and options.by_level:
        masks = masks.by_level(found)
    if found is not None and options.start == "association":
        with one_torch_thread():
            return association_start(found.tree, options.channels, rng), masks
    drawn = rng.standard_normal((len(gaussians), options.channels), dtype=np.float32)
    return torch.from_numpy(drawn), masks


def _settings(options: SagaOptions) -> dict[str, object]:
    """Options without those that change nothing that is trained."""
    return {name: value for name, value in asdict(options).items() if name != "memory"}


def _values(features: Tensor, options: SagaOptions, smoother: Smoother | None) -> Tensor:
    """Features as they were rendered in training, none of the neighbours left out."""
    if smoother is not None:
        return smoother.smoothed(features)
    return torch.nn.functional.normalize(features, dim=1) if options.unit else features


def _head(options: SagaOptions, masks: MaskTable, shared: Mapping[str, Tensor]) -> AffinityHead:
    return AffinityHead(
        channels=options.channels,
        unit=options.unit,
        gate_weight=shared.get("gate_weight"),
        gate_bias=shared.get("gate_bias"),
        scale_quantiles=masks.quantiles,
        levels=masks.levels,
        projector={
            name.removeprefix(PROJECTOR): value
            for name, value in shared.items()
            if name.startswith(PROJECTOR)
        },
    )


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
            LOSS_CURVE: loss_curve(result.losses),
            "loss": float(np.mean(result.losses[-20:])),
            "steps": len(result.losses),
            "best_step": result.best_step,
            "stopped": result.stopped,
            "scores": [[step, score] for step, score in result.scores],
            LEARNED_BYTES: result.learned_bytes,
        },
    )
