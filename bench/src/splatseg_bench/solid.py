r"""Scores in 3D: of Gaussians against true labels of Gaussians, and of points.

On Gaussians, IoU counts each as one, or by its opacity, or by the matter it stands for:

.. math:: m_i = o_i \cdot \tfrac{4}{3} \pi \, s_{i1} s_{i2} s_{i3}

the volume of the ellipsoid at one standard deviation times the opacity. Counting favours
surfaces with many small Gaussians, volume a few large ones: say which was used.

Points take labels from the Gaussians around them (`splatseg.lift.labels_of_points`), and labels of
points are scored as pixels are: void points are left out, points without a label are wrong.
"""

import math
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg._check import check_choice, check_finite, check_shape
from splatseg.core import UNLABELLED, Gaussians
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, RangeError
from splatseg.evaluate.metrics import Confusion, SemanticScore, semantic_score
from splatseg.neighbours import NeighbourIndex

GaussianWeight = Literal["count", "opacity", "volume"]
"""What a Gaussian counts in a score."""


@boundary
def gaussian_weights(gaussians: Gaussians, *, by: GaussianWeight) -> Float[Tensor, "n"]:
    """What each Gaussian counts, float64: 1, its opacity, or its opacity times its volume."""
    check_choice("by", by, ("count", "opacity", "volume"))
    opacities = gaussians.opacities.detach().double().cpu()
    if by == "count":
        return torch.ones_like(opacities)
    if by == "opacity":
        return opacities
    return opacities * 4 / 3 * math.pi * gaussians.scales.detach().double().cpu().prod(dim=1)


@boundary
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


@boundary
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
