"""W of a view, kept: as compressed rows, or as 4 x 4 blocks of pixels. Plain torch."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Float16, Int32, Int64
from torch import Tensor

from splatseg._check import check_shape
from splatseg.render._products import LinearMap
from splatseg.render._rows import SparseWeights
from splatseg.render._view_weights import ImageWeights, PartSums

BLOCK = 4
"""Side of a block of pixels."""


def csr_from_entries(
    pixels: Int64[Tensor, "e"],
    ids: Int64[Tensor, "e"],
    weights: Float[Tensor, "e"],
    *,
    shape: tuple[int, int],
) -> SparseWeights:
    """Compress entries that are sorted by pixel."""
    counts = torch.bincount(pixels, minlength=shape[0])
    starts = torch.cat((counts.new_zeros(1), counts.cumsum(0)))
    return SparseWeights(
        indptr=starts,
        ids=ids.to(torch.int32),
        weights=weights.to(torch.float16),
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

    def product(self, signal: Float[Tensor, "n channels"]) -> Float[Tensor, "pixels channels"]:
        """``W @ signal``, row by row of the image."""
        check_shape("signal", signal, (self.gaussians, None))
        return LinearMap(forward=self._product, adjoint=self._adjoint)(signal)

    def adjoint(self, image: Float[Tensor, "pixels channels"]) -> Float[Tensor, "n channels"]:
        """``W.T @ image``."""
        check_shape("image", image, (self.shape[0], None))
        return LinearMap(forward=self._adjoint, adjoint=self._product)(image)

    def _product(self, signal: Tensor) -> Tensor:
        channels = signal.shape[1]
        across, down = _blocks_of(self.width), _blocks_of(self.height)
        picked = signal.float()[self.columns.long()]
        blocks = picked.new_zeros(across * down, BLOCK * BLOCK, channels)
        blocks.index_add_(0, self.blocks, self.values.float()[:, :, None] * picked[:, None, :])
        image = blocks.reshape(down, across, BLOCK, BLOCK, channels).transpose(1, 2)
        image = image.reshape(down * BLOCK, across * BLOCK, channels)
        return image[: self.height, : self.width].reshape(-1, channels).to(signal.dtype)

    def _adjoint(self, image: Tensor) -> Tensor:
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
        return sums.to(image.dtype)

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


def blocks_from_csr(weights: SparseWeights, width: int, height: int) -> BlockWeights:
    """Gather the entries of all pixels of an image into blocks."""
    pixel = torch.repeat_interleave(
        torch.arange(width * height, device=weights.ids.device), weights.indptr.diff()
    )
    row, column = pixel // width, pixel % width
    block = (row // BLOCK) * _blocks_of(width) + column // BLOCK
    inside = (row % BLOCK) * BLOCK + column % BLOCK
    key, slot = torch.unique(
        block * max(weights.gaussians, 1) + weights.ids.long(), return_inverse=True
    )
    values = weights.weights.new_zeros(len(key), BLOCK * BLOCK)
    values[slot, inside] = weights.weights
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
