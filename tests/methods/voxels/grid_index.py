"""The kernels of sparse grids, with all that they can do."""

import math

import torch
from jaxtyping import Float, Float64, Int, Int32, Int64
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg._native import VoxelGrid as NativeGrid
from splatseg.core.boundary import boundary
from splatseg.core.voxels import VoxelGrid
from splatseg.errors import RangeError

MAX_HITS = 64
"""Cells of one ray that are found at most."""


class GridIndex:
    """Occupied cells, arranged so that cells and what rays meet are found at once.

    Bricks of 8 x 8 x 8 cells lie in a hash table of our own; a bit a cell says which are occupied.

    Args:
        grid: The cells.
    """

    def __init__(self, grid: VoxelGrid) -> None:
        self._grid = grid
        self._native = NativeGrid(grid.cells.cpu())

    @property
    def nbytes(self) -> int:
        """Memory of bricks and table, bytes; below 4 a cell where cells lie close together."""
        return self._native.nbytes

    @boundary
    def find(self, cells: Int[Tensor, "*n 3"]) -> Int64[Tensor, "*n"]:
        """Rows of cells, -1 where one is empty.

        Args:
            cells: x, y and z.
        """
        check_shape("cells", cells, (*cells.shape[:-1], 3))
        flat = cells.reshape(-1, 3).cpu().to(torch.int32).contiguous()
        rows = torch.empty(len(flat), dtype=torch.int64)
        self._native.find(flat, rows)
        return rows.reshape(cells.shape[:-1])

    @boundary
    def trace(
        self,
        origin: Float[Tensor, "3"],
        directions: Float[Tensor, "*n 3"],
        *,
        hits: int = 1,
        depths: Float[Tensor, "m"] | None = None,
        near: float = 0.0,
        far: float = 1e6,
    ) -> tuple[Int32[Tensor, "*n hits"], Float[Tensor, "*n hits"] | None]:
        r"""The first occupied cells that rays meet, nearest first, by exact traversal.

        References:
            Amanatides and Woo, A Fast Voxel Traversal Algorithm for Ray Tracing (1987).

        Args:
            origin: Where all rays start, world.
            directions: Of unit length, world.
            hits: Cells of a ray, at most.
            depths: Optical depth of each cell along its side, at least 0: then hits have weights
                :math:`w_k = T_k (1 - e^{-\tau_k l_k})` with l the length inside, in sides, and
                :math:`T_k = \prod_{j<k} e^{-\tau_j l_j}`.
            near: Distance at which rays begin, scene units.
            far: Distance at which they end.

        Returns:
            Rows, -1 where there are fewer, and with `depths` the weights, 0 there.

        Raises:
            ShapeError: If shapes do not fit.
            RangeError: If numbers are not finite, or out of range.
        """
        check_shape("directions", directions, (*directions.shape[:-1], 3))
        check_finite("origin", origin)
        check_finite("directions", directions)
        if not 1 <= hits <= MAX_HITS:
            raise RangeError(f"hits: expected 1 to {MAX_HITS}, got {hits}.")
        if not 0 <= near < far < math.inf:
            raise RangeError(f"near, far: expected 0 <= near < far, got {near} and {far}.")
        if depths is not None:
            check_shape("depths", depths, (len(self._grid),))
            check_finite("depths", depths)
            depths = depths.cpu().float().contiguous()
        shape = (*directions.shape[:-1], hits)
        in_cells = self._in_cells(directions)
        rows = torch.empty((len(in_cells), hits), dtype=torch.int32)
        weights = None if depths is None else torch.empty((len(in_cells), hits))
        start = (origin.cpu().double() - self._grid.origin) / self._grid.size
        self._native.trace(start, in_cells, near, far, depths, rows, weights)
        return rows.reshape(shape), None if weights is None else weights.reshape(shape)

    def _in_cells(self, directions: Tensor) -> Float64[Tensor, "n 3"]:
        return (directions.reshape(-1, 3).cpu().double() / self._grid.size).contiguous()
