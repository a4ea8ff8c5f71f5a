"""Occupied cells of a grid, and layers of their features: which cells each Gaussian reads."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.evidence import UNLABELLED
from splatseg.core.layer_info import LayerInfo
from splatseg.core.layers import Features, RowColumns
from splatseg.core.options import Positive
from splatseg.errors import InputError, RangeError, ShapeError

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

    size: Positive
    """Side of a cell, scene units."""

    origin: Float[Tensor, "3"]
    """World, scene units, float64."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_finite("origin", self.origin)
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
        return replace(self, cells=self.cells[rows])


StoredPrecision = Literal["float32", "float16", "int8", "product"]
"""How numbers are kept. int8: of every row the largest is 127. product: a byte for each part of a
row, the number of the nearest of 256 vectors of that part."""

CODES = 256
"""Vectors of a codebook."""

_DTYPES = {torch.float32: "float32", torch.float16: "float16", torch.int8: "int8"}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StoredTable:
    """Rows of numbers, as they are kept.

    Raises:
        InputError: If the parts are not those of one precision.
        ShapeError: If shapes do not fit.
        RangeError: If a number is not finite.
    """

    codes: Tensor
    """(m, channels) float32, float16 or int8; with `codebooks` (m, parts) uint8."""

    scales: Float[Tensor, "m"] | None = None
    """With int8: what a row is multiplied by."""

    codebooks: Float[Tensor, "parts codes width"] | None = None
    """256 vectors of each part of a row; parts lie side by side, `width` channels each."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_shape("codes", self.codes, (None, None))
        kind = torch.uint8 if self.codebooks is not None else self.codes.dtype
        if self.codes.dtype != kind or (self.codebooks is None and kind not in _DTYPES):
            raise InputError(
                "codes: expected float32, float16 or int8, or uint8 with codebooks, got "
                f"{self.codes.dtype}{'' if self.codebooks is None else ' with codebooks'}."
            )
        if (self.scales is not None) != (self.codes.dtype == torch.int8):
            raise InputError("scales: expected them with codes of int8, and with no others.")
        if self.scales is not None:
            check_shape("scales", self.scales, (len(self.codes),))
            check_finite("scales", self.scales)
        if self.codebooks is not None:
            check_shape("codebooks", self.codebooks, (self.codes.shape[1], CODES, None))
            check_finite("codebooks", self.codebooks)
        elif self.codes.dtype != torch.int8:
            check_finite("codes", self.codes)

    def __len__(self) -> int:
        return len(self.codes)

    @property
    def precision(self) -> StoredPrecision:
        """How numbers are kept."""
        if self.codebooks is not None:
            return "product"
        return "int8" if self.scales is not None else _precision(self.codes)

    @property
    def channels(self) -> int:
        """Numbers of a row."""
        parts = int(self.codes.shape[1])
        return parts if self.codebooks is None else parts * int(self.codebooks.shape[2])

    @property
    def nbytes(self) -> int:
        """Memory, bytes."""
        parts = (self.codes, self.scales, self.codebooks)
        return sum(part.nbytes for part in parts if part is not None)

    @boundary
    def decode(self, rows: slice | Tensor | None = None) -> Float[Tensor, "k channels"]:
        """Rows as float32.

        Args:
            rows: Which; None is all.
        """
        codes = self.codes if rows is None else self.codes[rows]
        if self.codebooks is not None:
            parts = torch.arange(codes.shape[1])
            return self.codebooks.float()[parts, codes.long()].reshape(len(codes), -1)
        if self.scales is None:
            return codes.float()
        scales = self.scales if rows is None else self.scales[rows]
        return codes.float() * scales[:, None]


def _precision(codes: Tensor) -> StoredPrecision:
    return "float16" if codes.dtype == torch.float16 else "float32"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class VoxelFeatures(RowColumns):
    """Features of voxels; a Gaussian has the mean of those that it reads."""

    COLUMNS: ClassVar[Mapping[str, float]] = {"rows": UNLABELLED, "shares": 0}

    grid: VoxelGrid
    """The voxels; all of them were hit."""

    table: StoredTable
    """Their features."""

    weights: Float[Tensor, "m"]
    """What each feature rests on: weight of its hits, or views that hit it."""

    rows: Int[Tensor, "n k"]
    """The voxels that each Gaussian reads, -1 where there are fewer. int32."""

    shares: Float[Tensor, "n k"] | None = None
    """What each counts, at least 0; of a Gaussian they add up to 1, or to 0 where it reads none.
    None where each Gaussian reads one voxel at most."""

    info: LayerInfo = field(default_factory=LayerInfo)
    """How it was made, and what was done to it since."""

    def __post_init__(self) -> None:
        convert_fields(self)
        count = len(self.grid)
        if len(self.table) != count:
            raise ShapeError(f"table: expected {count} rows, one a voxel, got {len(self.table)}.")
        check_shape("weights", self.weights, (count,))
        check_finite("weights", self.weights)
        if self.rows.numel() and not -1 <= int(self.rows.min()) <= int(self.rows.max()) < count:
            raise RangeError(
                f"rows: expected -1 or rows of {count} voxels, got "
                f"[{int(self.rows.min())}, {int(self.rows.max())}]."
            )
        object.__setattr__(self, "rows", self.rows.to(torch.int32))
        if self.shares is None and self.rows.shape[1] != 1:
            raise InputError(
                f"shares: expected those of {self.rows.shape[1]} voxels a Gaussian, got none."
            )
        if self.shares is not None:
            check_finite("shares", self.shares)
            if self.shares.numel() and float(self.shares.min()) < 0:
                raise RangeError(f"shares: expected at least 0, got {float(self.shares.min())}.")

    def __len__(self) -> int:
        """How many Gaussians there are."""
        return len(self.rows)

    def __repr__(self) -> str:
        return (
            f"VoxelFeatures({len(self):,} rows, {len(self.grid):,} voxels, "
            f"{self.table.channels} channels, {self.table.precision})"
        )

    @boundary
    def of_gaussians(self, found: Float[Tensor, "m channels"]) -> Float[Tensor, "n channels"]:
        """Numbers of voxels as Gaussians read them, 0 where one reads none.

        Args:
            found: One row a voxel, such as features, cosines or probabilities.
        """
        check_shape("found", found, (len(self.grid), None))
        out = torch.zeros(len(self), found.shape[1], dtype=found.dtype)
        for column in range(self.rows.shape[1]):
            rows = self.rows[:, column].long()
            there = rows != UNLABELLED
            # A Gaussian that reads nothing is given a row that counts nothing.
            factor = there.to(found.dtype)
            if self.shares is not None:
                factor = factor * self.shares[:, column].to(found.dtype)
            out += found[rows.clamp_min(0)] * factor[:, None] if len(found) else 0
        return out

    def features(self) -> Features:
        """The same with a feature of its own for each Gaussian: `channels` numbers each.

        Weights are those of the voxels that it reads.
        """
        weights = self.of_gaussians(self.weights[:, None].float()).squeeze(1)
        return Features(
            values=self.of_gaussians(self.table.decode()), weights=weights, info=self.info
        )


def plain_features(layer: Features | VoxelFeatures) -> Features:
    """The layer with a feature of its own for each Gaussian."""
    return layer.features() if isinstance(layer, VoxelFeatures) else layer
