"""What a trained decoder says of every Gaussian, as a layer."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import ClassTable, Features, LayerInfo
from splatseg.core.threads import one_torch_thread
from splatseg.lift.label_maps import Blend, ClassifierHead
from splatseg.lift.training import TrainingResult
from splatseg.methods._trained import LabelData, layer_info, recorded_options
from splatseg.methods.cosseg._fusion import Weights, decode_all
from splatseg.methods.cosseg._given import Given
from splatseg.methods.cosseg._points import PointSet


def decoded_together(points: PointSet, weights: Weights) -> Float[Tensor, "n channels"]:
    """What is decoded of each Gaussian of the scene among these; 0 of those that are not."""
    with one_torch_thread():
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
    given: Given,
    values: Float[Tensor, "n channels"],
    everything: PointSet,
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
        given: What it is decoded from.
        values: What is decoded of each.
        everything: All Gaussians that are decoded.
        data: Label maps and their views.
        result: The weights.
        blend: Whether what is decoded is rendered and then classified, or probabilities rendered.
        classes: Names of the ids.
        seed: Of the training.
        trained: How long, in words.
    """
    options = given.options
    # Features say what a Gaussian is though no drawn pixel shows it.
    weights = result.visibility.clone()
    if given.distilled is not None:
        weights = torch.maximum(weights, given.distilled.weights)
    weights[everything.rows < 0] = 0
    head = ClassifierHead(
        ids=data.ids,
        weight=result.shared["classifier.weight"],
        bias=result.shared["classifier.bias"],
        blend=blend,
    )
    info = layer_info(
        "cosseg", recorded_options(options), data, result, head=head, classes=classes, seed=seed
    )
    return Features(
        values=values, weights=weights, info=_with_facts(info, given, everything, trained)
    )


def _with_facts(info: LayerInfo, given: Given, everything: PointSet, trained: str) -> LayerInfo:
    """The record, with what was decoded from."""
    facts: dict[str, Any] = {"decoded": len(given.chosen), "trained": trained}
    if given.distilled is not None:
        facts["blocks"] = list(given.distilled.names)
        facts["skipped"] = [name for name, done in given.distilled.steps.items() if not done]
    if given.encoder is not None:
        facts["point_network"] = given.encoder.source
        facts["point_network_trained_on"] = given.encoder.trained_on
        facts["metres_per_unit"] = everything.metres_per_unit
        facts["scale_assumed"] = given.is_scale_assumed
    return replace(info, details={**info.details, **facts})
