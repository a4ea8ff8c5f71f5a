"""Losses of labels that pixels get from Gaussians, and the score of held-out pixels."""

import math

import torch
from jaxtyping import Float, Int64
from torch import Tensor

TINY = 1e-10
"""Added to probabilities before their logarithm."""


def logit_loss(
    logits: Float[Tensor, "pixels classes"],
    label: Int64[Tensor, "pixels"],
    confidence: Float[Tensor, "pixels"],
) -> Float[Tensor, ""]:
    r"""Mean cross-entropy of rendered logits, over the log of the number of classes.

    .. math:: \frac{1}{P \log C} \sum_p s_p \, \mathrm{CE}(z_p, c_p)

    With a single class there is nothing to learn, and the loss is 0.
    """
    each = torch.nn.functional.cross_entropy(logits, label, reduction="none")
    return (each * confidence).mean() / math.log(max(logits.shape[1], 2))


def probability_loss(
    own: Float[Tensor, "pixels"],
    alpha: Float[Tensor, "pixels"],
    confidence: Float[Tensor, "pixels"],
    classes: int,
) -> Float[Tensor, ""]:
    r"""Mean negative log of the rendered probability, over the log of the number of classes.

    .. math:: -\frac{1}{P \log C} \sum_p s_p \log \frac{\sum_i w_{pi} q_{i c_p}}{\sum_i w_{pi}}

    A pixel that shows nothing has no say.

    Args:
        own: Rendered probability of each pixel's own class, the numerator.
        alpha: Sum of each pixel's blending weights.
        confidence: s.
        classes: C.
    """
    each = torch.log(alpha + TINY) - torch.log(own + TINY)
    return (each * confidence).mean() / math.log(max(classes, 2))


class LabelCounts:
    """Counts of held-out pixels by label and answer, for a mean intersection over union.

    Args:
        classes: How many classes there are.
    """

    def __init__(self, classes: int) -> None:
        self._right = torch.zeros(classes, dtype=torch.float64)
        self._labelled = torch.zeros(classes, dtype=torch.float64)
        self._answered = torch.zeros(classes, dtype=torch.float64)

    def add(
        self,
        label: Int64[Tensor, "pixels"],
        answer: Int64[Tensor, "pixels"],
        weight: Float[Tensor, "pixels"],
    ) -> None:
        """Count pixels; each counts its weight."""
        classes, weight = len(self._right), weight.double()
        self._labelled += torch.bincount(label, weights=weight, minlength=classes)
        self._answered += torch.bincount(answer, weights=weight, minlength=classes)
        self._right += torch.bincount(label, weights=weight * (label == answer), minlength=classes)

    @property
    def mean_iou(self) -> float:
        """Mean intersection over union of the classes that have a label; 0 where none has."""
        present = self._labelled > 0
        if not bool(present.any()):
            return 0.0
        union = self._labelled + self._answered - self._right
        return float((self._right[present] / union[present]).mean())
