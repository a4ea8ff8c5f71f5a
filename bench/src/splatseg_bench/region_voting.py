r"""Region voting: a point takes the label that most centres of Gaussians around it have.

.. math:: \mathrm{id}(x) = \arg\max_c \sum_{i:\; |\mu_i - x| \le r} g_i\, [a_i = c]

over the ball of eq. 9 of the mesh-based street field, which compares itself with Street Gaussians
in this way; without a centre in the ball the label is undefined. As published each centre has one
vote (:math:`g_i = 1`). That counts what densification made many of and what no view ever sees;
with weights :math:`g_i`, such as how much all views saw each Gaussian, :math:`W^\top 1`, it is made
fair to Gaussians.

References:
    DNMP with semantics (papers/002), section 4.2 and eq. 9.
    Yan et al., Street Gaussians (ECCV 2024).
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core import UNLABELLED, Gaussians, PointLabels
from splatseg.core.boundary import boundary
from splatseg.errors import RangeError
from splatseg.neighbours import NeighbourIndex

_POINTS = 4096
_MAX_PAIRS = 1 << 25


@boundary
def region_labels(
    gaussians: Gaussians,
    ids: Int[Tensor, "n"],
    points: Float[Tensor, "p 3"],
    *,
    weights: Float[Tensor, "n"] | None = None,
    radius: float = 0.5,
) -> PointLabels:
    """The label of most centres in a ball around each point.

    Equal votes go to the smaller id; centres without a label have none.

    Args:
        gaussians: The Gaussians of the scene.
        ids: Their labels, -1 none.
        points: Positions in the world, scene units.
        weights: What the vote of each centre counts; None is 1, as published. Those of weight 0
            have none.
        radius: Of the ball, scene units.

    Returns:
        Ids, -1 where no centre votes, and as confidence the winner's share of the votes.

    Raises:
        ShapeError: If there is not one id or weight a Gaussian, or points are not (p, 3).
        RangeError: If a point or weight is not finite, or the radius not above 0.
    """
    if not radius > 0:
        raise RangeError(f"radius: expected more than 0, got {radius}.")
    check_shape("points", points, (None, 3))
    check_finite("points", points)
    check_shape("ids", ids, (len(gaussians),))
    given = torch.ones(len(gaussians)) if weights is None else weights.detach().cpu().double()
    check_shape("weights", given, (len(gaussians),))
    check_finite("weights", given)
    known = ids.detach().cpu().long()
    voting = (known != UNLABELLED) & (given > 0)
    present, column = torch.unique(known[voting], return_inverse=True)
    out = torch.full((len(points),), UNLABELLED, dtype=torch.int32)
    confidence = torch.zeros(len(points))
    if not len(present):
        return PointLabels(ids=out, confidence=confidence)
    index = NeighbourIndex(gaussians.means.detach().cpu().double()[voting])
    weight = given.double()[voting]
    for start in range(0, len(points), _POINTS):
        part = slice(start, start + _POINTS)
        found = index.within(points[part].detach().cpu().double(), radius, max_pairs=_MAX_PAIRS)
        votes = torch.zeros(len(found), len(present), dtype=torch.float64)
        at = found.queries * len(present) + column[found.indices]
        votes.view(-1).index_add_(0, at, weight[found.indices])
        best, winner = votes.max(dim=1)
        total = votes.sum(dim=1)
        some = total > 0
        out[part] = torch.where(some, present[winner], UNLABELLED).int()
        confidence[part] = torch.where(some, best / total.clamp_min(1e-30), 0.0).float()
    return PointLabels(ids=out, confidence=confidence)
