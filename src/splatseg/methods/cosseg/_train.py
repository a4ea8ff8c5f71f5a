"""From label maps and features to a decoder of both, and what it says of every Gaussian."""

import hashlib
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Int64
from torch import Tensor

from splatseg.core import ClassTable, Features, Gaussians, LabelSource, LayerInfo, View
from splatseg.core.boundary import boundary
from splatseg.core.threads import one_torch_thread
from splatseg.errors import InputError
from splatseg.lift.heads import ClassifierHead
from splatseg.lift.mass.uplift import UpliftOptions, uplift
from splatseg.lift.point_network import PointEncoder, load_point_encoder
from splatseg.lift.training import TrainingResult, held_out_views
from splatseg.methods._trained_labels import (
    LabelData,
    TrainingContext,
    label_data,
    layer_info,
    recorded_options,
    train_labels,
)
from splatseg.methods.cosseg._agreement import VoteAgreement
from splatseg.methods.cosseg._blocks import BlockSource
from splatseg.methods.cosseg._distilled import (
    DistilledFeatures,
    distilled_features,
    pixel_counts,
    view_pixel_counts,
)
from splatseg.methods.cosseg._fusion import FusionShape, Scaling, decode_all
from splatseg.methods.cosseg._model import FusionModel, PointsOf
from splatseg.methods.cosseg._options import CossegOptions
from splatseg.methods.cosseg._points import (
    PointSet,
    PointSource,
    RawPoints,
    boxes,
    check_decoded,
    joined_blocks,
)
from splatseg.methods.cosseg._visible import VisiblePoints
from splatseg.render import options_for

_START = 0xC055
"""What the generator of first values is seeded with besides the seed."""

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
    given = _given(
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
                decoded=_widths(options.decoded, len(everything.inputs.widths)),
                head=options.head,
            ),
            len(data.ids),
            points=points,
            scored_points=scored,
            blend=options.blend,
            loss=options.label_loss,
            rate=options.rate,
            agreement=agreement,
            views=len(data.views) if options.transitions == "views" else 0,
            transition_rate=options.transition_rate,
            rng=np.random.default_rng((context.seed, _START)),
        )
        result = train_labels(
            "cosseg", data, model, options=options, context=context, extra=given.settings
        )
    return _layer(given, everything, data, result, classes=classes, seed=context.seed)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Given:
    """What is decoded from."""

    gaussians: Gaussians
    chosen: Int64[Tensor, "m"]
    distilled: DistilledFeatures | None
    encoder: PointEncoder | None
    source: PointSource
    options: CossegOptions

    def points_of(self, chosen: Int64[Tensor, "m"]) -> RawPoints:
        """What stands beside some Gaussians."""
        if self.options.points != "blocks" or self.encoder is None:
            return self.source.raw(chosen)
        means = self.gaussians.means.detach().cpu()
        parts = boxes(means, chosen, self.options.block_points)
        return joined_blocks([self.source.raw(part) for part in parts])

    @property
    def settings(self) -> dict[str, Any]:
        """What else must be the same to resume."""
        digest = hashlib.sha256()
        for scale in () if self.distilled is None else self.distilled.scales:
            digest.update(scale.numpy().tobytes())
        encoder = hashlib.sha256()
        for value in () if self.encoder is None else self.encoder.encoder.state_dict().values():
            encoder.update(value.numpy().tobytes())
        return {"distilled": digest.hexdigest(), "point network": encoder.hexdigest()}


def _given(
    gaussians: Gaussians,
    data: LabelData,
    features: BlockSource | None,
    *,
    options: CossegOptions,
    context: TrainingContext,
    frame: tuple[float | None, tuple[float, float, float] | None],
) -> _Given:
    """Lift features, count pixels and load the point network, as far as they are asked for."""
    if features is None and options.semantic != "none" and options.spatial == "none":
        raise InputError("features: expected evidence of features to decode, got none.")
    chosen, counts = torch.arange(len(gaussians)), None
    if options.min_pixels > 0 or (options.division == "pixels" and features is not None):
        counts = pixel_counts(
            gaussians,
            data.views,
            render_options=context.render_options,
            backend=context.backend,
        )
        chosen = check_decoded(counts >= options.min_pixels, options.min_pixels)
    distilled = None
    if features is not None and options.semantic != "none":
        distilled = distilled_features(
            gaussians,
            data.views,
            features,
            components=options.components,
            division=options.division,
            pixels=counts,
            longest_side=options.lifted_side,
            render_options=context.render_options,
            backend=context.backend,
        )
    encoder = None if options.spatial == "none" else load_point_encoder(options.encoder)
    scales: Sequence[Tensor] = () if distilled is None else distilled.scales
    if options.semantic == "first":
        scales = scales[:1]
    return _Given(
        gaussians=gaussians,
        chosen=chosen,
        distilled=distilled,
        encoder=encoder,
        source=PointSource(
            gaussians=gaussians,
            scales=scales,
            encoder=encoder,
            spatial=options.spatial,
            metres_per_unit=frame[0],
            up=frame[1],
            seed=context.seed,
        ),
        options=options,
    )


def _widths(decoded: Sequence[int], levels: int) -> tuple[int, ...]:
    """Channels of each level; the last number stands for all that are not given."""
    given = tuple(decoded[:levels])
    return given + (given[-1],) * (levels - len(given))


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


@contextmanager
def _points(
    given: _Given,
    views: Sequence[View],
    *,
    scalings: Sequence[Sequence[Scaling]],
    everything: PointSet,
    context: TrainingContext,
) -> Generator[tuple[PointsOf, PointsOf]]:
    """The points of views that are learnt from, and of those that are held out."""
    options = given.options
    if options.points != "visible" or given.encoder is None:
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


def _layer(
    given: _Given,
    everything: PointSet,
    data: LabelData,
    result: TrainingResult,
    *,
    classes: ClassTable | None,
    seed: int,
) -> Features:
    """What is decoded of every Gaussian, with the classifier that reads it."""
    options = given.options
    with one_torch_thread():
        decoded = decode_all(everything.inputs, result.shared)
    values = torch.zeros(len(everything.rows), decoded.shape[1])
    there = everything.rows >= 0
    values[there] = decoded[everything.rows[there]]
    # Features say what a Gaussian is though no drawn pixel shows it.
    weights = result.visibility.clone()
    if given.distilled is not None:
        weights = torch.maximum(weights, given.distilled.weights)
    weights[~there] = 0
    head = ClassifierHead(
        ids=data.ids,
        weight=result.shared["classifier.weight"],
        bias=result.shared["classifier.bias"],
        blend=options.blend,
    )
    info = layer_info(
        "cosseg", recorded_options(options), data, result, head=head, classes=classes, seed=seed
    )
    return Features(values=values, weights=weights, info=_with_facts(info, given, everything))


def _with_facts(info: LayerInfo, given: _Given, everything: PointSet) -> LayerInfo:
    """The record, with what was decoded from."""
    facts: dict[str, Any] = {"decoded": len(given.chosen)}
    if given.distilled is not None:
        facts["blocks"] = list(given.distilled.names)
        facts["skipped"] = [name for name, done in given.distilled.steps.items() if not done]
    if given.encoder is not None:
        facts["point_network"] = given.encoder.source
        facts["metres_per_unit"] = everything.metres_per_unit
        facts["scale_assumed"] = given.source.metres_per_unit is None
    return replace(info, details={**info.details, **facts})
