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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatseg.core import UNLABELLED, Labels
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, RangeError, ShapeError

VOTE_EXPONENT = 2.0
"""Kappa: how many votes those of all views are worth."""

FEATURE_EXPONENT = 0.1
"""Tau: how many independent measurements a component of a feature is worth."""

VOTE_FLOOR = 0.01
"""Epsilon: the share that a class has without votes."""

FEATURE_COMPONENTS = 16
"""Principal components of objects' features that are compared."""

SHRINKAGE = 0.1
"""Share by which the covariance within classes is drawn to a multiple of the identity."""

FULL_VOTES = 2000.0
"""Votes, in fully visible pixels, from which on an object counts fully for its class; one with
fewer counts in proportion."""

ROUNDS = 8
"""Turns in which classes and covariances are found."""

CATEGORY_ROUNDS = 10
"""Rounds of expectation maximization in which categories of tracks are told apart by object."""

_MAX_MASS = 20.0
"""Mass, in fully visible pixels, that a Gaussian counts at most, so that what fills the images does
not decide alone."""

_NOTHING = 1e-12
"""Below this what a track is expected to be taken for is none."""

_MIN_VARIANCE = 0.02
"""Share of the variance of a component that is at least within, and at least between classes."""

_CONSTANT = 1e-9
"""Variance, as a share of the largest, below which a component is rounding."""

_SUMMED = 1 << 16
"""Gaussians whose features are summed at a time."""

_ROWS = 1 << 14
"""Numbers of objects x classes handled at a time, times the components."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PooledObjects:
    """What all pixels say of each object."""

    ids: Int64[Tensor, "objects"]
    """Ids of the objects, ascending."""

    classes: Int64[Tensor, "classes"]
    """Ids that are voted for, ascending."""

    votes: Float[Tensor, "objects classes"]
    """float64, in fully visible pixels."""

    features: Float[Tensor, "objects channels"]
    """float64; zeros of an object that nothing is known of."""

    known: Bool[Tensor, "objects"]
    """Objects that have a feature."""


@boundary
def pool_objects(
    objects: Labels,
    votes: Labels,
    scales: Sequence[Float[Tensor, "n channels"]],
    weights: Float[Tensor, "n"],
) -> PooledObjects:
    r"""Sum votes and features over objects.

    .. math:: v_{kc} = \sum_{i \in k} v_{ic}, \qquad
              f_k = \frac{\sum_{i \in k} m_i f_i}{\sum_{i \in k} m_i}

    with :math:`v_{ic}` the votes of pixels for id c on Gaussian i and :math:`m_i` the blending
    weight that its feature rests on.

    Args:
        objects: Which object each Gaussian is of; -1 is none.
        votes: Ids that pixels vote for, with the shares of several.
        scales: Features of Gaussians, side by side; at least one array.
        weights: What these rest on; a Gaussian of which there is nothing has 0.

    Raises:
        InputError: If votes have no shares or no evidence, or there are no features.
        ShapeError: If the arrays are not of as many Gaussians.
    """
    if votes.candidates is None or votes.shares is None or votes.evidence is None:
        raise InputError("votes: expected labels with shares of several ids and their evidence.")
    if not scales:
        raise InputError("scales: expected features, got none.")
    sizes = {len(objects), len(votes), len(weights), *map(len, scales)}
    if len(sizes) > 1:
        raise ShapeError(
            "objects, votes, scales, weights: expected rows of the same Gaussians, got "
            f"{sorted(sizes)}."
        )
    names = objects.ids.cpu().long()
    ids, row = torch.unique(names, return_inverse=True)
    if len(ids) and int(ids[0]) == UNLABELLED:
        ids, row = ids[1:], row - 1
    given = votes.candidates.cpu().long()
    classes = torch.unique(given[given != UNLABELLED])
    total = torch.zeros(len(ids) * max(len(classes), 1), dtype=torch.float64)
    mass = votes.shares.cpu().double() * votes.evidence.cpu().double()[:, None]
    for rank in range(given.shape[1]):
        there = (row >= 0) & (given[:, rank] != UNLABELLED)
        column = torch.searchsorted(classes, given[there, rank])
        total.index_add_(0, row[there] * max(len(classes), 1) + column, mass[there, rank])
    features, seen = _features(row, len(ids), scales, weights)
    return PooledObjects(
        ids=ids,
        classes=classes,
        votes=total.reshape(len(ids), max(len(classes), 1))[:, : len(classes)],
        features=features,
        known=seen > 0,
    )


def _features(
    row: Int64[Tensor, "n"], count: int, scales: Sequence[Tensor], weights: Tensor
) -> tuple[Tensor, Tensor]:
    """Weighted means over objects, and the weights they rest on."""
    widths = [scale.shape[1] for scale in scales]
    sums = torch.zeros(count, sum(widths), dtype=torch.float64)
    seen = torch.zeros(count, dtype=torch.float64)
    rows = torch.nonzero((row >= 0) & (weights.cpu() > 0)).squeeze(1)
    for part in rows.split(_SUMMED):
        weight = weights.cpu()[part].double()
        joined = torch.cat([scale[part].double() for scale in scales], dim=1)
        sums.index_add_(0, row[part], joined * weight[:, None])
        seen.index_add_(0, row[part], weight)
    return sums / torch.where(seen > 0, seen, 1.0)[:, None], seen


@boundary
def heterogeneity(objects: Labels, votes: Labels) -> float:
    r"""Share of the disagreement of votes, in [0, 1], that is between Gaussians of one object.

    Votes y of the Gaussians of an object k disagree because views do, and then each Gaussian has
    the mixture of all; or because the object is not one, and then each is voted for something else.
    With masses m and the mean :math:`\bar y_k` of an object,

    .. math:: \eta = \frac{\sum_k M_k (T_k - W_k)}{\sum_k M_k T_k}, \qquad
              T_k = 1 - \sum_c \bar y_{kc}^2, \qquad
              W_k = \tfrac{1}{M_k} \sum_{i \in k} m_i \bigl(1 - \sum_c y_{ic}^2\bigr)

    0: all Gaussians of each object are voted for alike; 1: each of them is sure, and they differ.
    It is the intraclass correlation of votes, for categories.

    Args:
        objects: Which object each Gaussian is of.
        votes: A soft layer of the same Gaussians, with the evidence that its votes rest on.

    Returns:
        Eta; 0 where votes do not disagree.

    Raises:
        ShapeError: If they are not of as many Gaussians.
        InputError: If the votes are hard, or without evidence.

    References:
        Light and Margolin, An Analysis of Variance for Categorical Data, JASA 66 (1971), eq. 2.5.
    """
    if len(objects) != len(votes):
        raise ShapeError(f"votes: expected {len(objects)} rows, got {len(votes)}.")
    if votes.candidates is None or votes.shares is None or votes.evidence is None:
        raise InputError("votes: expected a soft layer with evidence, got one without.")
    object_ids, shares = objects.ids.cpu().long(), votes.shares.cpu().double()
    mass = votes.evidence.cpu().double().clamp(0, _MAX_MASS)
    rows = torch.nonzero((object_ids != UNLABELLED) & (mass > 0)).squeeze(1)
    if not len(rows):
        return 0.0
    objects_there, place = torch.unique(object_ids[rows], return_inverse=True)
    given = votes.candidates.cpu().long()[rows]
    classes, column = torch.unique(given, return_inverse=True)
    shares, mass = shares[rows] * (given != UNLABELLED), mass[rows]
    count, width = len(objects_there), len(classes)
    whole = torch.zeros(count, dtype=torch.float64).index_add_(0, place, mass)
    table = torch.zeros(count * width, dtype=torch.float64)
    for rank in range(given.shape[1]):
        table.index_add_(0, place * width + column[:, rank], shares[:, rank] * mass)
    mean = table.reshape(count, width) / whole[:, None]
    total = float((whole * (1 - mean.square().sum(dim=1))).sum())
    within = float((mass * (1 - shares.square().sum(dim=1))).sum())
    return min(1.0, max(0.0, 1 - within / total)) if total > 1e-12 * float(whole.sum()) else 0.0


@boundary
def with_categories(
    pooled: PooledObjects, categories: Mapping[int, Mapping[int, float]]
) -> PooledObjects:
    r"""Objects with votes for categories, where those for ids are votes for what these are.

    A track covers several objects: what it moved on to, what it bled into. Of track t it is known
    how many of its pixels were taken for category c, :math:`m_{tc}`, and how many are of object k,
    :math:`n_{kt}` (its votes), but not which of them. If pixels of an object are of category c with
    probability :math:`r_{kc}` under every track, expectation maximization of their likelihood gives

    .. math:: r_{kc} \leftarrow \frac{1}{n_k} \sum_t n_{kt} m_{tc} \,
              \frac{r_{kc}}{\sum_{k'} n_{k't} r_{k'c}} \Big/ \text{(sum over c)}, \qquad
              \textstyle\sum_c m_{tc} = \sum_k n_{kt}

    from :math:`r_{kc}` all alike. The first round lets each track vote for all it was taken for, of
    every object alike. Those after it tell the objects of a track apart, by the other tracks over
    them. It is stopped early: the data are few, and the limit explains its noise.

    Args:
        pooled: Objects with votes for ids, such as tracks.
        categories: m: of each id how much speaks for which category, in any unit; one that is not
            known, or of which nothing is known, votes for none.

    Returns:
        The objects, each with as many votes as it has for ids whose categories are known.

    Raises:
        RangeError: If a number is negative or not finite.

    References:
        Dempster, Laird and Rubin, JRSS B 39 (1977). The iteration is that of Richardson (1972) and
        Lucy (1974) for a mixture by known shares; the question is King's, A Solution to the
        Ecological Inference Problem (1997).
    """
    for id, shares in categories.items():
        for number in shares.values():
            if not 0 <= number < float("inf"):
                raise RangeError(f"categories: expected 0 or more of id {id}, got {number}.")
    classes = sorted({kind for shares in categories.values() for kind in shares})
    taken = torch.zeros(len(pooled.classes), len(classes), dtype=torch.float64)
    for row, id in enumerate(pooled.classes.tolist()):
        for kind, number in categories.get(id, {}).items():
            taken[row, classes.index(kind)] = number
    sums = taken.sum(dim=1, keepdim=True)
    taken /= torch.where(sums > 0, sums, 1.0)
    votes = pooled.votes * (sums > 0).T
    answers = _answers(votes, taken * votes.sum(dim=0)[:, None])
    return replace(
        pooled,
        classes=torch.tensor(classes, dtype=torch.int64),
        votes=answers * votes.sum(dim=1, keepdim=True),
    )


def _answers(
    votes: Float[Tensor, "objects tracks"], taken: Float[Tensor, "tracks classes"]
) -> Float[Tensor, "objects classes"]:
    """R; rows of zeros for objects without votes."""
    shape = (len(votes), taken.shape[1])
    answers = torch.full(shape, 1 / max(shape[1], 1), dtype=torch.float64)
    for _ in range(CATEGORY_ROUNDS):
        expected = votes.T @ answers
        ratio = torch.where(expected > _NOTHING, taken / expected.clamp_min(_NOTHING), 0.0)
        answers = answers * (votes @ ratio)
        scale = answers.sum(dim=1, keepdim=True)
        answers = answers / torch.where(scale > 0, scale, 1.0)
    return answers


@boundary
def classify_objects(objects: PooledObjects) -> Float[Tensor, "objects classes"]:
    """Probabilities of classes, float64; rows of zeros for objects without a vote.

    The result does not depend on the number of threads.
    """
    total = objects.votes.sum(dim=1)
    voted = total > 0
    found = torch.zeros_like(objects.votes)
    if not bool(voted.any()):
        return found
    shares = objects.votes[voted] / total[voted, None]
    votes = VOTE_EXPONENT * torch.log(shares + VOTE_FLOOR)
    answers = torch.softmax(votes, dim=1)
    known = objects.known[voted]
    weight = (total[voted] / FULL_VOTES).clamp_max(1.0) * known
    whitened = _whitened(objects.features[voted], weight)
    if whitened.shape[1]:
        for _ in range(ROUNDS):
            likelihood = _log_likelihood(whitened, answers, weight)
            likelihood[~known] = 0
            answers = torch.softmax(votes + FEATURE_EXPONENT * likelihood, dim=1)
    found[voted] = answers
    return found


def _whitened(features: Tensor, weight: Tensor) -> Float[Tensor, "k components"]:
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
    values, axes = values.flip(0)[:FEATURE_COMPONENTS], axes.flip(1)[:, :FEATURE_COMPONENTS]
    kept = values > _CONSTANT * values.max() if len(values) else values > 0
    return centred @ axes[:, kept] / values[kept].sqrt()


def _log_likelihood(
    features: Float[Tensor, "k d"],
    answers: Float[Tensor, "k classes"],
    weight: Float[Tensor, "k"],
) -> Float[Tensor, "k classes"]:
    """Log p(f | c) without the object's own say, up to what is common to all classes."""
    counted = answers * weight[:, None]
    size = counted.sum(dim=0)
    within, axes = torch.linalg.eigh(_within(features, counted, size))
    within = within.clamp(_MIN_VARIANCE, 1 - _MIN_VARIANCE)
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


def _within(features: Tensor, counted: Tensor, size: Tensor) -> Tensor:
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
    return (1 - SHRINKAGE) * covariance + SHRINKAGE * level * identity
