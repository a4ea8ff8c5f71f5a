r"""How much of the disagreement of votes is between the Gaussians of an object.

Votes y of the Gaussians of an object k disagree because views do, and then each Gaussian has the
mixture of all; or because the object is not one, and then each is voted for something else. With
masses m and the mean :math:`\bar y_k` of an object,

.. math:: \eta = \frac{\sum_k M_k (T_k - W_k)}{\sum_k M_k T_k}, \qquad
          T_k = 1 - \sum_c \bar y_{kc}^2, \qquad
          W_k = \tfrac{1}{M_k} \sum_{i \in k} m_i \bigl(1 - \sum_c y_{ic}^2\bigr)

0: all Gaussians of each object are voted for alike; 1: each of them is sure, and they differ. It is
the intraclass correlation of votes, for categories.

References:
    Light and Margolin, An Analysis of Variance for Categorical Data, JASA 66 (1971), eq. 2.5.
"""

import torch

from splatseg.core import UNLABELLED, Labels
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, ShapeError

_MOST = 20.0
"""Mass, in fully visible pixels, that a Gaussian counts at most, so that what fills the images does
not decide alone."""


@boundary
def heterogeneity(objects: Labels, votes: Labels) -> float:
    """Share of the disagreement of votes, in [0, 1], that is between Gaussians of one object.

    Args:
        objects: Which object each Gaussian is of.
        votes: A soft layer of the same Gaussians, with the evidence that its votes rest on.

    Returns:
        Eta; 0 where votes do not disagree.

    Raises:
        ShapeError: If they are not of as many Gaussians.
        InputError: If the votes are hard, or without evidence.
    """
    if len(objects) != len(votes):
        raise ShapeError(f"votes: expected {len(objects)} rows, got {len(votes)}.")
    if votes.candidates is None or votes.shares is None or votes.evidence is None:
        raise InputError("votes: expected a soft layer with evidence, got one without.")
    object_ids, shares = objects.ids.cpu().long(), votes.shares.cpu().double()
    mass = votes.evidence.cpu().double().clamp(0, _MOST)
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
