"""From label maps and features to a decoder of both, and what it says of every Gaussian."""

import hashlib
from collections.abc import Generator, Iterable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.core import ClassTable, Features, Gaussians, LabelSource, View
from splatseg.core.boundary import boundary
from splatseg.core.rigid import upright
from splatseg.errors import InputError
from splatseg.lift.label_maps import Blend, ClassifierHead
from splatseg.lift.training import TrainingResult, held_out_views
from splatseg.methods._trained import (
    LabelData,
    TrainingContext,
    label_data,
    layer_info,
    recorded_options,
    train_labels,
)
from splatseg.methods.cosseg.checkpoint import load_point_encoder
from splatseg.methods.cosseg.decoder import (
    START,
    FusionModel,
    FusionShape,
    PointsOf,
    Weights,
    decode_all,
    decoded_widths,
)
from splatseg.methods.cosseg.features import (
    BlockSource,
    DistilledFeatures,
    distilled_features,
    pixel_counts,
    view_pixel_counts,
)
from splatseg.methods.cosseg.options import HEAD, CossegOptions
from splatseg.methods.cosseg.points import (
    PointSet,
    PointSource,
    Scaling,
    VisiblePoints,
    spatial_frame,
)
from splatseg.render import options_for


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prepared:
    """What is decoded from."""

    chosen: Int64[Tensor, "m"]
    """The Gaussians that are decoded."""

    distilled: DistilledFeatures | None
    source: PointSource
    scalings: Sequence[Sequence[Scaling]]
    everything: PointSet
    """All chosen ones together."""

    options: CossegOptions

    @property
    def shape(self) -> FusionShape:
        """Widths of the decoder."""
        widths = self.everything.inputs.widths
        return FusionShape(
            inputs=widths, decoded=decoded_widths(self.options.decoded, len(widths)), head=HEAD
        )

    @property
    def settings(self) -> dict[str, Any]:
        """What else must be the same to resume."""
        digest, encoder = hashlib.sha256(), hashlib.sha256()
        for scale in () if self.distilled is None else self.distilled.scales:
            digest.update(scale.numpy().tobytes())
        network = self.source.encoder
        for value in () if network is None else network.encoder.state_dict().values():
            encoder.update(value.numpy().tobytes())
        return {"distilled": digest.hexdigest(), "point network": encoder.hexdigest()}


def prepare(
    gaussians: Gaussians,
    data: LabelData,
    features: BlockSource | None,
    *,
    options: CossegOptions,
    context: TrainingContext,
    metres_per_unit: float | None,
    up: tuple[float, float, float] | None,
) -> Prepared:
    """Lift features, count pixels and load the point network, as far as they are asked for.

    Args:
        gaussians: The Gaussians of the scene.
        data: Label maps and their views.
        features: Several blocks of a network for the same views; None for none.
        options: What is asked for.
        context: Render options, backend and seed.
        metres_per_unit: Of the scene; None where it is not known.
        up: Direction away from the ground; None where it is not known.

    Raises:
        InputError: If what is asked for is not there.
    """
    if features is None and options.spatial == "none":
        raise InputError("features: expected evidence of features to decode, got none.")
    chosen, counts = torch.arange(len(gaussians)), None
    if options.is_published:
        counts = pixel_counts(gaussians, data.views, backend=context.backend)
        chosen = torch.nonzero(counts >= options.min_pixels).squeeze(1)
        if not len(chosen):
            raise InputError(
                f"gaussians: expected some in at least {options.min_pixels} pixels, got none of "
                f"{len(gaussians)}."
            )
    distilled = None
    if features is not None and options.semantic != "none":
        distilled = distilled_features(
            gaussians,
            data.views,
            features,
            pixels=counts,
            backend=context.backend,
            executor=context.executor,
        )
    encoder = frame = None
    if options.spatial != "none":
        encoder = load_point_encoder(options.encoder)
        frame = spatial_frame(
            encoder,
            upright(gaussians.means.detach().cpu()[chosen], up),
            metres_per_unit=metres_per_unit,
            seed=context.seed,
        )
    scales = () if distilled is None else distilled.scales
    source = PointSource(
        gaussians=gaussians,
        scales=scales[:1] if options.semantic == "first" else scales,
        encoder=encoder,
        frame=frame,
        spatial=options.spatial,
        up=up,
        seed=context.seed,
    )
    whole = source.raw(chosen)
    scalings = whole.scalings()
    everything = whole.scaled(scalings, len(gaussians))
    return Prepared(
        chosen=chosen,
        distilled=distilled,
        source=source,
        scalings=scalings,
        everything=everything,
        options=options,
    )


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
    prepared = prepare(
        gaussians,
        data,
        features,
        options=options,
        context=context,
        metres_per_unit=metres_per_unit,
        up=up,
    )
    with _points(prepared, data.views, context=context) as (points, scored):
        model = FusionModel(
            prepared.shape,
            len(data.ids),
            points=points,
            scored_points=scored,
            options=options,
            rng=np.random.default_rng((context.seed, START)),
        )
        result = train_labels(
            "cosseg", data, model, options=options, context=context, extra=prepared.settings
        )
        if options.by_view:
            learnt, _ = held_out_views(data.views, options.held_out)
            shown = (points(view) for view in range(len(learnt)))
            values = decoded_in_views(shown, prepared.everything, result.shared)
        else:
            values = decoded_together(prepared.everything, result.shared)
    return decoded_layer(
        prepared,
        values,
        data,
        result,
        blend=options.blend,
        classes=classes,
        seed=context.seed,
        trained=options.trained(len(result.losses)),
    )


@contextmanager
def _points(
    prepared: Prepared, views: Sequence[View], *, context: TrainingContext
) -> Generator[tuple[PointsOf, PointsOf]]:
    """The points of views that are learnt from, and of those that are held out."""
    options, everything = prepared.options, prepared.everything
    if not options.by_view:
        yield (lambda _: everything), (lambda _: everything)
        return
    gaussians = prepared.source.gaussians
    blending = options_for(gaussians, context.backend)
    is_chosen = everything.rows >= 0

    def make(views: Sequence[View], index: int) -> PointSet:
        counts = view_pixel_counts(gaussians, views[index], blending, context.backend)
        shown = torch.nonzero((counts > 0) & is_chosen).squeeze(1)
        return prepared.source.raw(shown).scaled(prepared.scalings, len(gaussians))

    kept, held_out = held_out_views(views, options.held_out)
    with (
        VisiblePoints(partial(make, kept), memory=options.memory) as points,
        VisiblePoints(partial(make, held_out), memory=options.memory) as scored,
    ):
        yield points.of, scored.of


def decoded_together(points: PointSet, weights: Weights) -> Float[Tensor, "n channels"]:
    """What is decoded of each Gaussian of the scene among these; 0 of those that are not."""
    decoded = decode_all(points.inputs, weights)
    there = points.rows >= 0
    values = torch.zeros(len(there), decoded.shape[1])
    values[there] = decoded[points.rows[there]]
    return values


def decoded_in_views(
    views: Iterable[PointSet], everything: PointSet, weights: Weights
) -> Float[Tensor, "n channels"]:
    """The mean of what is decoded of each Gaussian in the views that show it.

    A decoder that learnt from the points of single views decodes points of all views otherwise:
    each has other points around it. Gaussians that no view shows are decoded among all.
    """
    values = decoded_together(everything, weights)
    total, count = torch.zeros_like(values), torch.zeros(len(values))
    for points in views:
        total += decoded_together(points, weights)
        count += points.rows >= 0
    shown = count > 0
    values[shown] = total[shown] / count[shown, None]
    return values


def decoded_layer(
    prepared: Prepared,
    values: Float[Tensor, "n channels"],
    data: LabelData,
    result: TrainingResult,
    *,
    blend: Blend,
    classes: ClassTable | None,
    seed: int,
    trained: str,
) -> Features:
    """What is decoded of every Gaussian, with the classifier that reads it.

    Args:
        prepared: What it is decoded from.
        values: What is decoded of each.
        data: Label maps and their views.
        result: The weights.
        blend: Whether what is decoded is rendered and then classified, or probabilities rendered.
        classes: Names of the ids.
        seed: Of the training.
        trained: How long, in words.
    """
    distilled, encoder, frame = prepared.distilled, prepared.source.encoder, prepared.source.frame
    # Features say what a Gaussian is though no drawn pixel shows it.
    weights = result.visibility.clone()
    facts: dict[str, Any] = {"decoded": len(prepared.chosen), "trained": trained}
    if distilled is not None:
        weights = torch.maximum(weights, distilled.weights)
        facts["blocks"] = list(distilled.names)
        facts["skipped"] = [name for name, done in distilled.steps.items() if not done]
    weights[prepared.everything.rows < 0] = 0
    if encoder is not None and frame is not None:
        facts["point_network"] = encoder.source
        facts["point_network_trained_on"] = encoder.trained_on
        facts["metres_per_unit"] = frame.metres_per_unit
        facts["scale_assumed"] = frame.is_scale_assumed
    head = ClassifierHead(
        ids=data.ids,
        weight=result.shared["classifier.weight"],
        bias=result.shared["classifier.bias"],
        blend=blend,
    )
    recorded = recorded_options(prepared.options)
    info = layer_info("cosseg", recorded, data, result, head=head, classes=classes, seed=seed)
    info = replace(info, details={**info.details, **facts})
    return Features(values=values, weights=weights, info=info)
