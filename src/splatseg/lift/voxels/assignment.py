"""Which voxels a Gaussian reads: the nearest one, or those around it."""

from dataclasses import dataclass
from itertools import product
from typing import Literal

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from splatseg._check import check_choice, check_finite, check_shape
from splatseg.core import UNLABELLED
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.voxels import VoxelGrid
from splatseg.errors import RangeError
from splatseg.lift.voxels.grid import GridIndex
from splatseg.neighbours import NeighbourIndex


@dataclass(frozen=True, slots=True, kw_only=True)
class AssignmentOptions:
    """Which voxels a Gaussian reads."""

    interpolation: Literal["nearest", "trilinear"] = "nearest"
    """nearest: the voxel whose centre is nearest to that of the Gaussian. trilinear: the voxels
    whose eight centres are around it, those that are there; the nearest where none is."""

    max_distance: float | None = None
    """Farthest that the nearest voxel may be, in sides of a cell; beyond, a Gaussian reads none.
    None takes it however far it is: what renders far from all cells is large and plain, and the
    nearest cell mostly of the same thing."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_choice("interpolation", self.interpolation, ("nearest", "trilinear"))
        if self.max_distance is not None and not self.max_distance > 0:
            raise RangeError(f"max_distance: expected above 0, got {self.max_distance}.")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class VoxelRows:
    """The voxels that each point reads."""

    rows: Int32[Tensor, "n k"]
    """Rows of voxels, -1 where there are fewer."""

    shares: Float[Tensor, "n k"]
    """What each counts: they add up to 1, or to 0 where a point reads none."""


@boundary
def assign_voxels(
    grid: VoxelGrid, points: Float[Tensor, "n 3"], *, options: AssignmentOptions | None = None
) -> VoxelRows:
    """The voxels that points read, such as the centres of Gaussians.

    Args:
        grid: The voxels, at least one.
        points: World, scene units.
        options: Which voxels a point reads.

    Raises:
        ShapeError: If points are not (n, 3).
        RangeError: If a coordinate is not finite.
    """
    options = options or AssignmentOptions()
    check_shape("points", points, (None, 3))
    check_finite("points", points)
    points = points.detach().cpu().double()
    if options.interpolation == "nearest":
        rows = _nearest(grid, points, options)[:, None]
        return VoxelRows(rows=rows, shares=(rows != UNLABELLED).float())
    rows, shares = _around(grid, points)
    alone = torch.nonzero(shares.sum(dim=1) <= 0).squeeze(1)
    if len(alone):
        rows[alone, 0] = _nearest(grid, points[alone], options)
        shares[alone, 0] = (rows[alone, 0] != UNLABELLED).double()
    total = shares.sum(dim=1, keepdim=True)
    shares = shares / torch.where(total > 0, total, 1.0)
    return VoxelRows(rows=rows, shares=shares.float())


def _nearest(grid: VoxelGrid, points: Tensor, options: AssignmentOptions) -> Int32[Tensor, "n"]:
    reach = float("inf") if options.max_distance is None else options.max_distance * grid.size
    found = NeighbourIndex(grid.centres).nearest(points, 1, max_distance=reach)
    return found.indices[:, 0].to(torch.int32)


def _around(grid: VoxelGrid, points: Tensor) -> tuple[Int32[Tensor, "n 8"], Tensor]:
    """The eight voxels around each point, -1 where one is empty, and their trilinear shares."""
    index = GridIndex(grid)
    place = (points - grid.origin) / grid.size - 0.5
    base = torch.floor(place)
    second = place - base
    rows: list[Tensor] = []
    shares: list[Tensor] = []
    for corner in product((0, 1), repeat=3):
        step = torch.tensor(corner, dtype=torch.float64)
        row = index.find((base + step).long())
        share = torch.where(step > 0, second, 1 - second).prod(dim=1)
        rows.append(torch.where(share > 0, row, UNLABELLED))
        shares.append(torch.where(rows[-1] != UNLABELLED, share, 0.0))
    return torch.stack(rows, dim=1).to(torch.int32), torch.stack(shares, dim=1)
