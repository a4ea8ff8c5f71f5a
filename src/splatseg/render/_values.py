"""Results of products with W: images, sums and contributors."""

from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float, Int32, Int64
from msgspec import Meta
from torch import Tensor

from splatseg._check import check_shape
from splatseg.core.boundary import convert_fields
from splatseg.core.gaussians import LOW_PASS
from splatseg.core.options import NonNegative, Positive, options
from splatseg.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rendered:
    """Render of a view."""

    image: Float[Tensor, "height width channels"]
    """``W @ signal``, over black: a pixel that nothing covers is 0."""

    alpha: Float[Tensor, "height width"]
    """Sum of the weights, ``W @ 1``; 1 minus it is the transmittance behind all Gaussians."""

    depth: Float[Tensor, "height width"]
    """Expected z-depth, sum(w z) / sum(w), scene units; 0 where alpha is 0."""

    median_depth: Float[Tensor, "height width"]
    """z of the Gaussian at which the transmittance first falls to 0.5 or less; 0 where it
    never does. Not differentiable."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BackProjected:
    """An image accumulated on each Gaussian."""

    sums: Float[Tensor, "n channels"]
    """``W.T @ image``: the image summed over pixels with the blending weights."""

    weights: Float[Tensor, "n"]
    """``W.T @ 1``: the visibility of each Gaussian; one fully visible pixel counts 1."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SparseSignal:
    """A signal of many channels of which each Gaussian has few: its id, its likeliest ids.

    Gaussian i has ``values[i, j]`` in ``channels[i, j]`` and 0 in all others; a channel that it
    has several times counts with the sum.
    """

    channels: Int32[Tensor, "n k"]
    """Channels, from 0; -1 is none."""

    values: Float[Tensor, "n k"] | None = None
    """Their values, float32; None is 1 everywhere."""

    count: int
    """Number of channels."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_shape("channels", self.channels, (None, None))
        if self.channels.dtype != torch.int32:
            raise InputError(f"channels: expected int32, got {self.channels.dtype}.")
        if self.values is not None:
            check_shape("values", self.values, tuple(self.channels.shape))
            if self.values.dtype != torch.float32:
                raise InputError(f"values: expected float32, got {self.values.dtype}.")
        if self.channels.numel():
            low, high = (int(end) for end in torch.aminmax(self.channels))
            if low < -1 or high >= self.count:
                raise InputError(
                    f"channels: expected values in [-1, {self.count}), got {low} to {high}."
                )

    def to(self, device: torch.device | str) -> "SparseSignal":
        """The signal on another device."""
        values = None if self.values is None else self.values.to(device)
        return SparseSignal(channels=self.channels.to(device), values=values, count=self.count)

    def dense(self, channels: Int64[Tensor, "m"]) -> Float[Tensor, "n m"]:
        """Some channels, ascending, as columns."""
        wanted = channels.to(self.channels)
        column = torch.searchsorted(wanted, self.channels.contiguous())
        mine = wanted[column.clamp_max(len(wanted) - 1)] == self.channels
        row, entry = torch.nonzero(mine, as_tuple=True)
        values = torch.ones_like(mine, dtype=torch.float32) if self.values is None else self.values
        signal = torch.zeros(len(self.channels), len(wanted), device=wanted.device)
        return signal.index_put_((row, column[row, entry]), values[row, entry], accumulate=True)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StrongestChannels:
    """The channel with the largest value of each pixel."""

    channels: Int32[Tensor, "height width"]
    """The channel, the smaller of equal ones."""

    values: Float[Tensor, "height width"]
    """Its value."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SparseImage:
    """An image of many channels of which each pixel has few: segments, labels, masks.

    Pixel p, row by row of the image, has ``values[indptr[p]:indptr[p + 1]]`` in
    ``channels[...]``, each channel at most once, and 0 in all others.
    """

    indptr: Int64[Tensor, "pixels_plus_1"]
    """Where each pixel's values begin."""

    channels: Int32[Tensor, "entries"]
    """Channels, from 0."""

    values: Float[Tensor, "entries"]
    """Their values, float32."""

    count: int
    """Number of channels."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_shape("indptr", self.indptr, (None,))
        check_shape("channels", self.channels, (None,))
        check_shape("values", self.values, (len(self.channels),))
        types = (self.indptr.dtype, self.channels.dtype, self.values.dtype)
        if types != (torch.int64, torch.int32, torch.float32):
            raise InputError(
                f"image: expected indptr int64, channels int32 and values float32, got {types}."
            )
        if len(self.indptr) < 1 or int(self.indptr[-1]) != len(self.channels):
            raise InputError(
                f"indptr: expected one number more than pixels, the last of them "
                f"{len(self.channels)}, the entries."
            )
        if len(self.channels):
            low, high = (int(end) for end in torch.aminmax(self.channels))
            if low < 0 or high >= self.count:
                raise InputError(
                    f"channels: expected values in [0, {self.count}), got {low} to {high}."
                )

    def dense(self, start: int, stop: int) -> Float[Tensor, "pixels part"]:
        """Channels from `start` to before `stop`, dense."""
        row = torch.repeat_interleave(torch.arange(len(self.indptr) - 1), self.indptr.diff())
        mine = (self.channels >= start) & (self.channels < stop)
        image = torch.zeros(len(self.indptr) - 1, stop - start)
        image[row[mine], self.channels[mine].long() - start] = self.values[mine]
        return image


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SparseBackProjected:
    """A `SparseImage` accumulated on each Gaussian: the sums that are not 0."""

    gaussians: Int64[Tensor, "m"]
    """Gaussians, ascending."""

    channels: Int64[Tensor, "m"]
    """Channels, ascending within a Gaussian."""

    sums: Float[Tensor, "m"]
    """``(W.T @ image)[gaussian, channel]``, float32."""

    weights: Float[Tensor, "n"]
    """``W.T @ 1`` of every Gaussian, float32."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Contributors:
    """The Gaussians of largest weight in some pixels."""

    ids: Int32[Tensor, "p k"]
    """The strongest Gaussians of each pixel, strongest first; -1 where there are fewer."""

    weights: Float[Tensor, "p k"]
    """Their blending weights, 0 where there are fewer."""

    first: Int32[Tensor, "p"]
    """The front-most Gaussian with a weight; -1 where there is none."""

    median: Int32[Tensor, "p"]
    """The Gaussian at which the transmittance first falls to 0.5 or less; -1 where it never
    does."""


@options
class RenderOptions:
    """How Gaussians become pixels. The defaults are 3DGS's, but for the near plane."""

    near: Positive = 0.01
    """Gaussians whose z-depth is not greater are left out, scene units. gsplat's; Inria's 0.2 cuts
    away what a hand-held camera sees in captures of small scale."""

    alpha_max: Annotated[float, Meta(gt=1 / 255, lt=1)] = 0.99
    """Largest alpha of one Gaussian at one pixel: it keeps 1 - alpha, by which gradients divide,
    away from 0. Kerbl et al. 2023, appendix C; gsplat's CUDA kernels have 0.999."""

    low_pass: NonNegative = LOW_PASS
    """Added to both variances of the projected Gaussian, square pixels."""

    antialiased: bool = False
    """Scale opacities to compensate for the low-pass filter (Mip-Splatting, eq. 9)."""

    sh_degree: Annotated[int, Meta(ge=0, le=3)] | None = None
    """Maximum degree of the spherical harmonics in use; None is all."""


# Every constant of the blending model, with its source and what others do differently.
#
# The model is that of *3D Gaussian Splatting* (Kerbl et al. 2023), as its CUDA code of July 2023
# draws it, called "Inria" below. "gsplat" is version 1.5.3. The opacity cap, the near plane and
# the low-pass are parameters (`RenderOptions`); the rest is fixed.
#
# | what                      | here           | Inria             | gsplat                        |
# |---------------------------|----------------|-------------------|-------------------------------|
# | opacity cap               | 0.99           | 0.99              | 0.999                         |
# | near plane (z is kept)    | z > 0.01       | z > 0.2           | z >= 0.01                     |
# | far plane                 | none           | none              | 1e10                          |
# | low-pass (square pixels)  | 0.3            | 0.3               | 0.3 (`eps2d`)                 |
# | alpha skipped             | < 1/255        | < 1/255           | < 1/255                       |
# | pixel stops, not blending | T' <= 1e-4     | T' < 1e-4         | T' <= 1e-4                    |
# | x/z, y/z in the Jacobian  | view + 0.3     | 1.3 (symmetric)   | view + 0.3                    |
# | extent on screen          | exact ellipse  | square, 3 sigma   | box, min(3.33, exact) sigma   |
# | gradient at the cap       | 0              | as if not capped  | 0                             |
#
# In the Jacobian, x/z and y/z are clamped: "view + 0.3" is the view, wherever the principal point
# lies, and 0.3 of its half width on either side; "1.3" is 1.3 half widths around the optical axis,
# the same where the principal point is the image centre.
#
# T' is the transmittance behind the Gaussian in question. A 3 sigma square (opacity 1) leaves out
# alphas up to 0.011; gsplat's 3.33 sigma box is exact to 1/255, because
# :math:`e^{-3.33^2 / 2} < 1/255`, up to the opacity 1.


ALPHA_MIN = 1.0 / 255.0
"""Minimum alpha that is blended, one step of an 8-bit image. Kerbl et al. 2023, appendix C. A
Gaussian with a lower opacity is not blended."""

TRANSMITTANCE_MIN = 1e-4
"""A Gaussian that would bring the transmittance to this or less ends the pixel and is not
itself blended. Kerbl et al. 2023, appendix C, there 0.9999 of opacity."""

FRUSTUM_MARGIN = 0.3
"""How far outside the view, in half widths, the Jacobian is still taken where the Gaussian is.
Beyond, the linear approximation of the projection explodes. Inria's "1.3"."""

MEDIAN_TRANSMITTANCE = 0.5
"""The median depth is where the transmittance first falls to this or less. 2DGS (Huang et al.
2024) takes the last Gaussian with more than this before it: the same where the transmittance
falls so far, else the farthest Gaussian, where we say there is none."""
