"""Readable twins of what is done for many at once: the equations, a point or a ray at a time."""

import math

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.raycast import through_triangles
from splatseg.street.hits import MeshHits, Sides
from splatseg.street.primitives import PrimitiveMesh
from splatseg.street.shapes import FACES


def point_columns(
    vertices: Float[Tensor, "v 3"],
    opacity: Float[Tensor, "v"],
    probabilities: Float[Tensor, "v k"],
    points: Float[Tensor, "p 3"],
    *,
    radius: float,
) -> Int64[Tensor, "p"]:
    """What `BallQuery.columns` finds: eq. 9 of the paper, -1 where it is undefined."""
    columns: list[int] = []
    for point in points.double():
        distance = torch.linalg.vector_norm(vertices.double() - point, dim=1)
        ball = distance <= radius
        if bool((distance[ball] == 0).any()):
            ball = distance == 0
        weight = torch.where(distance == 0, 1.0, 1 / distance)[ball]
        score = (weight * opacity[ball].double()) @ probabilities[ball].double() / weight.sum()
        columns.append(int(score.argmax()) if bool(ball.any()) and bool(score.sum() > 0) else -1)
    return torch.tensor(columns, dtype=torch.int64)


def composite(
    opacity: Float[Tensor, "n hits"],
    values: Float[Tensor, "n hits c"],
    background: Float[Tensor, "n c"],
) -> Float[Tensor, "n c"]:
    """What rays show, in float64; see `radiance.composite`."""
    shown = torch.zeros(background.shape, dtype=torch.float64)
    for ray in range(len(opacity)):
        transmittance = 1.0
        for sigma, value in zip(opacity[ray].tolist(), values[ray], strict=True):
            shown[ray] += transmittance * sigma * value.double()
            transmittance *= 1.0 - sigma
        shown[ray] += transmittance * background[ray].double()
    return shown


def cross_entropy(probabilities: Float[Tensor, "n k"], columns: list[int]) -> float:
    """Eq. 7: minus the mean over all rays of the log of the label's; -1 adds nothing."""
    total = 0.0
    for row, column in zip(probabilities.double(), columns, strict=True):
        if column >= 0:
            total -= float(row[column].log())
    return total / len(columns)


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
