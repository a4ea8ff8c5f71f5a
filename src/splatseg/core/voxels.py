"""Occupied cells of a regular grid: what voxels are, without what is known of them."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, RangeError

BRICK = 8
"""Cells a side of the bricks that cells are ordered by."""

MAX_CELL = 2**20
"""Coordinates of cells stay below it, and above its negative."""


@boundary
def cell_order(cells: Int[Tensor, "m 3"]) -> Int[Tensor, "m"]:
    """Keys that ascend in the order of cells: by bricks, in a brick by z, then y, then x.

    Args:
        cells: x, y and z.

    Raises:
        RangeError: If a coordinate is beyond `MAX_CELL`.
    """
    check_shape("cells", cells, (None, 3))
    cells = cells.long()
    if len(cells) and int(cells.abs().max()) >= MAX_CELL:
        raise RangeError(
            f"cells: expected coordinates of magnitude below {MAX_CELL}, got "
            f"{int(cells.abs().max())}; larger cells have smaller ones."
        )
    brick = torch.div(cells, BRICK, rounding_mode="floor")
    local = cells - BRICK * brick
    key = torch.zeros(len(cells), dtype=torch.int64, device=cells.device)
    for axis in (2, 1, 0):
        key = (key << 18) | (brick[:, axis] + MAX_CELL // BRICK)
    for axis in (2, 1, 0):
        key = (key << 3) | local[:, axis]
    return key


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class VoxelGrid:
    """Occupied cells. Cell (x, y, z) is the box from origin + size (x, y, z) on, of that size.

    Raises:
        InputError: If cells are not in the order of `cell_order`, each once.
        RangeError: If the size is not above 0, or a coordinate is out of range.
    """

    cells: Int[Tensor, "m 3"]
    """x, y and z of each, int32."""

    size: float
    """Side of a cell, scene units."""

    origin: Float[Tensor, "3"]
    """World, scene units, float64."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_shape("cells", self.cells, (None, 3))
        check_shape("origin", self.origin, (3,))
        check_finite("origin", self.origin)
        if not 0 < self.size < float("inf"):
            raise RangeError(f"size: expected above 0, got {self.size}.")
        key = cell_order(self.cells)
        if bool((key[1:] <= key[:-1]).any()):
            raise InputError("cells: expected cells in their order, each once (see cell_order).")
        object.__setattr__(self, "cells", self.cells.to(torch.int32).contiguous())
        object.__setattr__(self, "origin", self.origin.double())

    def __len__(self) -> int:
        """How many cells are occupied."""
        return len(self.cells)

    def __repr__(self) -> str:
        return f"VoxelGrid({len(self):,} cells of {self.size:.3g})"

    @property
    def centres(self) -> Float[Tensor, "m 3"]:
        """Centres of the cells, world, scene units, float64."""
        return self.origin + self.size * (self.cells.double() + 0.5)

    @boundary
    def __getitem__(self, rows: Tensor) -> "VoxelGrid":
        """Some of the cells.

        Args:
            rows: A mask, or ascending rows.
        """
        return VoxelGrid(cells=self.cells[rows], size=self.size, origin=self.origin)
