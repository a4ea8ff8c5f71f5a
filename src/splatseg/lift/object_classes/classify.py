r"""Which class an object is of: its votes, and the votes of objects that look like it.

Votes of views err alike: what is taken for something else from one side is so from the next. An
object that most views get wrong looks like the others of its class, though, which most views get
right. So classes are found of which both are likely:

.. math:: r_{kc} \propto (s_{kc} + \epsilon)^{\kappa} \; p(f_k \mid c, r_{-k})^{\tau}

with :math:`s_{kc}` the share of the object's votes for class c and :math:`f_k` its feature.
Features of a class are Gaussian about a mean that is Gaussian itself (probabilistic linear
discriminant analysis; the two covariances B between and W within classes are common to all):

.. math:: f \mid c \sim \mathcal{N}(\mu_c, W), \quad \mu_c \sim \mathcal{N}(0, B), \qquad
          p(f_k \mid c) = \mathcal{N}\Bigl(f_k;\; V_c W^{-1} \sum_{j \ne k} r_{jc} f_j,\;
          W + V_c\Bigr), \quad V_c = \Bigl(B^{-1} + \sum_{j \ne k} r_{jc} W^{-1}\Bigr)^{-1}

What an object itself says of a class is left out of what the class says of it. A class that no
other object is of is as likely as B and W allow: an object that is unlike all of the class it is
voted for may be the only one of another. W, B and r are found in turns. The exponents are below
what independent votes and channels would have, since neither are independent.

References:
    Ioffe, Probabilistic Linear Discriminant Analysis (2006). Prince and Elder, Probabilistic Linear
    Discriminant Analysis for Inferences About Identity (2007), section 2.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg._check import check_range
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.threads import one_torch_thread
from splatseg.errors import RangeError
from splatseg.lift.object_classes.pooling import PooledObjects

_ROWS = 1 << 14
"""Numbers of objects x classes handled at a time, times the components."""

_LEAST = 0.02
"""Share of the variance of a component that is at least within, and at least between classes."""

_CONSTANT = 1e-9
"""Variance, as a share of the largest, below which a component is rounding."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectClassOptions:
    """How votes and features are weighed."""

    vote_exponent: float = 2.0
    """Kappa: how many votes those of all views are worth."""

    feature_exponent: float = 0.1
    """Tau: how many independent measurements a component of a feature is worth. 0 takes votes
    alone."""

    vote_floor: float = 0.01
    """Epsilon: the share that a class has without votes, above 0."""

    feature_components: int = 16
    """Principal components of objects' features that are compared."""

    shrinkage: float = 0.1
    """Share, in [0, 1], by which the covariance within classes is drawn to a multiple of the
    identity."""

    full_votes: float = 2000.0
    """Votes, in fully visible pixels, from which on an object counts fully for its class; one with
    fewer counts in proportion."""

    category_rounds: int = 10
    """Rounds in which categories of tracks are told apart by object
    (`lift.object_classes.with_categories`), at least 1."""

    rounds: int = 8
    """Turns in which classes and covariances are found, at least 1."""

    def __post_init__(self) -> None:
        convert_fields(self)
        for name in ("vote_exponent", "feature_exponent", "full_votes"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise RangeError(f"{name}: expected 0 or more, got {value}.")
        if not 0 < self.vote_floor <= 1:
            raise RangeError(f"vote_floor: expected above 0 and at most 1, got {self.vote_floor}.")
        check_range("shrinkage", self.shrinkage, 0.0, 1.0)
        for name in ("feature_components", "rounds", "category_rounds"):
            if getattr(self, name) < 1:
                raise RangeError(f"{name}: expected at least 1, got {getattr(self, name)}.")


@boundary
def classify_objects(
    objects: PooledObjects, *, options: ObjectClassOptions | None = None
) -> Float[Tensor, "objects classes"]:
    """Probabilities of classes, float64; rows of zeros for objects without a vote.

    The result does not depend on the number of threads.
    """
    options = options or ObjectClassOptions()
    with one_torch_thread():
        return _classified(objects, options)


def _classified(objects: PooledObjects, options: ObjectClassOptions) -> Tensor:
    total = objects.votes.sum(dim=1)
    voted = total > 0
    found = torch.zeros_like(objects.votes)
    if not bool(voted.any()):
        return found
    shares = objects.votes[voted] / total[voted, None]
    votes = options.vote_exponent * torch.log(shares + options.vote_floor)
    answers = torch.softmax(votes, dim=1)
    known = objects.known[voted]
    weight = (total[voted] / max(options.full_votes, 1e-300)).clamp_max(1.0) * known
    whitened = _whitened(objects.features[voted], weight, options.feature_components)
    if options.feature_exponent > 0 and whitened.shape[1]:
        for _ in range(options.rounds):
            likelihood = _log_likelihood(whitened, answers, weight, options.shrinkage)
            likelihood[~known] = 0
            answers = torch.softmax(votes + options.feature_exponent * likelihood, dim=1)
    found[voted] = answers
    return found


def _whitened(features: Tensor, weight: Tensor, components: int) -> Float[Tensor, "k components"]:
    """Principal components with mean 0 and variance 1; channels have variance 1 before."""
    total = weight.sum()
    if not float(total) > 0:
        return features[:, :0]
    centred = features - (features * weight[:, None]).sum(dim=0) / total
    variance = (centred.square() * weight[:, None]).sum(dim=0) / total
    varied = variance > _CONSTANT * variance.max()
    centred = centred[:, varied] / variance[varied].sqrt()
    covariance = (centred * weight[:, None]).T @ centred / total
    values, axes = torch.linalg.eigh(covariance)
    values, axes = values.flip(0)[:components], axes.flip(1)[:, :components]
    kept = values > _CONSTANT * values.max() if len(values) else values > 0
    return centred @ axes[:, kept] / values[kept].sqrt()


def _log_likelihood(
    features: Float[Tensor, "k d"],
    answers: Float[Tensor, "k classes"],
    weight: Float[Tensor, "k"],
    shrinkage: float,
) -> Float[Tensor, "k classes"]:
    """Log p(f | c) without the object's own say, up to what is common to all classes."""
    counted = answers * weight[:, None]
    size = counted.sum(dim=0)
    within, axes = torch.linalg.eigh(_within(features, counted, size, shrinkage))
    within = within.clamp(_LEAST, 1 - _LEAST)
    between = 1 - within
    # In these axes both covariances are diagonal: their sum is that of all, the identity.
    turned = features @ axes
    sums = counted.T @ turned
    found = torch.empty_like(answers)
    step = max(1, _ROWS // max(answers.shape[1], 1))
    for start in range(0, len(features), step):
        rows = slice(start, start + step)
        others = size - counted[rows]
        other_sums = sums - counted[rows, :, None] * turned[rows, None, :]
        spread = 1 / (1 / between + others[..., None] / within)
        mean = spread * other_sums / within
        variance = within + spread
        distance = (turned[rows, None, :] - mean).square() / variance + variance.log()
        found[rows] = -0.5 * distance.sum(dim=2)
    return found


def _within(features: Tensor, counted: Tensor, size: Tensor, shrinkage: float) -> Tensor:
    """Covariance within classes, of as many degrees of freedom as there are."""
    scatter = features.T @ (features * counted.sum(dim=1, keepdim=True))
    sums = counted.T @ features
    scatter -= (sums / size.clamp_min(1e-300)[:, None]).T @ sums
    effective = size.square() / counted.square().sum(dim=0).clamp_min(1e-300)
    freedom = (size * (1 - 1 / effective.clamp_min(1))).sum()
    dimensions = features.shape[1]
    if not float(freedom) > 0:
        return torch.eye(dimensions, dtype=features.dtype) * 0.5
    covariance = scatter / freedom
    level = covariance.diagonal().mean()
    identity = torch.eye(dimensions, dtype=features.dtype)
    return (1 - shrinkage) * covariance + shrinkage * level * identity
