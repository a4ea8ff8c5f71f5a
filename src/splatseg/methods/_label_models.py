"""Models that learn labels of pixels: identity features, and logits of each Gaussian's own."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.lift.heads import Blend
from splatseg.lift.training import Batch, Parameter, Values
from splatseg.methods._identity_loss import NeighbourLoss
from splatseg.methods._label_losses import LabelCounts, logit_loss, probability_loss
from splatseg.methods._own_probability import linear_own_probability, own_probability


class LogitModel:
    """Logits of each Gaussian's own: no network, as many numbers a Gaussian as there are ids.

    Args:
        gaussians: How many there are.
        classes: How many ids there are.
        blend: Whether logits are rendered and then classified, or probabilities rendered.
        rate: Adam's rate.
    """

    def __init__(self, gaussians: int, classes: int, *, blend: Blend, rate: float) -> None:
        self._classes = classes
        self._blend: Blend = blend
        self._rows = {"logits": Parameter(start=torch.zeros(gaussians, classes), rate=rate)}

    @property
    def row_parameters(self) -> Mapping[str, Parameter]:
        """The logits, 0 at first: all ids alike."""
        return self._rows

    @property
    def shared_parameters(self) -> Mapping[str, Parameter]:
        """None."""
        return {}

    def loss(self, batch: Batch, values: Values) -> Float[Tensor, ""]:
        """Of rendered logits or of rendered probabilities."""
        logits = values.rows("logits", batch.weights.touched)
        label, confidence = batch.target("label"), batch.target("confidence")
        if self._blend == "features":
            return logit_loss(batch.weights.product(logits), label, confidence)
        own = own_probability(batch, label, logits)
        return probability_loss(own, batch.weights.rows.row_sums(), confidence, self._classes)

    def score(self, batches: Sequence[Batch], values: Values) -> float:
        """Mean intersection over union of what is rendered with the held-out labels."""
        counts = LabelCounts(self._classes)
        for batch in batches:
            logits = values.rows("logits", batch.weights.touched)
            _count(counts, batch, _rendered(self._blend, batch, logits))
        return counts.mean_iou


class IdentityModel:
    """Identity features, one linear classifier for all, and the neighbour term.

    Args:
        features: What features start as.
        weight: What the classifier's weight A starts as.
        bias: What its bias b starts as.
        blend: Whether features are rendered and then classified, or probabilities rendered.
        feature_rate: Adam's rate for features.
        classifier_rate: Adam's rate for the classifier.
        neighbours: The neighbour term; None is without.
        neighbour_weight: Lambda.
        neighbour_every: Steps from one neighbour term to the next.
        neighbour_samples: Gaussians compared with their neighbours in a step.
    """

    def __init__(
        self,
        features: Float[Tensor, "n channels"],
        weight: Float[Tensor, "classes channels"],
        bias: Float[Tensor, "classes"],
        *,
        blend: Blend,
        feature_rate: float,
        classifier_rate: float,
        neighbours: NeighbourLoss | None,
        neighbour_weight: float = 0.0,
        neighbour_every: int = 1,
        neighbour_samples: int = 1,
    ) -> None:
        self._blend: Blend = blend
        self._rows = {"features": Parameter(start=features, rate=feature_rate)}
        self._shared = {
            "weight": Parameter(start=weight, rate=classifier_rate),
            "bias": Parameter(start=bias, rate=classifier_rate),
        }
        self._neighbours = neighbours
        self._neighbour_weight = neighbour_weight
        self._neighbour_every = neighbour_every
        self._neighbour_samples = neighbour_samples

    @property
    def row_parameters(self) -> Mapping[str, Parameter]:
        """``features``."""
        return self._rows

    @property
    def shared_parameters(self) -> Mapping[str, Parameter]:
        """The classifier: ``weight`` and ``bias``."""
        return self._shared

    def loss(self, batch: Batch, values: Values) -> Float[Tensor, ""]:
        """The pixel term, and every so often the neighbour term."""
        weight, bias = values.shared["weight"], values.shared["bias"]
        features = values.rows("features", batch.weights.touched)
        label, confidence = batch.target("label"), batch.target("confidence")
        if self._blend == "features":
            logits = batch.weights.product(features) @ weight.T + bias
            loss = logit_loss(logits, label, confidence)
        else:
            own = linear_own_probability(batch, label, features, weight, bias)
            alpha = batch.weights.rows.row_sums()
            loss = probability_loss(own, alpha, confidence, len(bias))
        if self._neighbours is None or values.step % self._neighbour_every:
            return loss
        pairs = self._neighbours.draw(self._neighbour_samples, values.rng)
        names, position = torch.unique(pairs, return_inverse=True)
        picked = values.rows("features", names)
        return loss + self._neighbour_weight * self._neighbours.loss(picked, position, weight, bias)

    def score(self, batches: Sequence[Batch], values: Values) -> float:
        """Mean intersection over union of what is rendered with the held-out labels."""
        weight, bias = values.shared["weight"], values.shared["bias"]
        counts = LabelCounts(len(bias))
        for batch in batches:
            features = values.rows("features", batch.weights.touched)
            if self._blend == "features":
                rendered = batch.weights.product(features) @ weight.T + bias
            else:
                rendered = _rendered(self._blend, batch, features @ weight.T + bias)
            _count(counts, batch, rendered)
        return counts.mean_iou


def linear_start(
    channels: int, classes: int, rng: np.random.Generator
) -> tuple[Float[Tensor, "classes channels"], Float[Tensor, "classes"]]:
    """What a linear layer starts with: weight and bias uniform within 1 / sqrt(channels)."""
    bound = 1 / math.sqrt(channels)
    return tuple(
        torch.from_numpy(rng.uniform(-bound, bound, shape).astype(np.float32))
        for shape in ((classes, channels), (classes,))
    )  # pyright: ignore[reportReturnType]


def _rendered(blend: Blend, batch: Batch, logits: Float[Tensor, "t classes"]) -> Tensor:
    if blend == "probabilities":
        logits = torch.softmax(logits, dim=-1)
    return batch.weights.product(logits)


def _count(counts: LabelCounts, batch: Batch, rendered: Tensor) -> None:
    weight = batch.target("confidence") * batch.stands_for
    counts.add(batch.target("label"), rendered.argmax(dim=1), weight)
