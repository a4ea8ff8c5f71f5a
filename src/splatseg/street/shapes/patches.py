"""Local patches of surfaces, cut out of a cloud of points voxel by voxel."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg._check import check_finite, check_range, check_shape
from splatseg.core.boundary import boundary
from splatseg.errors import RangeError

_THINNING = 14
"""Cells along a voxel, of which one point each is kept: patches are covered evenly."""


def primitive_scale(voxel_size: float) -> float:
    """Length of the unit of a primitive in a voxel: from its middle to a corner.

    Example:
        >>> round(primitive_scale(1.0), 3)
        0.866
    """
    return voxel_size * 0.5 * math.sqrt(3)


@boundary
def cut_patches(
    points: Float[Tensor, "n 3"],
    *,
    voxel_size: float,
    count: int,
    min_points: int,
    generator: torch.Generator,
) -> Float[Tensor, "m count 3"]:
    """Patches of a cloud in the voxels of a grid, each in the frame and unit of its primitive.

    Points are thinned first, to one in each cell of a 14th of a voxel, so that no camera's
    nearness shows. The frame's origin is the mean of a patch, where geometry puts primitives; its
    unit is `primitive_scale`.

    Args:
        points: On surfaces, in any order.
        voxel_size: Of the grid, in the unit of the points. The grid starts at a random place.
        count: Points of a patch; drawn again where a voxel has fewer.
        min_points: Thinned points that a voxel needs.
        generator: Of what is drawn.

    Returns:
        Patches in the order of their voxels.

    Raises:
        RangeError: If sizes or counts are not positive, or points not finite.
    """
    check_shape("points", points, (None, 3))
    check_finite("points", points)
    if not 0 < voxel_size < math.inf:
        raise RangeError(f"voxel_size: expected a positive length, got {voxel_size:g}.")
    check_range("count", count, 1, 1_000_000)
    check_range("min_points", min_points, 1, 1_000_000)
    if not len(points):
        return points.new_zeros(0, count, 3)
    start = voxel_size * torch.rand(3, generator=generator).to(points)
    place = (points + start) / voxel_size
    points = points[_one_each(torch.floor(place * _THINNING).long(), generator)]
    voxels = torch.floor((points + start) / voxel_size).long()
    _, which = torch.unique(voxels, dim=0, return_inverse=True)
    order = torch.argsort(which, stable=True)
    sizes = torch.bincount(which)
    found: list[Tensor] = []
    for rows in torch.split(order, sizes.tolist()):
        if len(rows) >= min_points:
            patch = points[rows]
            drawn = torch.randperm(len(rows), generator=generator)[:count]
            more = torch.randint(len(rows), (count - len(drawn),), generator=generator)
            # The mean of all, not of those drawn: that is where the primitive will stand.
            found.append(patch[torch.cat((drawn, more))] - patch.mean(dim=0))
    if not found:
        return points.new_zeros(0, count, 3)
    return torch.stack(found) / primitive_scale(voxel_size)


def _one_each(cells: Tensor, generator: torch.Generator) -> Tensor:
    """A row of each cell, drawn at random, ascending."""
    order = torch.randperm(len(cells), generator=generator)
    _, which = torch.unique(cells[order], dim=0, return_inverse=True)
    first = torch.full((int(which.max()) + 1,), len(order), dtype=torch.int64)
    first.scatter_reduce_(0, which, torch.arange(len(order)), reduce="amin")
    return order[first].sort().values
