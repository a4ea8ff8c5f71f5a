"""A sparse grid over points, with cells as large as the number asked for wants."""

import math
from typing import Literal

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core import Gaussians
from splatseg.core.boundary import boundary
from splatseg.core.voxels import VoxelGrid, cell_order
from splatseg.errors import InputError, RangeError
from splatseg.neighbours import NeighbourIndex

_STEPS = 40
"""Halvings of the range of sizes: 2^-40 of it is below rounding."""

_CLOSE = 0.005
"""Share of the number asked for that the number found may be less."""

_CELLS_A_POINT = 0.9


@boundary
def voxelise(points: Float[Tensor, "n 3"], size: float) -> VoxelGrid:
    """The cells of a size that have points in them.

    Args:
        points: World, scene units.
        size: Side of a cell, scene units.

    Raises:
        InputError: If there is no point.
        RangeError: If a coordinate is not finite, the size not above 0, or so small that cells
            cannot be counted.
    """
    points = _checked(points)
    if not 0 < size < math.inf:
        raise RangeError(f"size: expected above 0, got {size}.")
    origin = points.amin(dim=0)
    cells = _cells(points, origin, size)
    return VoxelGrid(cells=cells[_first_of_each(cells)], size=size, origin=origin)


@boundary
def voxelise_to_count(points: Float[Tensor, "n 3"], count: int) -> VoxelGrid:
    """The cells of the smallest size of which at most so many have a point in them.

    The size is found by halving: the number of cells falls with their size, but for a few that
    borders move over. It stops at a number within 0.5 % of what was asked for, or at nine cells for
    ten points: finer cells would be those of single points, with nothing but gaps between them.

    Args:
        points: World, scene units.
        count: Cells, at most.

    Raises:
        InputError: If there is no point.
        RangeError: If a coordinate is not finite, or the count is below 1.
    """
    points = _checked(points)
    if count < 1:
        raise RangeError(f"count: expected at least 1, got {count}.")
    count = min(count, math.ceil(_CELLS_A_POINT * len(points)))
    origin = points.amin(dim=0)
    extent = float((points - origin).max())
    # One cell holds all at the upper end; the lower one is the finest that can be counted.
    high = 1.0 if extent == 0 else extent * 1.001
    low = high / 2**19
    found = _cells(points, origin, high)
    for _ in range(_STEPS):
        size = math.sqrt(low * high)
        cells = _cells(points, origin, size)
        occupied = len(_first_of_each(cells))
        if occupied > count:
            low = size
            continue
        high, found = size, cells
        if occupied >= (1 - _CLOSE) * count:
            break
    return VoxelGrid(cells=found[_first_of_each(found)], size=high, origin=origin)


def _checked(points: Tensor) -> Float64[Tensor, "n 3"]:
    check_shape("points", points, (None, 3))
    check_finite("points", points)
    if not len(points):
        raise InputError("points: expected at least one, got none.")
    return points.detach().cpu().double()


def _cells(points: Tensor, origin: Tensor, size: float) -> Int64[Tensor, "n 3"]:
    return torch.floor((points - origin) / size).long()


def _first_of_each(cells: Tensor) -> Int64[Tensor, "m"]:
    """A row of each distinct cell, in the order of cells."""
    key, order = torch.sort(cell_order(cells), stable=True)
    first = torch.ones(len(key), dtype=torch.bool)
    first[1:] = key[1:] != key[:-1]
    return order[first]


def nearest_voxels(grid: VoxelGrid, points: Float[Tensor, "n 3"]) -> Int64[Tensor, "n"]:
    """The row of the voxel whose centre is nearest to each point, however far it is.

    What renders far from all cells is large and plain, and the nearest cell mostly of the same
    thing: with a largest distance, large Gaussians of plain surfaces read none.

    Args:
        grid: The voxels, at least one.
        points: World, scene units, such as the centres of Gaussians.
    """
    found = NeighbourIndex(grid.centres).nearest(points.detach().cpu().double(), 1)
    return found.indices[:, 0].long()


Filter = Literal["surfaces", "opaque"]
"""Which Gaussians make cells, see `surface_gaussians`."""

_MIN_OPACITY = 0.1
_MAX_ELONGATION = 30.0
"""Largest ratio of the largest scale to the second: above it a Gaussian is a needle. Flat ones are
none."""
_SCALE_SHARE = 0.995
"""Share of the Gaussians that is kept by their largest scale, the smallest first: what is blurred
over much of the scene is no surface."""
_OPAQUE_SHARE, _OPAQUE_RADIUS = 0.5, 0.2
"""The published code's: share kept by opacity, and how near others must lie, scene units."""
_MIN_NEIGHBOURS = 4
"""Other centres that must lie near."""
_NEAREST_FACTOR = 10.0
"""Near is up to this many median distances from a centre to the last of so many nearest others:
fits put many centres onto one another."""


@boundary
def surface_gaussians(gaussians: Gaussians, *, rule: Filter = "surfaces") -> Bool[Tensor, "n"]:
    """Which Gaussians stand for surfaces, and do not float alone.

    Args:
        gaussians: The Gaussians of the scene.
        rule: surfaces: those that are no needles, not faint and not the very largest, with four
            others near. opaque: as published, the more opaque half, with four others within 0.2.

    Raises:
        InputError: If none does.
    """
    opacities = gaussians.opacities.detach().cpu().reshape(-1)
    if rule == "opaque":
        kept = _first(-opacities, _OPAQUE_SHARE)
    else:
        scales = gaussians.scales.detach().cpu().sort(dim=1, descending=True).values
        kept = opacities >= _MIN_OPACITY
        kept &= scales[:, 0] <= _MAX_ELONGATION * scales[:, 1]
        kept &= _first(scales[:, 0], _SCALE_SHARE)
    means = gaussians.means.detach().cpu()[kept]
    if len(means) > _MIN_NEIGHBOURS:
        index, radius = NeighbourIndex(means), _OPAQUE_RADIUS
        if rule == "surfaces":
            last = index.nearest_others(_MIN_NEIGHBOURS).distances[:, -1]
            radius = _NEAREST_FACTOR * float(last.median())
        # A centre finds itself too.
        kept[kept.clone()] = index.count_within(means, radius) > _MIN_NEIGHBOURS
    else:
        kept[:] = False
    if not bool(kept.any()):
        raise InputError(
            f"gaussians: expected some that stand for surfaces, none of {len(kept)} does (rule "
            f"{rule!r})."
        )
    return kept


def _first(values: Tensor, share: float) -> Bool[Tensor, "n"]:
    """The share of rows with the least values; of equals those that come first."""
    count = max(1, round(share * len(values)))
    kept = torch.zeros(len(values), dtype=torch.bool)
    kept[torch.argsort(values, stable=True)[:count]] = True
    return kept
