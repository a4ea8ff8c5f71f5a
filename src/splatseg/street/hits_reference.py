"""The readable reference of hits: every ray against every triangle, in torch."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.raycast import through_triangles
from splatseg.street.hits import MeshHits, Sides
from splatseg.street.mesh import PrimitiveMesh
from splatseg.street.shapes.template import FACES


def mesh_hits(
    mesh: PrimitiveMesh,
    origins: Float[Tensor, "*n 3"],
    directions: Float[Tensor, "n 3"],
    *,
    max_hits: int = 8,
    fine_hits: int | None = None,
    coarse_hits: int | None = None,
    sides: Sides = "both",
) -> MeshHits:
    """What `MeshCaster.hits` finds, but for rays exactly through edges, which meet both sides.

    Args:
        mesh: The primitives.
        origins: Where rays start, one each, or one for all.
        directions: Where they go, of any length but 0.
        max_hits: The nearest that are kept.
        fine_hits: Of level 0; None is `max_hits`.
        coarse_hits: Of each other level; None is `max_hits`.
        sides: From which sides triangles are met.
    """
    corners = mesh.vertices.double()[mesh.faces]
    rays = directions.double()[:, None]
    start = origins.double().expand_as(directions)[:, None]
    t, weights = through_triangles(start, rays, corners.expand(len(rays), -1, -1, -1))
    inside = (weights >= 0).all(dim=-1) & (t >= 0)
    if sides == "front":
        a, b, c = corners.unbind(1)
        inside &= directions.double() @ torch.linalg.cross(b - a, c - a).T < 0
    t = torch.where(inside, t, math.inf)
    level = mesh.levels.repeat_interleave(FACES)
    for each in range(len(mesh.sizes)):
        limit = coarse_hits if each else fine_hits
        if limit is not None:
            own = torch.where(level == each, t, math.inf)
            rank = own.argsort(dim=1, stable=True).argsort(dim=1)
            t = torch.where((level == each) & (rank >= limit), math.inf, t)
    distances, which = t.sort(dim=1, stable=True)
    distances, which = distances[:, :max_hits], which[:, :max_hits]
    found = weights.gather(1, which[..., None].expand(-1, -1, 3)).float()
    valid = distances.isfinite()
    return MeshHits(
        faces=torch.where(valid, which, -1),
        distances=distances,
        weights=torch.where(valid[..., None], found, 0.0),
    )
