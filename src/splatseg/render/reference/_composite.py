r"""The blending weights: Kerbl et al. (2023), eq. 2 and 3, at some points of the image.

    C = sum_i c_i alpha_i T_i,    T_i = prod_{j < i} (1 - alpha_j),    w_i = alpha_i T_i

`blend_weights` is the model for one point, as a loop that reads like the text; it is there to be
read and to hold `weight_matrix` to. `weight_matrix` is the same for many points at once, in
operations that torch can differentiate.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from splatseg.render._constants import ALPHA_MIN, MEDIAN_TRANSMITTANCE, TRANSMITTANCE_MIN
from splatseg.render.reference._project import Projected

TILE = 16
"""Side of the squares that an image is computed in, to save memory; no result depends on it."""


def blend_weights(
    projected: Projected, u: float, v: float, *, alpha_max: float
) -> Iterator[tuple[int, float]]:
    r"""Yield (row of `projected`, weight) for one point of the image, front to back.

    Args:
        projected: Ellipses, front to back.
        u: Pixels from the left edge; pixel centres are at halves.
        v: Pixels from the top edge.
        alpha_max: The opacity cap.
    """
    transmittance = 1.0
    for i in range(len(projected)):
        du = u - float(projected.centres[i, 0])
        dv = v - float(projected.centres[i, 1])
        var_u, cov_uv, var_v = projected.covariances[i].tolist()
        # (du, dv) times the inverse covariance times (du, dv)
        q = (var_v * du**2 - 2 * cov_uv * du * dv + var_u * dv**2) / float(
            projected.determinants[i]
        )
        alpha = min(alpha_max, float(projected.opacities[i]) * math.exp(-q / 2))
        if alpha < ALPHA_MIN:
            continue
        if transmittance * (1 - alpha) <= TRANSMITTANCE_MIN:
            return
        yield i, alpha * transmittance
        transmittance *= 1 - alpha


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
