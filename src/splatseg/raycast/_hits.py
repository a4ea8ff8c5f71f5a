"""What rays meet, and the point of a known triangle that a ray goes through."""

import contextlib
import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg.core.boundary import boundary
from splatseg.errors import ShapeError


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RayHits:
    """The first triangle that each ray meets."""

    faces: Int[Tensor, "n"]
    """Index of the triangle, -1 where a ray meets none."""

    distances: Float[Tensor, "n"]
    """Along the ray in units of its direction's length, float64; infinite where it meets none."""

    weights: Float[Tensor, "n 3"]
    """Barycentric weights of the triangle's corners at the hit, float64: they sum to 1, and are
    within [0, 1] up to rounding; 0 where a ray meets none."""


@boundary
def through_triangles(
    origins: Float[Tensor, "*n 3"],
    directions: Float[Tensor, "*n 3"],
    corners: Float[Tensor, "*n 3 3"],
) -> tuple[Float[Tensor, "*n"], Float[Tensor, "*n 3"]]:
    r"""Where rays go through the planes of triangles.

    Of :math:`o + t d = a + \beta (b - a) + \gamma (c - a)`, by Cramer's rule (Moller and Trumbore):

    .. math:: t = \frac{(s \times e_1) \cdot e_2}{(d \times e_2) \cdot e_1}, \quad
              \beta = \frac{(d \times e_2) \cdot s}{(d \times e_2) \cdot e_1}, \quad
              \gamma = \frac{(s \times e_1) \cdot d}{(d \times e_2) \cdot e_1}

    with :math:`e_1 = b - a, e_2 = c - a, s = o - a`.

    Returns:
        t, and the weights :math:`(1 - \beta - \gamma, \beta, \gamma)`; NaN where a ray is parallel
        to the plane, and where a number of it or of its triangle is.

    Raises:
        ShapeError: If the last axes are not 3, 3 and (3, 3), or the others do not go together.

    References:
        Moller and Trumbore, Fast, Minimum Storage Ray/Triangle Intersection (1997).
    """
    _check_rays(origins, directions, corners)
    kind = torch.promote_types(torch.promote_types(origins.dtype, directions.dtype), corners.dtype)
    origins, directions, corners = origins.to(kind), directions.to(kind), corners.to(kind)
    a, b, c = corners.unbind(-2)
    first, second, start = b - a, c - a, origins - a
    across, aside = torch.linalg.cross(directions, second), torch.linalg.cross(start, first)
    volume = (across * first).sum(-1)
    volume = torch.where(volume == 0, math.nan, volume)
    t = (aside * second).sum(-1) / volume
    beta = (across * start).sum(-1) / volume
    gamma = (aside * directions).sum(-1) / volume
    return t, torch.stack((1 - beta - gamma, beta, gamma), dim=-1)


def _check_rays(origins: Tensor, directions: Tensor, corners: Tensor) -> None:
    shapes = tuple(origins.shape), tuple(directions.shape), tuple(corners.shape)
    alike = len(shapes[0]) == len(shapes[1]) == len(shapes[2]) - 1
    if alike and (shapes[0][-1:], shapes[1][-1:], shapes[2][-2:]) == ((3,), (3,), (3, 3)):
        with contextlib.suppress(RuntimeError):
            torch.broadcast_shapes(shapes[0], shapes[1], shapes[2][:-1])
            return
    raise ShapeError(
        "origins, directions, corners: expected shapes (n, 3), (n, 3) and (n, 3, 3), got "
        f"{shapes[0]}, {shapes[1]} and {shapes[2]}."
    )
