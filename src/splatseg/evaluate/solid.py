r"""Scores in 3D: of Gaussians against true labels of Gaussians, and of points.

On Gaussians, IoU counts each as one, or by its opacity, or by the matter it stands for:

.. math:: m_i = o_i \cdot \tfrac{4}{3} \pi \, s_{i1} s_{i2} s_{i3}

the volume of the ellipsoid at one standard deviation times the opacity. Counting favours
surfaces with many small Gaussians, volume a few large ones: say which was used.

On points, each point takes a label from the Gaussians around it, and labels of points are scored
as pixels are: void points are left out, points without a label are wrong.
"""

import math
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg._check import check_choice, check_finite, check_range, check_shape
from splatseg.core import UNLABELLED, Gaussians
from splatseg.core.rigid import rotation_from_quaternion
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.evaluate.metrics import Confusion, SemanticScore, semantic_score
from splatseg.neighbours import NeighbourIndex

GaussianWeight = Literal["count", "opacity", "volume"]
"""What a Gaussian counts in a score."""

PointRule = Literal["weighted", "nearest"]
"""How points take labels from Gaussians."""

NEIGHBOURS = 16
"""Gaussians that have a say at a point, the nearest by centre."""

MIN_OPACITY = 0.1
"""Gaussians fainter than this have none, as in OpenGaussian's protocol on ScanNet."""

_POINTS = 16384


def gaussian_weights(gaussians: Gaussians, *, by: GaussianWeight) -> Float[Tensor, "n"]:
    """What each Gaussian counts, float64: 1, its opacity, or its opacity times its volume."""
    check_choice("by", by, ("count", "opacity", "volume"))
    opacities = gaussians.opacities.detach().double().cpu()
    if by == "count":
        return torch.ones_like(opacities)
    if by == "opacity":
        return opacities
    return opacities * 4 / 3 * math.pi * gaussians.scales.detach().double().cpu().prod(dim=1)


def gaussian_score(
    predicted: Int[Tensor, "n"],
    truth: Int[Tensor, "n"],
    *,
    weights: Float[Tensor, "n"] | None = None,
) -> SemanticScore:
    """Score labels of Gaussians against true ones.

    Args:
        predicted: Ids, -1 none, which is wrong.
        truth: Ids, -1 void, which does not count.
        weights: What each counts, see `gaussian_weights`; None is one each.

    Raises:
        ShapeError: If the numbers of rows differ.
        RangeError: If a weight is negative or not finite.
        InputError: If all are void, or weigh nothing.
    """
    return semantic_score(Confusion.of(predicted, truth, weights))


def labels_of_points(
    gaussians: Gaussians,
    ids: Int[Tensor, "n"],
    points: Float[Tensor, "p 3"],
    *,
    rule: PointRule = "weighted",
    neighbours: int = NEIGHBOURS,
    min_opacity: float = MIN_OPACITY,
) -> Int[Tensor, "p"]:
    r"""The label that Gaussians give to points in the world.

    ``nearest`` takes that of the Gaussian with the nearest centre. ``weighted`` lets the nearest
    ones vote with their density at the point x,

    .. math:: s_c(x) = \sum_i [\mathrm{id}_i = c] \, o_i
              \exp\left(-\tfrac{1}{2} (x - \mu_i)^\top \Sigma_i^{-1} (x - \mu_i)\right)

    where no label competes as one more id. Equal votes go to the smaller id, and no label loses
    them; where no density reaches, the nearest centre decides.

    Args:
        gaussians: The Gaussians of the scene.
        ids: Their labels, -1 none.
        points: Places in the world, scene units.
        rule: How points take labels.
        neighbours: Gaussians that vote at a point, the nearest by centre, at least 1.
        min_opacity: Fainter Gaussians are not there, in [0, 1].

    Returns:
        int32 ids, -1 none.

    Raises:
        ShapeError: If `ids` has another number of rows than `gaussians`.
        RangeError: If an argument is out of range, or a point not finite.
        InputError: If no Gaussian is opaque enough.
    """
    check_choice("rule", rule, ("weighted", "nearest"))
    check_range("min_opacity", min_opacity, 0.0, 1.0)
    check_shape("points", points, (None, 3))
    check_finite("points", points)
    if neighbours < 1:
        raise RangeError(f"neighbours: expected at least 1, got {neighbours}.")
    if len(ids) != len(gaussians):
        raise ShapeError(f"ids: expected {len(gaussians)} rows, one a Gaussian, got {len(ids)}.")
    solid = gaussians.opacities.detach().cpu() >= min_opacity
    count = int(solid.sum())
    if not count:
        raise InputError(f"gaussians: expected one with an opacity of {min_opacity:g} or more.")
    there = gaussians[solid.to(gaussians.means.device)].to(device="cpu", dtype=torch.float64)
    kept = ids.cpu().int()[solid]
    return _labels_at(there, kept, points, rule=rule, neighbours=min(neighbours, count))


def _labels_at(
    gaussians: Gaussians,
    ids: Int[Tensor, "n"],
    points: Float[Tensor, "p 3"],
    *,
    rule: PointRule,
    neighbours: int,
) -> Int[Tensor, "p"]:
    """The rules of `labels_of_points` among Gaussians that are all there, a block at a time."""
    index = NeighbourIndex(gaussians)
    count = 1 if rule == "nearest" else neighbours
    # Rows of whitening matrices: |S^-1 R^T (x - mean)| is the Mahalanobis distance.
    rotations = rotation_from_quaternion(gaussians.rotations)
    scales = gaussians.scales.clamp_min(1e-12)
    out = torch.full((len(points),), UNLABELLED, dtype=torch.int32)
    for start in range(0, len(points), _POINTS):
        part = points[start : start + _POINTS].detach().cpu().double()
        found = index.nearest(part, count).indices
        at = ids[found]
        if rule == "nearest":
            out[start : start + _POINTS] = at[:, 0]
            continue
        offsets = part[:, None] - gaussians.means[found]
        local = torch.einsum("pkji,pkj->pki", rotations[found], offsets) / scales[found]
        density = gaussians.opacities[found] * torch.exp(-0.5 * local.square().sum(dim=-1))
        out[start : start + _POINTS] = _winners(at, density)
    return out


def labels_from_points(
    gaussians: Gaussians,
    points: Float[Tensor, "p 3"],
    ids: Int[Tensor, "p"],
    *,
    reach: float,
) -> Int[Tensor, "n"]:
    """True labels of Gaussians from labelled points: that of the point nearest to each centre.

    Args:
        gaussians: The Gaussians of the scene.
        points: Places in the world, scene units, at least one.
        ids: Their labels, -1 none.
        reach: Gaussians farther than this from every point are void, scene units, above 0.

    Returns:
        int32 ids, -1 void.

    Raises:
        ShapeError: If there is not one id a point.
        RangeError: If `reach` is not above 0, or a point not finite.
        InputError: If there is no point.
    """
    check_shape("points", points, (None, 3))
    check_shape("ids", ids, (len(points),))
    check_finite("points", points)
    if not reach > 0:
        raise RangeError(f"reach: expected a distance above 0, got {reach}.")
    if not len(points):
        raise InputError("points: expected at least one point, got none.")
    found = NeighbourIndex(points.cpu()).nearest(gaussians.means.cpu(), 1)
    near = found.distances[:, 0] <= reach
    return torch.where(near, ids.cpu().int()[found.indices[:, 0]], UNLABELLED).int()


def _winners(ids: Int[Tensor, "p k"], votes: Float[Tensor, "p k"]) -> Int[Tensor, "p"]:
    """The id of each row with the largest sum of votes; the first one's where there are none."""
    totals = torch.zeros_like(votes)
    for rank in range(ids.shape[1]):
        totals += votes[:, rank : rank + 1] * (ids == ids[:, rank : rank + 1])
    # Sums of equal ids are added in one order, so that they are equal to the last bit.
    best = totals >= totals.max(dim=1, keepdim=True).values
    last = torch.iinfo(torch.int32).max
    named = torch.where(ids == UNLABELLED, last, ids)
    winner = torch.where(best, named, last).min(dim=1).values
    winner = torch.where(winner == last, UNLABELLED, winner)
    return torch.where(votes.sum(dim=1) > 0, winner, ids[:, 0]).int()
