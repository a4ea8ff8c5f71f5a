"""The readable reference: every ray against every triangle, in torch."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg.raycast import RayHits, through_triangles


def cast(
    vertices: Float[Tensor, "v 3"],
    faces: Int[Tensor, "m 3"],
    origins: Float[Tensor, "*n 3"],
    directions: Float[Tensor, "n 3"],
) -> RayHits:
    """What `RayCaster.cast` finds; of triangles that are met at one distance the first.

    Args:
        vertices: Corners of the triangles.
        faces: Vertices of each triangle.
        origins: Where rays start, one each, or one for all.
        directions: Where they go, of any length but 0.
    """
    corners = vertices.double()[faces]
    rays = directions.double()[:, None]
    start = origins.double().expand_as(directions)[:, None]
    t, weights = through_triangles(start, rays, corners.expand(len(rays), -1, -1, -1))
    inside = (weights >= 0).all(dim=-1) & (t >= 0)
    t = torch.where(inside, t, math.inf)
    distances, which = t.min(dim=1)
    hit = distances.isfinite()
    found = weights[torch.arange(len(which)), which]
    return RayHits(
        faces=torch.where(hit, which, -1),
        distances=distances,
        weights=torch.where(hit[:, None], found, 0.0),
    )
