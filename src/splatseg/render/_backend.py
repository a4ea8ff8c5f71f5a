"""What a backend does, and what it gives back: the matrix W of a view and its adjoint.

With the geometry frozen a view is a sparse linear map (docs/architecture.md):

    w[p, i] = alpha_i(p) * prod_{j before i} (1 - alpha_j(p))      W: pixels x Gaussians

`render` is ``W @ signal``, `back_project` is ``W.T @ image``, `contributors` reads rows of W
and `weights` keeps W.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Literal

from jaxtyping import Float, Int, Int32
from torch import Tensor

from splatseg.core import Camera, Gaussians
from splatseg.render._options import RenderOptions
from splatseg.render._view_weights import ViewWeights

Layout = Literal["csr", "blocks"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rendered:
    """What a view shows."""

    image: Float[Tensor, "height width channels"]
    """``W @ signal``, over black: a pixel that nothing covers is 0."""

    alpha: Float[Tensor, "height width"]
    """Sum of the weights, ``W @ 1``; 1 minus it is the light that passes everything."""

    depth: Float[Tensor, "height width"]
    """Expected z-depth, sum(w z) / sum(w), scene units; 0 where alpha is 0."""

    median_depth: Float[Tensor, "height width"]
    """z of the Gaussian at which the transmittance first falls to 0.5 or less; 0 where it
    never does. Not differentiable."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BackProjected:
    """What an image says of each Gaussian."""

    sums: Float[Tensor, "n channels"]
    """``W.T @ image``: the image summed over pixels with the blending weights."""

    weights: Float[Tensor, "n"]
    """``W.T @ 1``: how much each Gaussian was seen; one fully visible pixel counts 1."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Contributors:
    """Which Gaussians make some pixels."""

    ids: Int32[Tensor, "p k"]
    """The strongest Gaussians of each pixel, strongest first; -1 where there are fewer."""

    weights: Float[Tensor, "p k"]
    """Their blending weights, 0 where there are fewer."""

    first: Int32[Tensor, "p"]
    """The front-most Gaussian with a weight; -1 where there is none."""

    median: Int32[Tensor, "p"]
    """The Gaussian at which the transmittance first falls to 0.5 or less; -1 where it never
    does."""


class Backend(ABC):
    """One way to compute W. Cameras are pinhole; inputs were checked by the caller."""

    name: ClassVar[str]

    @abstractmethod
    def render(
        self,
        gaussians: Gaussians,
        camera: Camera,
        signal: Float[Tensor, "n channels"] | None,
        *,
        options: RenderOptions,
        screen: Float[Tensor, "n 2"] | None = None,
    ) -> Rendered:
        """``W @ signal``; None is the colour of the harmonics. Differentiable in torch.

        Args:
            gaussians: The scene.
            camera: A pinhole camera.
            signal: One row a Gaussian.
            options: Switches of the blending model.
            screen: Zeros, added to the projected centres, pixels: a leaf whose gradient is that
                towards the centres on the image, which densification looks at.
        """

    @abstractmethod
    def back_project(
        self,
        gaussians: Gaussians,
        camera: Camera,
        image: Float[Tensor, "height width channels"],
        *,
        options: RenderOptions,
    ) -> BackProjected:
        """``W.T @ image`` and ``W.T @ 1``. No gradient."""

    @abstractmethod
    def contributors(
        self,
        gaussians: Gaussians,
        camera: Camera,
        pixels: Int[Tensor, "p 2"],
        k: int,
        *,
        options: RenderOptions,
    ) -> Contributors:
        """The k strongest Gaussians of pixels (column, row), ties front to back."""

    @abstractmethod
    def weights(
        self,
        gaussians: Gaussians,
        camera: Camera,
        pixels: Int[Tensor, "p 2"] | None,
        k: int | None,
        *,
        layout: Layout,
        options: RenderOptions,
    ) -> ViewWeights:
        """W itself: all pixels or some, all entries or each pixel's k strongest.

        ``layout="blocks"`` holds 4 x 4 pixel blocks, all pixels and entries only.
        """
