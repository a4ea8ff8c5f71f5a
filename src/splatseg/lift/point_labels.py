r"""Labels of points of the world, from the Gaussians around them.

The nearest Gaussians vote with their density at the point x, as they do in a label field
:math:`\sum_i o_i G_i(x) a_i` of which an image shows the integral along a ray:

.. math:: d_i(x) = o_i \exp\left(-\tfrac{1}{2} (x - \mu_i)^\top \Sigma_i^{-1} (x - \mu_i)\right),
          \qquad \mathrm{id}(x) = \arg\max_c \sum_i d_i(x)\, a_{ic}

with :math:`a_{ic}` as in `splatseg.lift.label_map`: 1 for the id of a Gaussian. Trained features
are read as in views (`splatseg.lift.label_maps`), with :math:`d_i / \sum_j d_j` for blending
weights.

References:
    Wu et al., OpenGaussian (NeurIPS 2024): points of ScanNet take labels of Gaussians, faint
    ones left out.
    Kerbl et al., 3D Gaussian Splatting (2023), eq. 4: the density.
"""

from collections.abc import Iterator
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatseg._check import check_finite, check_rows, check_shape
from splatseg.core import UNLABELLED, Features, Gaussians, PointLabels
from splatseg.core.boundary import boundary
from splatseg.core.options import Positive, Share, options
from splatseg.core.rigid import rotation_from_quaternion
from splatseg.errors import InputError, ShapeError
from splatseg.lift.label_maps import ClassifierHead
from splatseg.neighbours import NeighbourIndex

PointRule = Literal["weighted", "nearest"]
"""How points take labels from Gaussians."""

_POINTS = 16384


NEIGHBOURS = 16
"""Gaussians that vote at a point, the nearest by centre."""


@options(removed={"neighbours": "the 16 nearest Gaussians vote at a point"})
class PointLabelOptions:
    """How points take labels from Gaussians."""

    rule: PointRule = "weighted"
    """weighted: by the density there of the Gaussians around it. nearest: that of the nearest
    centre."""

    min_opacity: Share = 0.1
    """Fainter Gaussians are not there, in [0, 1]; as in OpenGaussian's protocol on ScanNet."""

    max_mahalanobis: Positive | None = None
    """weighted: standard deviations beyond which a Gaussian does not reach a point, which has no
    label where none does. None lets every density count, and the nearest centre where there is
    none."""


@boundary
def labels_of_points(
    gaussians: Gaussians,
    ids: Int[Tensor, "n"],
    points: Float[Tensor, "p 3"],
    *,
    options: PointLabelOptions | None = None,
) -> PointLabels:
    r"""The labels that labels of Gaussians give to points in the world.

    No label competes as one more id. Equal votes go to the smaller id, and no label loses them;
    where no density reaches, the nearest centre decides, with a confidence of 0, or nothing does
    where `PointLabelOptions.max_mahalanobis` is given.

    Args:
        gaussians: The Gaussians of the scene.
        ids: Their labels, -1 none.
        points: Positions in the world, scene units.
        options: How points take labels.

    Returns:
        Ids, and as confidence the winner's share of the density.

    Raises:
        ShapeError: If `ids` has another number of rows than `gaussians`, or points are not (p, 3).
        RangeError: If a point is not finite.
        InputError: If no Gaussian is opaque enough.
    """
    check_shape("points", points, (None, 3))
    if ids.ndim != 1 or len(ids) != len(gaussians):
        raise ShapeError(f"ids: expected {len(gaussians)} rows, one a Gaussian, got {len(ids)}.")
    known = ids.cpu().int()
    out = torch.full((len(points),), UNLABELLED, dtype=torch.int32)
    confidence = torch.zeros(len(points))
    options = options or PointLabelOptions()
    for part, rows, density in _around(gaussians, points, options):
        out[part], confidence[part] = _winners(known[rows], density)
        out[part][_out_of_reach(density, options)] = UNLABELLED
    return PointLabels(ids=out, confidence=confidence)


def classified_points(
    gaussians: Gaussians,
    features: Features,
    head: ClassifierHead,
    points: Float[Tensor, "p 3"],
    *,
    options: PointLabelOptions | None = None,
) -> PointLabels:
    """The labels that features of Gaussians with a classifier give to points in the world.

    Where the head renders features, their mean by density is classified. Where it renders
    probabilities, the mean of these decides, and what Gaussians with a weight of 0 have of the
    density stands for no label. Where no density reaches, the nearest centre alone counts.

    Args:
        gaussians: The Gaussians of the scene.
        features: Their features.
        head: The classifier.
        points: Positions in the world, scene units.
        options: How points take labels.

    Returns:
        Ids, and as confidence the winner's probability.

    Raises:
        ShapeError: If `features` has another number of rows than `gaussians`, or points are not
            (p, 3).
        RangeError: If a point is not finite.
        InputError: If no Gaussian is opaque enough.
    """
    check_shape("points", points, (None, 3))
    check_rows("features", features, len(gaussians))
    values = features.values.cpu()
    weights = None if features.weights is None else features.weights.cpu()
    out = torch.full((len(points),), UNLABELLED, dtype=torch.int32)
    confidence = torch.zeros(len(points))
    options = options or PointLabelOptions()
    for part, rows, density in _around(gaussians, points, options):
        share = _shares(density).float()
        mean = None
        for rank in range(rows.shape[1]):
            own = values[rows[:, rank]]
            if head.blend == "probabilities":
                own = head.probabilities(own)
                if weights is not None:
                    own = own * (weights[rows[:, rank]] > 0)[:, None]
            term = share[:, rank : rank + 1] * own
            mean = term if mean is None else mean + term
        if mean is None:
            continue
        scores = head.probabilities(mean) if head.blend == "features" else mean
        best, index = scores.max(dim=-1)
        nothing = 1 - scores.sum(dim=-1) if head.blend == "probabilities" else -torch.ones(())
        labelled = best >= nothing
        out[part] = torch.where(labelled, head.ids[index], UNLABELLED).int()
        confidence[part] = torch.where(labelled, best, nothing).clamp(0, 1)
        beyond = _out_of_reach(density, options)
        out[part][beyond], confidence[part][beyond] = UNLABELLED, 0.0
    return PointLabels(ids=out, confidence=confidence)


def _around(
    gaussians: Gaussians, points: Float[Tensor, "p 3"], options: PointLabelOptions
) -> Iterator[tuple[slice, Int[Tensor, "m k"], Float[Tensor, "m k"]]]:
    """Which points, the rows of the Gaussians around each, nearest first, and their densities.

    A block of points at a time.
    """
    check_finite("points", points)
    solid = gaussians.opacities.detach().cpu() >= options.min_opacity
    rows = torch.nonzero(solid).squeeze(1)
    if not len(rows):
        raise InputError(
            f"gaussians: expected one with an opacity of {options.min_opacity:g} or more."
        )
    there = gaussians[solid.to(gaussians.means.device)].to(device="cpu", dtype=torch.float64)
    index = NeighbourIndex(there)
    nearest = options.rule == "nearest"
    count = 1 if nearest else min(NEIGHBOURS, len(rows))
    # Rows of whitening matrices: |S^-1 R^T (x - mean)| is the Mahalanobis distance.
    rotations = rotation_from_quaternion(there.rotations)
    scales = there.scales.clamp_min(1e-12)
    for start in range(0, len(points), _POINTS):
        part = slice(start, start + _POINTS)
        at = points[part].detach().cpu().double()
        found = index.nearest(at, count).indices
        if nearest:
            yield part, rows[found], torch.ones(found.shape, dtype=torch.float64)
            continue
        offsets = at[:, None] - there.means[found]
        local = torch.einsum("pkji,pkj->pki", rotations[found], offsets) / scales[found]
        squared = local.square().sum(dim=-1)
        density = there.opacities[found] * torch.exp(-0.5 * squared)
        if options.max_mahalanobis is not None:
            density = torch.where(squared <= options.max_mahalanobis**2, density, 0.0)
        yield part, rows[found], density


def _out_of_reach(density: Float[Tensor, "m k"], options: PointLabelOptions) -> Bool[Tensor, "m"]:
    """Points that have no label because no Gaussian reaches them."""
    none = density.sum(dim=1) <= 0
    return none if options.max_mahalanobis is not None else torch.zeros_like(none)


def _shares(density: Float[Tensor, "m k"]) -> Float[Tensor, "m k"]:
    """Densities that add up to 1; all of it the nearest one's where there is none."""
    total = density.sum(dim=1, keepdim=True)
    nearest = torch.zeros_like(density)
    nearest[:, 0] = 1
    return torch.where(total > 0, density / torch.where(total > 0, total, 1.0), nearest)


def _winners(
    ids: Int[Tensor, "m k"], votes: Float[Tensor, "m k"]
) -> tuple[Int[Tensor, "m"], Float[Tensor, "m"]]:
    """The id of each row with the largest sum of votes, and its share of them.

    Without votes it is the first one's, with a share of 0.
    """
    totals = torch.zeros_like(votes)
    for rank in range(ids.shape[1]):
        totals += votes[:, rank : rank + 1] * (ids == ids[:, rank : rank + 1])
    # Sums of equal ids are added in one order, so that they are equal to the last bit.
    largest = totals.max(dim=1, keepdim=True).values
    last = torch.iinfo(torch.int32).max
    named = torch.where(ids == UNLABELLED, last, ids)
    winner = torch.where(totals >= largest, named, last).min(dim=1).values
    winner = torch.where(winner == last, UNLABELLED, winner)
    voted = votes.sum(dim=1)
    share = largest[:, 0] / torch.where(voted > 0, voted, 1.0)
    return torch.where(voted > 0, winner, ids[:, 0]).int(), share.float().clamp(0, 1)
