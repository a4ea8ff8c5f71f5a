"""W of a view, kept for reuse, in whatever layout."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

from jaxtyping import Float, Float64, Int32, Int64
from torch import Tensor


class ViewWeights(ABC):
    """W of one view, kept for reuse: half-precision weights, float32 products.

    Both products are differentiable in torch with respect to what they are given.
    """

    __slots__ = ()

    @property
    @abstractmethod
    def shape(self) -> tuple[int, int]:
        """Pixels and Gaussians."""

    @property
    @abstractmethod
    def nbytes(self) -> int:
        """Memory it holds."""

    @abstractmethod
    def product(self, signal: Float[Tensor, "n channels"]) -> Float[Tensor, "pixels channels"]:
        """``W @ signal``, row by row of the image (or of the pixels asked for)."""

    @abstractmethod
    def adjoint(self, image: Float[Tensor, "pixels channels"]) -> Float[Tensor, "n channels"]:
        """``W.T @ image``."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PartSums:
    """Rows of W summed over parts of an image, as compressed sparse rows."""

    indptr: Int64[Tensor, "parts_plus_1"]
    """Where the entries of each part begin."""

    ids: Int32[Tensor, "entries"]
    """Gaussians, ascending in each part."""

    sums: Float64[Tensor, "entries"]
    """Their weights summed over the pixels of the part, above 0."""


class ImageWeights(ViewWeights):
    """W of a whole image, in blocks of 4 x 4 pixels."""

    __slots__ = ()

    @abstractmethod
    def part_sums(self, part: Int32[Tensor, "pixels"]) -> PartSums:
        """Sum W over each part of the image.

        Weights are half precision and sums double: they are exact.

        Args:
            part: The part of each pixel, row by row, from 0; negative where it is in none.
        """
