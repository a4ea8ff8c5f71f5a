"""W of a view, kept for reuse, in whatever layout."""

from abc import ABC, abstractmethod

from jaxtyping import Float
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
