"""From label maps and features to a decoder of both, and what it says of every Gaussian."""

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from functools import partial

import numpy as np
import torch

from splatseg.core import ClassTable, Features, Gaussians, LabelSource, View
from splatseg.core.boundary import boundary
from splatseg.core.threads import one_torch_thread
from splatseg.lift.training import held_out_views
from splatseg.lift.voting.uplift import UpliftOptions, uplift
from splatseg.methods._trained import (
    LabelData,
    TrainingContext,
    label_data,
    train_labels,
)
from splatseg.methods.cosseg._agreement import VoteAgreement
from splatseg.methods.cosseg._blocks import BlockSource
from splatseg.methods.cosseg._decoded_layer import decoded_in_views, decoded_layer, decoded_together
from splatseg.methods.cosseg._distilled import (
    view_pixel_counts,
)
from splatseg.methods.cosseg._fusion import START, FusionShape, Scaling, decoded_widths
from splatseg.methods.cosseg._given import Given, prepare
from splatseg.methods.cosseg._model import FusionModel, PointsOf
from splatseg.methods.cosseg._options import CossegOptions
from splatseg.methods.cosseg._points import (
    PointSet,
)
from splatseg.methods.cosseg._visible import VisiblePoints
from splatseg.render import options_for

_CANDIDATES = 8
"""Ids of a Gaussian whose votes count as agreement."""


@boundary
def train_cosseg(
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
) -> Features:
    """Train a decoder of features and space on label maps, see `methods.cosseg`.

    Ids must mean the same in all views. Same seed, same result, whatever the number of threads;
    the order of the views does not matter.

    Args:
        gaussians: The Gaussians of the scene; their geometry stays as it is.
        views: Those to learn from: a method that is to be measured uses train views only.
        evidence: Their label maps, as large as the photographs or reduced in proportion.
        features: Several blocks of a network for the same views. None decodes space alone.
        options: How the decoder is trained.
        classes: Names of the ids, for the info.
        metres_per_unit: Of the scene; None takes it to be as dense as what the point network was
            trained on.
        up: Direction away from the ground; None takes it to be z.
        context: Seed, backend, checkpoints and whom to tell.

    Returns:
        What is decoded of each Gaussian, with `ClassifierHead.of` to read it; Gaussians that were
        not decoded have the weight 0.

    Raises:
        InputError: If there are no views, one has no label map or no features, no pixel has a
            label, there are too few Gaussians for the point network, or a checkpoint is of another
            training.
        ShapeError: If maps or features do not have their photograph's proportions.
        KeyboardInterrupt: If it was cancelled.
    """
    options, context = options or CossegOptions(), context or TrainingContext()
    data = label_data(gaussians, views, evidence, options=options, context=context)
    given = prepare(
        gaussians, data, features, options=options, context=context, frame=(metres_per_unit, up)
    )
    with one_torch_thread():
        whole = given.points_of(given.chosen)
        scalings = whole.scalings()
        everything = whole.scaled(scalings, len(gaussians))
    agreement = _agreement(gaussians, data, evidence, options, context)
    with _points(given, data.views, scalings=scalings, everything=everything, context=context) as (
        points,
        scored,
    ):
        model = FusionModel(
            FusionShape(
                inputs=everything.inputs.widths,
                decoded=decoded_widths(options.decoded, len(everything.inputs.widths)),
                head=options.head,
            ),
            len(data.ids),
            points=points,
            scored_points=scored,
            blend=options.blend,
            loss=options.label_loss,
            rate=options.rate,
            dropout=options.dropout,
            agreement=agreement,
            views=len(data.views) if options.transitions == "views" else 0,
            transition_rate=options.transition_rate,
            rng=np.random.default_rng((context.seed, START)),
        )
        result = train_labels(
            "cosseg", data, model, options=options, context=context, extra=given.settings
        )
        if _is_by_view(given):
            learnt, _ = held_out_views(data.views, options.held_out)
            shown = (points(view) for view in range(len(learnt)))
            values = decoded_in_views(shown, everything, result.shared)
        else:
            values = decoded_together(everything, result.shared)
    return decoded_layer(
        given,
        values,
        everything,
        data,
        result,
        blend=options.blend,
        classes=classes,
        seed=context.seed,
        trained=options.trained(len(result.losses)),
    )


def _agreement(
    gaussians: Gaussians,
    data: LabelData,
    evidence: LabelSource,
    options: CossegOptions,
    context: TrainingContext,
) -> VoteAgreement | None:
    if options.weighting == "none":
        return None
    votes = uplift(
        gaussians,
        data.views,
        evidence,
        options=UpliftOptions(candidates=_CANDIDATES),
        render_options=context.render_options,
        backend=context.backend,
    )
    return VoteAgreement(votes, data.ids)


def _is_by_view(given: Given) -> bool:
    """Whether each view has points of its own; without space a point is what it is anywhere."""
    return given.options.points == "visible" and given.encoder is not None


@contextmanager
def _points(
    given: Given,
    views: Sequence[View],
    *,
    scalings: Sequence[Sequence[Scaling]],
    everything: PointSet,
    context: TrainingContext,
) -> Generator[tuple[PointsOf, PointsOf]]:
    """The points of views that are learnt from, and of those that are held out."""
    options = given.options
    if not _is_by_view(given):
        yield (lambda _: everything), (lambda _: everything)
        return
    gaussians = given.gaussians
    blending = context.render_options or options_for(gaussians, context.backend)
    is_chosen = torch.zeros(len(gaussians), dtype=torch.bool)
    is_chosen[given.chosen] = True

    def make(views: Sequence[View], index: int) -> PointSet:
        counts = view_pixel_counts(gaussians, views[index], blending, context.backend)
        shown = torch.nonzero((counts > 0) & is_chosen).squeeze(1)
        with one_torch_thread():
            return given.points_of(shown).scaled(scalings, len(gaussians))

    kept, held_out = held_out_views(views, options.held_out)
    with (
        VisiblePoints(partial(make, kept), memory=options.memory) as points,
        VisiblePoints(partial(make, held_out), memory=options.memory) as scored,
    ):
        yield points.of, scored.of
