"""Readable twins of the kernels in native/voxels.cpp: slow, and the same to the last bit.

Only sums of features round differently, by the order of additions within a voxel.
"""

import math
from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Float, Int, Int32
from torch import Tensor

from splatseg.core.voxels import VoxelGrid

Cell = tuple[int, int, int]


def traverse(
    origin: Sequence[float],
    direction: Sequence[float],
    *,
    low: Cell,
    high: Cell,
    near: float = 0.0,
    far: float = 1e6,
) -> Iterator[tuple[Cell, float, float]]:
    """Cells of a box that a ray passes, in their order, and t where it enters and leaves each.

    Amanatides and Woo (1987), with borders computed anew in each step instead of added up, so
    that nothing is lost on long ways.

    Args:
        origin: In cells.
        direction: In cells a unit of t.
        low: First cell of the box.
        high: Last cell of the box, which is part of it.
        near: Least t.
        far: Largest t.
    """
    begin, end = near, far
    for axis in range(3):
        o, d = origin[axis], direction[axis]
        if d == 0:
            if not low[axis] <= o < high[axis] + 1:
                return
            continue
        borders = sorted(((low[axis] - o) / d, (high[axis] + 1 - o) / d))
        begin, end = max(begin, borders[0]), min(end, borders[1])
    cell = [
        min(max(math.floor(origin[axis] + begin * direction[axis]), low[axis]), high[axis])
        for axis in range(3)
    ]
    t = begin
    while t <= end and all(low[axis] <= cell[axis] <= high[axis] for axis in range(3)):
        out = [_border(origin[axis], direction[axis], cell[axis]) for axis in range(3)]
        axis = out.index(min(out))
        yield (cell[0], cell[1], cell[2]), t, min(out[axis], end)
        t = max(t, out[axis])
        cell[axis] += 1 if direction[axis] > 0 else -1


def _border(origin: float, direction: float, cell: int) -> float:
    """T at which a ray leaves a cell along one axis."""
    if direction == 0:
        return math.inf
    return (cell + (1 if direction > 0 else 0) - origin) / direction


def trace(
    grid: VoxelGrid,
    origin: Float[Tensor, "3"],
    directions: Float[Tensor, "n 3"],
    *,
    hits: int = 1,
    depths: Float[Tensor, "m"] | None = None,
    near: float = 0.0,
    far: float = 1e6,
) -> tuple[Int32[Tensor, "n hits"], Float[Tensor, "n hits"]]:
    """As `GridIndex.trace`; without depths the first hit has the weight 1 and the others 0."""
    row_of = {tuple(cell): row for row, cell in enumerate(grid.cells.tolist())}
    low = tuple(grid.cells.amin(dim=0).tolist())
    high = tuple(grid.cells.amax(dim=0).tolist())
    start = ((origin.double() - grid.origin) / grid.size).tolist()
    rows = torch.full((len(directions), hits), -1, dtype=torch.int32)
    weights = torch.zeros(len(directions), hits)
    for i, direction in enumerate((directions.double() / grid.size).tolist()):
        length = math.hypot(*direction)
        found, transmittance = 0, 1.0
        for cell, enter, leave in traverse(
            start, direction, low=low, high=high, near=near, far=far
        ):
            row = row_of.get(cell)
            if row is None:
                continue
            depth = math.inf if depths is None else float(depths[row])
            passed = 0.0 if depths is None else math.exp(-depth * length * (leave - enter))
            rows[i, found] = row
            weights[i, found] = transmittance * (1 - passed)
            transmittance *= passed
            found += 1
            if found == hits:
                break
    return rows, weights


def add_hit_features(
    image: Float[Tensor, "pixels channels"],
    hits: Int[Tensor, "pixels hits"],
    *,
    weights: Float[Tensor, "pixels hits"] | None,
    view_means: bool,
    sums: Float[Tensor, "m channels"],
    totals: Float[Tensor, "m"],
) -> None:
    """Add what pixels show to the voxels they hit, see native/voxels.h; double precision."""
    for voxel in range(len(sums)):
        share = torch.where(hits == voxel, 1.0 if weights is None else weights, 0.0).double()
        total = float(share.sum())
        if total <= 0:
            continue
        added = share.sum(dim=1) @ image.double()
        sums[voxel] += added / total if view_means else added
        totals[voxel] += 1 if view_means else total
