"""W of a view, kept: as compressed rows, or as 4 x 4 blocks of pixels. Plain torch."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Float16, Int32, Int64
from torch import Tensor

from splatseg._check import check_shape
from splatseg.render._backend import (
    BackProjected,
    ImageWeights,
    PartSums,
    SparseWeights,
)

BLOCK = 4
"""Side of a block of pixels."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CsrWeights(SparseWeights):
    """W as compressed sparse rows."""

    row_starts: Int64[Tensor, "pixels_plus_1"]
    """Where each pixel's entries begin."""

    columns: Int32[Tensor, "entries"]
    """Gaussians, front to back in each row."""

    values: Float16[Tensor, "entries"]
    """Blending weights."""

    gaussians: int
    """Number of columns of W."""

    @property
    def shape(self) -> tuple[int, int]:
        """Pixels and Gaussians."""
        return len(self.row_starts) - 1, self.gaussians

    @property
    def nbytes(self) -> int:
        """Memory it holds."""
        return self.row_starts.nbytes + self.columns.nbytes + self.values.nbytes

    @property
    def indptr(self) -> Int64[Tensor, "pixels_plus_1"]:
        """Where each pixel's entries begin."""
        return self.row_starts

    @property
    def ids(self) -> Int32[Tensor, "entries"]:
        """Gaussians, front to back in each row."""
        return self.columns

    @property
    def weights(self) -> Float16[Tensor, "entries"]:
        """Blending weights."""
        return self.values

    def render(self, signal: Float[Tensor, "n channels"]) -> Float[Tensor, "pixels channels"]:
        """``W @ signal``, row by row of the image (or of the pixels asked for)."""
        check_shape("signal", signal, (self.gaussians, None))
        picked = signal.float()[self.columns.long()] * self.values.float()[:, None]
        image = picked.new_zeros(self.shape[0], signal.shape[1])
        return image.index_add_(0, self._rows(), picked)

    def back_project(self, image: Float[Tensor, "pixels channels"]) -> BackProjected:
        """``W.T @ image`` and ``W.T @ 1``."""
        check_shape("image", image, (self.shape[0], None))
        values = self.values.float()
        columns = self.columns.long()
        sums = values.new_zeros(self.gaussians, image.shape[1])
        sums.index_add_(0, columns, image.float()[self._rows()] * values[:, None])
        seen = values.new_zeros(self.gaussians).index_add_(0, columns, values)
        return BackProjected(sums=sums, weights=seen)

    def _rows(self) -> Tensor:
        counts = self.row_starts.diff()
        return torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts)


def csr_from_entries(
    pixels: Int64[Tensor, "e"],
    ids: Int64[Tensor, "e"],
    weights: Float[Tensor, "e"],
    *,
    shape: tuple[int, int],
) -> CsrWeights:
    """Compress entries that are sorted by pixel."""
    counts = torch.bincount(pixels, minlength=shape[0])
    starts = torch.cat((counts.new_zeros(1), counts.cumsum(0)))
    return CsrWeights(
        row_starts=starts,
        columns=ids.to(torch.int32),
        values=weights.to(torch.float16),
        gaussians=shape[1],
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BlockWeights(ImageWeights):
    """W in 4 x 4 blocks of pixels: for each Gaussian in a block one id and 16 weights."""

    blocks: Int64[Tensor, "b"]
    """Which block of pixels, row by row of blocks."""

    columns: Int32[Tensor, "b"]
    """Which Gaussian."""

    values: Float16[Tensor, "b 16"]
    """Its weights at the pixels of the block, row by row; 0 where it is not blended."""

    width: int
    """Pixels a row of the image."""

    height: int
    """Rows of the image."""

    gaussians: int
    """Number of columns of W."""

    @property
    def shape(self) -> tuple[int, int]:
        """Pixels and Gaussians."""
        return self.width * self.height, self.gaussians

    @property
    def nbytes(self) -> int:
        """Memory it holds."""
        return self.blocks.nbytes + self.columns.nbytes + self.values.nbytes

    def render(self, signal: Float[Tensor, "n channels"]) -> Float[Tensor, "pixels channels"]:
        """``W @ signal``, row by row of the image."""
        check_shape("signal", signal, (self.gaussians, None))
        channels = signal.shape[1]
        across, down = _blocks_of(self.width), _blocks_of(self.height)
        picked = signal.float()[self.columns.long()]
        blocks = picked.new_zeros(across * down, BLOCK * BLOCK, channels)
        blocks.index_add_(0, self.blocks, self.values.float()[:, :, None] * picked[:, None, :])
        image = blocks.reshape(down, across, BLOCK, BLOCK, channels).transpose(1, 2)
        image = image.reshape(down * BLOCK, across * BLOCK, channels)
        return image[: self.height, : self.width].reshape(-1, channels)

    def back_project(self, image: Float[Tensor, "pixels channels"]) -> BackProjected:
        """``W.T @ image`` and ``W.T @ 1``."""
        check_shape("image", image, (self.shape[0], None))
        channels = image.shape[1]
        across, down = _blocks_of(self.width), _blocks_of(self.height)
        padded = image.new_zeros(down * BLOCK, across * BLOCK, channels, dtype=torch.float32)
        padded[: self.height, : self.width] = image.reshape(self.height, self.width, channels)
        blocks = padded.reshape(down, BLOCK, across, BLOCK, channels).transpose(1, 2)
        blocks = blocks.reshape(across * down, BLOCK * BLOCK, channels)
        values = self.values.float()
        columns = self.columns.long()
        sums = values.new_zeros(self.gaussians, channels)
        sums.index_add_(0, columns, torch.einsum("bp,bpc->bc", values, blocks[self.blocks]))
        seen = values.new_zeros(self.gaussians).index_add_(0, columns, values.sum(dim=1))
        return BackProjected(sums=sums, weights=seen)

    def part_sums(self, part: Int32[Tensor, "pixels"]) -> PartSums:
        """Sum W over each part of the image."""
        check_shape("part", part, (self.shape[0],))
        across, pixel = _blocks_of(self.width), torch.arange(BLOCK * BLOCK, device=part.device)
        row = self.blocks[:, None] // across * BLOCK + pixel // BLOCK
        column = self.blocks[:, None] % across * BLOCK + pixel % BLOCK
        blended = self.values > 0
        of = part.long()[(row * self.width + column)[blended]]
        ids = self.columns.long()[:, None].expand(-1, BLOCK * BLOCK)[blended]
        known = of >= 0
        key, entry = torch.unique((of * self.gaussians + ids)[known], return_inverse=True)
        sums = torch.zeros(len(key), dtype=torch.float64, device=part.device)
        sums.index_add_(0, entry, self.values[blended][known].double())
        parts = max(0, int(part.max()) + 1) if len(part) else 0
        counts = torch.bincount(key // max(self.gaussians, 1), minlength=parts)
        return PartSums(
            indptr=torch.cat((counts.new_zeros(1), counts.cumsum(0))),
            ids=(key % max(self.gaussians, 1)).to(torch.int32),
            sums=sums,
        )


def blocks_from_csr(weights: CsrWeights, width: int, height: int) -> BlockWeights:
    """Gather the entries of all pixels of an image into blocks."""
    pixel = torch.repeat_interleave(
        torch.arange(width * height, device=weights.columns.device), weights.row_starts.diff()
    )
    row, column = pixel // width, pixel % width
    block = (row // BLOCK) * _blocks_of(width) + column // BLOCK
    inside = (row % BLOCK) * BLOCK + column % BLOCK
    key, slot = torch.unique(
        block * max(weights.gaussians, 1) + weights.columns.long(), return_inverse=True
    )
    values = weights.values.new_zeros(len(key), BLOCK * BLOCK)
    values[slot, inside] = weights.values
    return BlockWeights(
        blocks=key // max(weights.gaussians, 1),
        columns=(key % max(weights.gaussians, 1)).to(torch.int32),
        values=values,
        width=width,
        height=height,
        gaussians=weights.gaussians,
    )


def _blocks_of(pixels: int) -> int:
    return -(-pixels // BLOCK)
