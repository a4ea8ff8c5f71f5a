"""W of one view, kept: blocks of 4 x 4 pixels, or rows of single pixels."""

import numpy as np
import torch
from jaxtyping import Float, Int32
from torch import Tensor

from splatseg import _native
from splatseg._check import check_shape
from splatseg.render._products import LinearMap
from splatseg.render._rows import SparseWeights
from splatseg.render._view_weights import ImageWeights, PartSums
from splatseg.render.cpu._view import padded_channels


class CpuBlockWeights(ImageWeights):
    """Blocks of 4 x 4 pixels x Gaussians: an int32 id and 16 half-precision weights each."""

    def __init__(
        self, matrix: _native.BlockMatrix, *, gaussians: int, height: int, width: int
    ) -> None:
        self._matrix = matrix
        self._gaussians, self._height, self._width = gaussians, height, width

    @property
    def shape(self) -> tuple[int, int]:
        """Pixels and Gaussians."""
        return self._height * self._width, self._gaussians

    @property
    def nbytes(self) -> int:
        """Memory it holds."""
        return self._matrix.nbytes

    def product(self, signal: Float[Tensor, "n channels"]) -> Float[Tensor, "pixels channels"]:
        """``W @ signal``, row by row of the image."""
        check_shape("signal", signal, (self._gaussians, None))
        return LinearMap(forward=self._product, adjoint=self._adjoint)(signal)

    def adjoint(self, image: Float[Tensor, "pixels channels"]) -> Float[Tensor, "n channels"]:
        """``W.T @ image``."""
        check_shape("image", image, (self._height * self._width, None))
        return LinearMap(forward=self._adjoint, adjoint=self._product)(image)

    def _product(self, signal: Tensor) -> Tensor:
        channels = signal.shape[1]
        wide = signal.float()
        if channels % 16:
            wide = torch.zeros(self._gaussians, padded_channels(channels))
            wide[:, :channels] = signal
        image = torch.empty(self._height * self._width, channels)
        self._matrix.render(wide, channels, image)
        return image.to(signal.dtype)

    def _adjoint(self, image: Tensor) -> Tensor:
        channels = image.shape[1]
        sums = torch.zeros(self._gaussians, padded_channels(channels))
        weights = torch.zeros(self._gaussians)
        self._matrix.back_project(image.float(), channels, sums, weights)
        if sums.shape[1] != channels:
            sums = sums[:, :channels].contiguous()
        return sums.to(image.dtype)

    def part_sums(self, part: Int32[Tensor, "pixels"]) -> PartSums:
        """Sum W over each part of the image, block by block and then part by part."""
        check_shape("part", part, (self._height * self._width,))
        of, indptr, ids, sums = self._matrix.sums_of_parts(part.to(torch.int32).contiguous())
        parts = max(0, int(part.max()) + 1) if len(part) else 0
        # Within a part the blocks stay in their order.
        order = np.argsort(of, kind="stable").astype(np.int32)
        begin = np.searchsorted(of[order], np.arange(parts + 1))
        ones = np.ones(len(order), np.float32)
        found = _native.sparse_product(
            begin, order, ones, indptr[:-1], indptr[1:], ids, sums, self._gaussians
        )
        return PartSums(
            indptr=torch.from_numpy(found[0]),
            ids=torch.from_numpy(found[1]),
            sums=torch.from_numpy(found[2]),
        )


def rows_of_blocks(matrix: _native.BlockMatrix, *, gaussians: int, pixels: int) -> SparseWeights:
    """The rows of all pixels."""
    indptr = torch.empty(pixels + 1, dtype=torch.int64)
    matrix.count_rows(indptr)
    entries = int(indptr[-1])
    ids = torch.empty(entries, dtype=torch.int32)
    weights = torch.empty(entries, dtype=torch.int16)
    matrix.fill_rows(indptr, ids, weights.view(torch.uint16))
    return SparseWeights(
        indptr=indptr, ids=ids, weights=weights.view(torch.float16), gaussians=gaussians
    )
