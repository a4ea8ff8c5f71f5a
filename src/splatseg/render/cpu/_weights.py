"""W of one view, kept: blocks of 4 x 4 pixels, or rows of single pixels."""

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg import _native
from splatseg._check import check_shape
from splatseg.render._products import LinearMap
from splatseg.render._rows import SparseWeights
from splatseg.render._view_weights import ViewWeights
from splatseg.render.cpu._view import padded_channels


class CpuBlockWeights(ViewWeights):
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
