"""From label maps, features and photographs to a decoder, and Gaussians that learnt along."""

from collections.abc import Callable, Sequence

import numpy as np
import torch

from splatseg.core import ClassTable, Features, Gaussians, LabelSource, View
from splatseg.core.boundary import boundary
from splatseg.core.threads import one_torch_thread
from splatseg.lift.training import TrainingResult
from splatseg.methods._trained import TrainingContext, label_data
from splatseg.methods.cosseg._blocks import BlockSource
from splatseg.methods.cosseg._decoded_layer import decoded_layer, decoded_together
from splatseg.methods.cosseg._distilled import pixel_counts
from splatseg.methods.cosseg._fusion import (
    DROPPED,
    START,
    FusionShape,
    decoded_widths,
    first_weights,
)
from splatseg.methods.cosseg._given import prepare
from splatseg.methods.cosseg._joint import LabelLoss, train_jointly
from splatseg.methods.cosseg._options import PUBLISHED_STEPS, CossegOptions


@boundary
def train_cosseg_jointly(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: LabelSource,
    *,
    features: BlockSource | None = None,
    options: CossegOptions | None = None,
    classes: ClassTable | None = None,
    metres_per_unit: float | None = None,
    up: tuple[float, float, float] | None = None,
    context: TrainingContext | None = None,
    told: Callable[[int, int], None] | None = None,
) -> tuple[Gaussians, Features]:
    """Train the decoder of `train_cosseg` with the Gaussians themselves, see `_joint`.

    What is decoded is rendered and then classified, as published, in whole pictures; nothing is
    kept to resume from. Same seed, same result, whatever the number of threads.

    Args:
        gaussians: The Gaussians to begin with; they stay as they are.
        views: Those to learn from, with photographs.
        evidence: Their label maps.
        features: Several blocks of a network for the same views. None decodes space alone.
        options: What is decoded from, and how both learn together.
        classes: Names of the ids, for the info.
        metres_per_unit: Of the scene; None takes it to be as dense as what the point network was
            trained on.
        up: Direction away from the ground; None takes it to be z.
        context: Seed and backend.
        told: Called with the steps done and all there are.

    Returns:
        The Gaussians, row for row, and what is decoded of each.

    Raises:
        InputError: If there are no views, one has no photograph, label map or features, no pixel
            has a label, or there are too few Gaussians for the point network.
        ShapeError: If maps or features do not have their photograph's proportions.
        SplatsegError: If the loss is no longer a number.
    """
    options, context = options or CossegOptions(), context or TrainingContext()
    how = options.joint_training
    data = label_data(gaussians, views, evidence, options=options, context=context)
    given = prepare(
        gaussians, data, features, options=options, context=context, frame=(metres_per_unit, up)
    )
    with one_torch_thread():
        whole = given.points_of(given.chosen)
        everything = whole.scaled(whole.scalings(), len(gaussians))
    shape = FusionShape(
        inputs=everything.inputs.widths,
        decoded=decoded_widths(options.decoded, len(everything.inputs.widths)),
        head=options.head,
    )
    rng = np.random.default_rng((context.seed, START))
    loss = LabelLoss(
        everything,
        first_weights(shape, len(data.ids), rng),
        evidence,
        ids=data.ids,
        weight=how.label_weight,
        rate=options.rate,
        dropout=options.dropout,
        rng=np.random.default_rng((context.seed, DROPPED)),
        backend=context.backend,
    )
    learnt = train_jointly(
        gaussians,
        data.views,
        loss,
        options=how,
        backend=context.backend,
        seed=context.seed,
        progress=told,
    )
    shown = pixel_counts(
        learnt, data.views, render_options=context.render_options, backend=context.backend
    )
    result = TrainingResult(
        rows={},
        shared={name: one.detach() for name, one in loss.weights.items()},
        visibility=shown.to(torch.float32),
        losses=loss.losses,
        scores=(),
        best_step=len(loss.losses),
        stopped="steps",
    )
    steps = len(loss.losses)
    layer = decoded_layer(
        given,
        decoded_together(everything, result.shared),
        everything,
        data,
        result,
        blend="features",
        classes=classes,
        seed=context.seed,
        trained=f"{steps} of {PUBLISHED_STEPS} published steps of a whole picture, jointly",
    )
    return learnt, layer
