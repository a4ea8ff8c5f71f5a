"""From 3D Gaussians to ellipses on the image: EWA splatting (Zwicker et al. 2002).

Equation numbers are those of Kerbl et al., *3D Gaussian Splatting for Real-Time Radiance Field
Rendering* (2023). All is computed in float64, whatever the Gaussians have.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from splatseg.core import Camera, Gaussians
from splatseg.core.rigid import rotation_from_quaternion
from splatseg.render._rows import SparseWeights
from splatseg.render._values import (
    ALPHA_MIN,
    FRUSTUM_MARGIN,
    MEDIAN_TRANSMITTANCE,
    TRANSMITTANCE_MIN,
    RenderOptions,
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Projected:
    """The Gaussians in front of the camera as ellipses, front to back."""

    ids: Int64[Tensor, "m"]
    """Row of the Gaussian in the scene."""

    centres: Float64[Tensor, "m 2"]
    """Centre on the image, pixels (u, v)."""

    covariances: Float64[Tensor, "m 3"]
    """Variance of u, covariance of u and v, variance of v, low-pass included; square pixels."""

    determinants: Float64[Tensor, "m"]
    """Determinant of the covariance, positive."""

    opacities: Float64[Tensor, "m"]
    """Opacity at the centre, at least 1/255; scaled where the options say antialiased."""

    depths: Float64[Tensor, "m"]
    """z-depth of the centre, scene units, above the near plane."""

    def __len__(self) -> int:
        return self.ids.shape[0]

    def __getitem__(self, index: Tensor) -> "Projected":
        """Rows by boolean mask or integer ids."""
        return Projected(
            ids=self.ids[index],
            centres=self.centres[index],
            covariances=self.covariances[index],
            determinants=self.determinants[index],
            opacities=self.opacities[index],
            depths=self.depths[index],
        )

    def touching(self, low: tuple[float, float], high: tuple[float, float]) -> "Projected":
        r"""Those that may reach an alpha of 1/255 in the rectangle from `low` to `high`.

        :math:`o \, e^{-q/2} \ge 1/255` is the ellipse :math:`q \le 2 \ln(255 \, o)`, whose
        half width is :math:`\sqrt{2 \ln(255 \, o) \, \sigma_u^2}`. A little is added for
        rounding: what is kept in vain gets the weight 0 later.
        """
        with torch.no_grad():
            reach = 2 * torch.log(self.opacities / ALPHA_MIN)
            half = torch.sqrt(reach[:, None] * self.covariances[:, [0, 2]]) * (1 + 1e-9) + 1e-9
            corner_low = torch.tensor(low, dtype=half.dtype, device=half.device)
            corner_high = torch.tensor(high, dtype=half.dtype, device=half.device)
            inside = (self.centres + half >= corner_low) & (self.centres - half <= corner_high)
            kept = torch.nonzero(inside.all(dim=1))[:, 0]
        return self[kept]


def project(gaussians: Gaussians, camera: Camera, *, options: RenderOptions) -> Projected:
    r"""Project the Gaussians that the camera can see and sort them front to back.

    With :math:`W, t` the rotation and translation of ``camera.cam_from_world`` and
    :math:`(x, y, z)` a centre in camera axes, the covariance on the image is

    .. math:: \Sigma' = J W \Sigma W^\top J^\top + \lambda I  \quad (5)

    with :math:`\Sigma = R S S^\top R^\top` (6) and the Jacobian of the projection at the centre,
    Zwicker's local affine approximation,

    .. math:: J = \begin{pmatrix} f_x / z & 0 & -f_x x / z^2 \\
                                  0 & f_y / z & -f_y y / z^2 \end{pmatrix}.

    In J, but not in the centre, x/z and y/z are clamped to the view and a margin around it.
    Adding :math:`\lambda`, the low-pass, is the convolution with a Gaussian the size of a pixel.

    Left out are Gaussians with :math:`z \le` near, those whose opacity is under 1/255 and those
    without any extent on the image (possible only if the low-pass is 0).
    """
    pose = camera.cam_from_world.to(device=gaussians.device, dtype=torch.float64)
    rotation, translation = pose[:3, :3], pose[:3, 3]
    means = gaussians.means.double()
    # Not a matrix product: that may round equal rows differently, and equal depths must tie.
    means_cam = sum((means[:, i : i + 1] * rotation[:, i] for i in range(3)), translation)

    # Rows are dropped before the formulas that they have no value in, else the gradient of a
    # dropped row would be 0 * inf.
    seen = (means_cam[:, 2] > options.near) & (gaussians.opacities.double() >= ALPHA_MIN)
    ids = torch.nonzero(seen)[:, 0]
    means_cam = means_cam[ids]
    x, y, z = means_cam.unbind(dim=1)

    row_u, row_v = _half_axes_on_image(gaussians[ids], means_cam, rotation, camera)
    var_u = (row_u * row_u).sum(dim=1)
    var_v = (row_v * row_v).sum(dim=1)
    cov_uv = (row_u * row_v).sum(dim=1)
    # det(M M') is the squared area of the rows, which, unlike var_u var_v - cov_uv^2, loses no
    # digits where the ellipse is a needle.
    det_sharp = torch.linalg.cross(row_u, row_v).square().sum(dim=1)
    blur = options.low_pass
    det = det_sharp + blur * (var_u + var_v) + blur * blur

    opacities = gaussians.opacities[ids].double()
    kept = det > 0
    if options.antialiased:
        kept &= opacities.square() * det_sharp >= ALPHA_MIN * ALPHA_MIN * det
    order = torch.nonzero(kept)[:, 0]
    order = order[torch.argsort(z.detach()[order], stable=True)]
    det, det_sharp, opacities = det[order], det_sharp[order], opacities[order]
    if options.antialiased:
        # The 2D Mip filter of Mip-Splatting (Yu et al. 2024) keeps the Gaussian's energy.
        opacities = opacities * torch.sqrt(det_sharp / det)
    return Projected(
        ids=ids[order],
        centres=torch.stack((camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy), 1)[
            order
        ],
        covariances=torch.stack((var_u + blur, cov_uv, var_v + blur), dim=1)[order],
        determinants=det,
        opacities=opacities,
        depths=z[order],
    )


def _half_axes_on_image(
    gaussians: Gaussians, means_cam: Tensor, rotation: Tensor, camera: Camera
) -> tuple[Tensor, Tensor]:
    """The two rows of M = J W R S of each Gaussian, so that J W Sigma W' J' = M M'."""
    x, y, z = means_cam.unbind(dim=1)
    zeros = torch.zeros_like(z)
    tan_x = _clamp_to_view(x / z, camera.width, focal=camera.fx, principal=camera.cx)
    tan_y = _clamp_to_view(y / z, camera.height, focal=camera.fy, principal=camera.cy)
    jacobian_u = torch.stack((camera.fx / z, zeros, -camera.fx * tan_x / z), dim=1)
    jacobian_v = torch.stack((zeros, camera.fy / z, -camera.fy * tan_y / z), dim=1)
    axes = rotation @ rotation_from_quaternion(gaussians.rotations.double())
    half_axes = axes * gaussians.scales.double()[:, None, :]
    row_u = torch.einsum("ni,nij->nj", jacobian_u, half_axes)
    row_v = torch.einsum("ni,nij->nj", jacobian_v, half_axes)
    return row_u, row_v


def _clamp_to_view(tangent: Tensor, size: int, *, focal: float, principal: float) -> Tensor:
    """Clamp x/z (or y/z) to the view and `FRUSTUM_MARGIN` half widths on each side of it."""
    margin = FRUSTUM_MARGIN * (0.5 * size / focal)
    low, high = -principal / focal - margin, (size - principal) / focal + margin
    if not (math.isfinite(low) and math.isfinite(high)):
        return tangent
    return tangent.clamp(min=low, max=high)


# The blending weights: Kerbl et al. (2023), eq. 2 and 3, at some points of the image.
#
#     C = sum_i c_i alpha_i T_i,    T_i = prod_{j < i} (1 - alpha_j),    w_i = alpha_i T_i


TILE = 16
"""Side of the squares that an image is computed in, to save memory; no result depends on it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WeightMatrix:
    """The weights of some Gaussians at some points."""

    weights: Float64[Tensor, "p m"]
    """w, 0 where the Gaussian is not blended; columns front to back."""

    median: Bool[Tensor, "p m"]
    """True at the Gaussian at which the transmittance first falls to 0.5 or less, if any."""


def weight_matrix(
    projected: Projected, points: Float64[Tensor, "p 2"], *, alpha_max: float
) -> WeightMatrix:
    """The weights of all of `projected` at all `points` (u, v), differentiable."""
    offsets = points[:, None, :] - projected.centres
    du, dv = offsets.unbind(dim=-1)
    var_u, cov_uv, var_v = projected.covariances.unbind(dim=-1)
    q = (var_v * du**2 - 2 * cov_uv * du * dv + var_u * dv**2) / projected.determinants
    # Rounding can leave q a little under 0 where low_pass is 0 and the ellipse a needle.
    alpha = (projected.opacities * torch.exp(-q.clamp_min(0) / 2)).clamp_max(alpha_max)
    alpha = torch.where(alpha < ALPHA_MIN, 0.0, alpha)
    behind = torch.cumprod(1 - alpha, dim=1)
    before = torch.cat((torch.ones_like(behind[:, :1]), behind[:, :-1]), dim=1)
    # `behind` never grows, so the first Gaussian that fails this stops all that follow.
    blended = (behind > TRANSMITTANCE_MIN) & (alpha > 0)
    weights = torch.where(blended, alpha * before, 0.0)
    crosses = (before > MEDIAN_TRANSMITTANCE) & (behind <= MEDIAN_TRANSMITTANCE)
    return WeightMatrix(weights=weights, median=blended & crosses)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tile:
    """A rectangle of the image and the Gaussians that may be seen in it."""

    rows: slice
    columns: slice
    projected: Projected
    matrix: WeightMatrix
    """One row a pixel, row by row of the tile."""

    @property
    def size(self) -> tuple[int, int]:
        """Height and width, pixels."""
        return self.rows.stop - self.rows.start, self.columns.stop - self.columns.start


def tiles(projected: Projected, width: int, height: int, *, alpha_max: float) -> Iterator[Tile]:
    """Cut the image into rectangles that touch something and compute the weights of each."""
    for top in range(0, height, TILE):
        bottom = min(top + TILE, height)
        row = projected.touching((0.5, top + 0.5), (width - 0.5, bottom - 0.5))
        if len(row) == 0:
            continue
        for left in range(0, width, TILE):
            right = min(left + TILE, width)
            seen = row.touching((left + 0.5, top + 0.5), (right - 0.5, bottom - 0.5))
            if len(seen) == 0:
                continue
            v, u = torch.meshgrid(
                torch.arange(top, bottom, dtype=torch.float64) + 0.5,
                torch.arange(left, right, dtype=torch.float64) + 0.5,
                indexing="ij",
            )
            points = torch.stack((u, v), dim=-1).reshape(-1, 2).to(seen.centres.device)
            yield Tile(
                rows=slice(top, bottom),
                columns=slice(left, right),
                projected=seen,
                matrix=weight_matrix(seen, points, alpha_max=alpha_max),
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Entries:
    """Non-zero entries of W, pixel by pixel, front to back within a pixel."""

    pixels: Int64[Tensor, "e"]
    """Which of the points asked for."""

    ids: Int64[Tensor, "e"]
    """Row of the Gaussian in the scene."""

    weights: Float64[Tensor, "e"]
    """Blending weight."""

    median: Bool[Tensor, "e"]
    """True where the transmittance first falls to 0.5 or less."""


@torch.no_grad()
def entries(projected: Projected, pixels: Int64[Tensor, "p 2"], *, alpha_max: float) -> Entries:
    """The non-zero entries of W in the rows of `pixels` (column, row)."""
    parts: list[Entries] = []
    for start in range(0, len(pixels), TILE * TILE):
        points = pixels[start : start + TILE * TILE].double() + 0.5
        low, high = points.amin(dim=0).tolist(), points.amax(dim=0).tolist()
        seen = projected.touching((low[0], low[1]), (high[0], high[1]))
        matrix = weight_matrix(seen, points, alpha_max=alpha_max)
        pixel, column = torch.nonzero(matrix.weights, as_tuple=True)
        parts.append(
            Entries(
                pixels=start + pixel,
                ids=seen.ids[column],
                weights=matrix.weights[pixel, column],
                median=matrix.median[pixel, column],
            )
        )
    empty = torch.zeros(0, dtype=torch.int64, device=projected.ids.device)
    return Entries(
        pixels=torch.cat([empty, *(p.pixels for p in parts)]),
        ids=torch.cat([empty, *(p.ids for p in parts)]),
        weights=torch.cat([empty.double(), *(p.weights for p in parts)]),
        median=torch.cat([empty.bool(), *(p.median for p in parts)]),
    )


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
