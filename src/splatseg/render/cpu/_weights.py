"""W of one view, kept: blocks of 4 x 4 pixels, or rows of single pixels."""

import numpy as np
import torch
from jaxtyping import Float, Float16, Int32, Int64
from torch import Tensor

from splatseg import _native
from splatseg._check import check_shape
from splatseg.render._backend import BackProjected, ImageWeights, PartSums, SparseWeights
from splatseg.render.cpu._view import padded_channels


def _float(tensor: Tensor) -> Tensor:
    return tensor.detach().to(torch.float32).contiguous()


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

    def render(self, signal: Float[Tensor, "n channels"]) -> Float[Tensor, "pixels channels"]:
        """``W @ signal``, row by row of the image."""
        check_shape("signal", signal, (self._gaussians, None))
        channels = signal.shape[1]
        wide = _float(signal)
        if channels % 16:
            wide = torch.zeros(self._gaussians, padded_channels(channels))
            wide[:, :channels] = signal.detach()
        image = torch.empty(self._height * self._width, channels)
        self._matrix.render(wide, channels, image)
        return image

    def back_project(self, image: Float[Tensor, "pixels channels"]) -> BackProjected:
        """``W.T @ image`` and ``W.T @ 1``."""
        check_shape("image", image, (self._height * self._width, None))
        channels = image.shape[1]
        sums = torch.zeros(self._gaussians, padded_channels(channels))
        weights = torch.zeros(self._gaussians)
        self._matrix.back_project(_float(image), channels, sums, weights)
        if sums.shape[1] != channels:
            sums = sums[:, :channels].contiguous()
        return BackProjected(sums=sums, weights=weights)

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


class CpuSparseWeights(SparseWeights):
    """Compressed sparse rows, one a pixel."""

    def __init__(self, indptr: Tensor, ids: Tensor, weights: Tensor, *, gaussians: int) -> None:
        self._indptr, self._ids, self._weights = indptr, ids, weights
        self._gaussians = gaussians

    @classmethod
    def from_blocks(
        cls, matrix: _native.BlockMatrix, *, gaussians: int, pixels: int
    ) -> "CpuSparseWeights":
        """The rows of all pixels."""
        indptr = torch.empty(pixels + 1, dtype=torch.int64)
        matrix.count_rows(indptr)
        entries = int(indptr[-1])
        ids = torch.empty(entries, dtype=torch.int32)
        weights = torch.empty(entries, dtype=torch.int16)
        matrix.fill_rows(indptr, ids, weights.view(torch.uint16))
        return cls(indptr, ids, weights.view(torch.float16), gaussians=gaussians)

    @property
    def shape(self) -> tuple[int, int]:
        """Pixels and Gaussians."""
        return len(self._indptr) - 1, self._gaussians

    @property
    def nbytes(self) -> int:
        """Memory it holds."""
        return sum(t.nbytes for t in (self._indptr, self._ids, self._weights))

    @property
    def indptr(self) -> Int64[Tensor, "pixels_plus_1"]:
        """Where each pixel's entries begin."""
        return self._indptr

    @property
    def ids(self) -> Int32[Tensor, "entries"]:
        """Gaussians, front to back in each row."""
        return self._ids

    @property
    def weights(self) -> Float16[Tensor, "entries"]:
        """Blending weights."""
        return self._weights

    def render(self, signal: Float[Tensor, "n channels"]) -> Float[Tensor, "pixels channels"]:
        """``W @ signal``."""
        check_shape("signal", signal, (self._gaussians, None))
        image = torch.empty(self.shape[0], signal.shape[1])
        _native.csr_render(
            self._indptr, self._ids, self._weights.view(torch.uint16), _float(signal), image
        )
        return image

    def back_project(self, image: Float[Tensor, "pixels channels"]) -> BackProjected:
        """``W.T @ image`` and ``W.T @ 1``."""
        check_shape("image", image, (self.shape[0], None))
        sums = torch.zeros(self._gaussians, image.shape[1])
        weights = torch.zeros(self._gaussians)
        _native.csr_back_project(
            self._indptr,
            self._ids,
            self._weights.view(torch.uint16),
            _float(image),
            sums,
            weights,
        )
        return BackProjected(sums=sums, weights=weights)
