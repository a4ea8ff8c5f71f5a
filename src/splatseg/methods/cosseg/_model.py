"""The fusion decoder as it is trained on rows of W."""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.lift.label_maps import Blend
from splatseg.lift.training import Batch, Parameter, Values
from splatseg.methods._robust_losses import LabelLoss, label_loss
from splatseg.methods._trained import TINY, LabelCounts
from splatseg.methods.cosseg._fusion import (
    RUNNING,
    FusionShape,
    Statistics,
    decode,
    dropped,
    first_weights,
    running,
    running_momentum,
)
from splatseg.methods.cosseg._points import PointSet

Agreement = Callable[[Batch], Float[Tensor, "pixels"]]
PointsOf = Callable[[int], PointSet]
"""The points that a view shows, by the view's number; all Gaussians where it does not matter."""

_STAYS = 3.0
"""How much more likely a label is the true one than any other, in a view's first matrix (log)."""


class FusionModel:
    """A decoder and a classifier for all Gaussians; no array has a row a Gaussian.

    Args:
        shape: Of the decoder.
        classes: How many ids there are.
        points: The points of a view that is learnt from.
        scored_points: The points of a held-out view.
        blend: Whether what is decoded is rendered and then classified, or probabilities rendered.
        loss: What a label costs.
        rate: Adam's rate.
        dropout: Share of what is decoded that is dropped before the classifier while training.
        agreement: How much each pixel of a batch counts; None counts all alike.
        views: Views with matrices of their own, by which their labels differ; 0 has none.
        transition_rate: Adam's rate for these.
        rng: Draws the first weights.
    """

    def __init__(
        self,
        shape: FusionShape,
        classes: int,
        *,
        points: PointsOf,
        scored_points: PointsOf,
        blend: Blend,
        loss: LabelLoss,
        rate: float,
        dropout: float,
        agreement: Agreement | None,
        views: int,
        transition_rate: float,
        rng: np.random.Generator,
    ) -> None:
        start = first_weights(shape, classes, rng)
        self._shared = {
            name: Parameter(start=one, rate=0.0 if name.endswith(RUNNING) else rate)
            for name, one in start.items()
        }
        if views:
            same = torch.eye(classes) * _STAYS
            self._shared["transitions"] = Parameter(
                start=same.repeat(views, 1, 1), rate=transition_rate
            )
        self._channels = shape.head[-1]
        self._classes = classes
        self._points, self._scored_points = points, scored_points
        self._blend: Blend = blend
        self._loss: LabelLoss = loss
        self._dropout = dropout
        self._agreement = agreement

    @property
    def row_parameters(self) -> Mapping[str, Parameter]:
        """None."""
        return {}

    @property
    def shared_parameters(self) -> Mapping[str, Parameter]:
        """The decoder's and the classifier's weights, and the views' matrices."""
        return self._shared

    def loss(self, batch: Batch, values: Values) -> Float[Tensor, ""]:
        """Of what the pixels show, over the log of the number of ids."""
        label, confidence = batch.target("label"), batch.target("confidence")
        statistics: Statistics = {}
        found = self._probabilities(
            batch, values.shared, self._points, statistics=statistics, rng=values.rng
        )
        momentum = running_momentum(values.step)
        for name, value in running(values.shared, statistics, momentum).items():
            values.keep(name, value)
        if "transitions" in values.shared:
            found = transferred(found, values.shared["transitions"], batch.views, label)
        each = label_loss(found, label, self._loss)
        if self._agreement is not None:
            confidence = confidence * self._agreement(batch)
        return (each * confidence).mean() / math.log(max(self._classes, 2))

    def score(self, batches: Sequence[Batch], values: Values) -> float:
        """Mean intersection over union of what is rendered with the held-out labels."""
        counts = LabelCounts(self._classes)
        for batch in batches:
            found = self._probabilities(batch, values.shared, self._scored_points)
            weight = batch.target("confidence") * batch.stands_for
            counts.add(batch.target("label"), found.argmax(dim=1), weight)
        return counts.mean_iou

    def _probabilities(
        self,
        batch: Batch,
        weights: Mapping[str, Tensor],
        points: PointsOf,
        *,
        statistics: Statistics | None = None,
        rng: np.random.Generator | None = None,
    ) -> Float[Tensor, "pixels classes"]:
        """Of each id at each pixel; with statistics and a generator while training."""
        touched = batch.weights.touched
        found = points(int(batch.views[0]))
        rows = found.rows[touched]
        there = torch.nonzero(rows >= 0).squeeze(1)
        decoded = decode(found.inputs, weights, rows[there], statistics=statistics)
        if rng is not None:
            decoded = dropped(decoded, self._dropout, rng)
        weight, bias = weights["classifier.weight"], weights["classifier.bias"]
        if self._blend == "features":
            rendered = batch.weights.product(_spread(decoded, there, len(touched)))
            return torch.softmax(rendered @ weight.T + bias, dim=1)
        each = torch.softmax(decoded @ weight.T + bias, dim=1)
        rendered = batch.weights.product(_spread(each, there, len(touched)))
        # What passes all points that are decoded says nothing.
        return rendered / (rendered.sum(dim=1, keepdim=True) + TINY)


def transferred(
    probabilities: Float[Tensor, "pixels classes"],
    transitions: Float[Tensor, "views classes classes"],
    views: Int64[Tensor, "pixels"],
    label: Int64[Tensor, "pixels"],
) -> Float[Tensor, "pixels classes"]:
    r"""Probabilities of the labels that views give, from those of what is there.

    .. math:: \tilde q_p = T_{v(p)}^\top q_p, \qquad T_v = \mathrm{softmax}(\theta_v)

    with :math:`T_{v,cd}` the probability that view v says d of what is c (Dawid and Skene 1979).
    Only the column of each pixel's own label is made; the others share what is left.
    """
    normaliser = torch.logsumexp(transitions, dim=2)
    column = transitions[views, :, label] - normaliser[views]
    own = (probabilities * column.exp()).sum(dim=1, keepdim=True)
    others = (1 - own) / max(probabilities.shape[1] - 1, 1)
    is_own = torch.nn.functional.one_hot(label, probabilities.shape[1]).bool()
    return torch.where(is_own, own, others)


def _spread(values: Tensor, rows: Int64[Tensor, "m"], count: int) -> Tensor:
    """Rows among so many, of which the others are 0."""
    if len(rows) == count:
        return values
    return values.new_zeros(count, values.shape[1]).index_copy(0, rows, values)
