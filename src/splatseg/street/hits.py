"""All triangles of primitives that rays meet, nearest first: what eq. 3 to 5 are about.

A ray meets a watertight primitive from outside an even number of times, whether it passes through
faces, edges or vertices: what lies exactly on an edge is counted as if the ray passed infinitely
little aside. The search is native (``native/mesh_hits.h``); `splatseg.street.hits` tries
every triangle.

Primitives of several levels fill the same places. ``fine_hits`` and ``coarse_hits`` limit how many
triangles of each a ray keeps, as the published renderer does (4 and 2): without them, a coarse
primitive that wraps fine ones could use up what a ray may have.
"""

import math
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatseg import _native
from splatseg._check import check_choice, check_finite, check_range, check_shape
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, RangeError
from splatseg.raycast import RayHits
from splatseg.street.primitives import PrimitiveMesh
from splatseg.street.shapes import FACES, VERTICES, template

Sides = Literal["both", "front"]
"""both: triangles are met from outside and from inside their primitive, as published. front: from
outside alone, of which a ray that enters a primitive has one where both are two."""

MAX_HITS = 64
"""Triangles that a ray may keep."""

_RAYS = 1 << 16
"""Rays whose levels are merged together."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeshHits:
    """The triangles that each ray meets, nearest first."""

    faces: Int64[Tensor, "n hits"]
    """Index of the triangle, -1 where there is none."""

    distances: Float[Tensor, "n hits"]
    """Along the ray in units of its direction's length, float64, ascending; infinite where there
    is none."""

    weights: Float[Tensor, "n hits 3"]
    """Barycentric weights of the triangle's corners at the hit, float32: they sum to 1; 0 where
    there is none."""

    def __len__(self) -> int:
        """How many rays there are."""
        return len(self.faces)

    @property
    def valid(self) -> Bool[Tensor, "n hits"]:
        """Where there is a triangle."""
        return self.faces >= 0


class MeshCaster:
    """Primitives, arranged so that rays find all triangles that they meet.

    Bits do not depend on the number of threads.

    Args:
        mesh: The primitives; there may be none.

    Example:
        >>> vertices, _ = template()
        >>> ball = PrimitiveMesh(vertices=vertices, levels=torch.zeros(1), sizes=(1.0,))
        >>> hits = MeshCaster(ball).hits(torch.tensor([-2.0, 0, 0]), torch.tensor([[1.0, 0, 0]]))
        >>> [round(float(t), 2) for t in hits.distances[0, :3]]
        [1.0, 3.0, inf]
    """

    @boundary
    def __init__(self, mesh: PrimitiveMesh) -> None:
        self._mesh = mesh
        shapes = mesh.vertices.detach().cpu().view(-1, VERTICES, 3)
        _, faces = template()
        corners = faces.int().contiguous()
        self._levels: list[_Level] = []
        for level in range(len(mesh.sizes)):
            primitives = (mesh.levels.cpu() == level).nonzero()[:, 0]
            tree = _native.PrimitiveTree(shapes[primitives].contiguous(), corners)
            self._levels.append(_Level(tree=tree, primitives=primitives))

    @property
    def mesh(self) -> PrimitiveMesh:
        """The primitives."""
        return self._mesh

    @property
    def nbytes(self) -> int:
        """Bytes of the arrangement."""
        return sum(level.tree.nbytes for level in self._levels)

    @boundary
    def hits(
        self,
        origins: Float[Tensor, "*n 3"],
        directions: Float[Tensor, "n 3"],
        *,
        max_hits: int = 8,
        fine_hits: int | None = None,
        coarse_hits: int | None = None,
        sides: Sides = "both",
    ) -> MeshHits:
        """The triangles that each ray meets, those of all levels together.

        Args:
            origins: Where rays start, world: one each, or one point for all.
            directions: Where they go, of any length but 0.
            max_hits: The nearest that are kept, L in the paper.
            fine_hits: The nearest of the finest level that are kept; None is `max_hits`. 0 leaves
                the level out.
            coarse_hits: The nearest of each other level that are kept; None is `max_hits`.
            sides: From which sides triangles are met.

        Returns:
            ``max_hits`` columns, or fewer where the levels together give fewer.

        Raises:
            ShapeError: If there is not one origin, or as many as directions.
            RangeError: If a value is not finite, a direction is 0, or a limit is out of range.
            InputError: If no level gives a triangle, or the sides are not known.
        """
        check_choice("sides", sides, get_args(Sides))
        check_shape("directions", directions, (None, 3))
        check_shape("origins", origins, (3,) if origins.ndim < 2 else (len(directions), 3))
        check_finite("origins", origins)
        check_finite("directions", directions)
        if bool((directions == 0).all(dim=-1).any()):
            raise RangeError("directions: expected lengths above 0, got one of 0.")
        check_range("max_hits", max_hits, 1, MAX_HITS)
        limits = level_limits(
            len(self._levels), max_hits=max_hits, fine_hits=fine_hits, coarse_hits=coarse_hits
        )
        rays = directions.detach().cpu().double().contiguous()
        starts = origins.detach().cpu().double().reshape(-1, 3).contiguous()
        width = min(max_hits, sum(limits))
        faces = torch.empty(len(rays), width, dtype=torch.int64)
        distances = torch.empty(len(rays), width, dtype=torch.float64)
        weights = torch.empty(len(rays), width, 3)
        for begin in range(0, len(rays), _RAYS):
            part = slice(begin, begin + _RAYS)
            own = starts if len(starts) == 1 else starts[part]
            found = [
                level.hits(own, rays[part], limit, front=sides == "front")
                for level, limit in zip(self._levels, limits, strict=True)
                if limit
            ]
            merged = found[0] if len(found) == 1 else _merged(found, width)
            faces[part], distances[part] = merged.faces, merged.distances
            weights[part] = merged.weights
        return MeshHits(faces=faces, distances=distances, weights=weights)


def level_limits(
    levels: int, *, max_hits: int, fine_hits: int | None, coarse_hits: int | None
) -> list[int]:
    """How many triangles of each level a ray keeps, at most `max_hits`.

    Raises:
        RangeError: If a limit is out of range.
        InputError: If all are 0.
    """
    limits: list[int] = []
    for level in range(levels):
        name = "coarse_hits" if level else "fine_hits"
        limit = coarse_hits if level else fine_hits
        if limit is not None:
            check_range(name, limit, 0, MAX_HITS)
        limits.append(max_hits if limit is None else min(limit, max_hits))
    if not any(limits):
        raise InputError(
            f"fine_hits, coarse_hits: expected a triangle of some level, got {fine_hits} and "
            f"{coarse_hits} of {levels} levels."
        )
    return limits


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Level:
    """The primitives of one level."""

    tree: _native.PrimitiveTree
    primitives: Int64[Tensor, "m"]

    def hits(self, origins: Tensor, directions: Tensor, limit: int, *, front: bool) -> MeshHits:
        count = len(directions)
        faces = torch.empty(count, limit, dtype=torch.int64)
        distances = torch.empty(count, limit, dtype=torch.float64)
        weights = torch.empty(count, limit, 3)
        self.tree.hits(origins, directions, faces, distances, weights, front)
        if len(self.primitives):
            own = faces.clamp_min(0)
            world = FACES * self.primitives[own // FACES] + own % FACES
            faces = torch.where(faces < 0, faces, world)
        return MeshHits(faces=faces, distances=distances, weights=weights)


def _merged(found: list[MeshHits], width: int) -> MeshHits:
    """Hits of several levels as one, the nearest first; of equal ones the finer level's."""
    faces = torch.cat([one.faces for one in found], dim=1)
    distances = torch.cat([one.distances for one in found], dim=1)
    weights = torch.cat([one.weights for one in found], dim=1)
    ordered, order = distances.sort(dim=1, stable=True)
    order, ordered = order[:, :width], ordered[:, :width]
    return MeshHits(
        faces=faces.gather(1, order).where(ordered < math.inf, -1),
        distances=ordered,
        weights=weights.gather(1, order[..., None].expand(-1, -1, 3)),
    )


# What rays meet first: fine primitives over coarse ones.


class PrimitiveCaster:
    """A mesh of primitives, arranged level by level to be met by rays.

    Args:
        mesh: With at least one primitive.

    Raises:
        InputError: If it has none.
    """

    @boundary
    def __init__(self, mesh: PrimitiveMesh) -> None:
        if not len(mesh):
            raise InputError("mesh: expected at least one primitive, got none.")
        self._levels = mesh.levels.cpu()
        self._caster = MeshCaster(mesh)

    @boundary
    def first(self, origins: Float[Tensor, "*n 3"], directions: Float[Tensor, "n 3"]) -> RayHits:
        """The first triangle of the finest level that a ray meets at all.

        Args:
            origins: Where rays start, world: one each, or one point for all.
            directions: Where they go.

        Returns:
            Hits, their faces those of the mesh.
        """
        levels = len(self._caster.mesh.sizes)
        hits = self._caster.hits(origins, directions, max_hits=levels, fine_hits=1, coarse_hits=1)
        level = torch.where(hits.valid, self._levels[hits.faces.clamp_min(0) // FACES], levels)
        finest = level.argmin(dim=1, keepdim=True)
        return RayHits(
            faces=hits.faces.gather(1, finest)[:, 0],
            distances=hits.distances.gather(1, finest)[:, 0],
            weights=hits.weights.gather(1, finest[..., None].expand(-1, -1, 3))[:, 0].double(),
        )


# Which primitives enclose a point: by the solid angle that their faces fill around it.
#
# Of a triangle with corners a, b, c as seen from the point,
#
# .. math:: \tan(\Omega / 2) = \frac{a \cdot (b \times c)}
#     {|a||b||c| + (a \cdot b)|c| + (b \cdot c)|a| + (c \cdot a)|b|}
#
# and the sum over a watertight mesh is :math:`4 \pi` inside and 0 outside.
#
# References:
#     Van Oosterom and Strackee, The Solid Angle of a Plane Triangle (1983).


@boundary
def enclosing(mesh: PrimitiveMesh, points: Float[Tensor, "p 3"]) -> Bool[Tensor, "m"]:
    """Which primitives of a mesh have one of the points inside.

    Args:
        mesh: The primitives.
        points: Such as the centres of cameras, world.
    """
    _, faces = template()
    shapes = mesh.vertices.view(-1, VERTICES, 3).double()
    low, high = shapes.amin(dim=1), shapes.amax(dim=1)
    found = torch.zeros(len(mesh), dtype=torch.bool)
    for point in points.detach().cpu().double():
        near = ((low <= point) & (point <= high)).all(dim=1).nonzero()[:, 0]
        a, b, c = (shapes[near][:, faces] - point).unbind(dim=2)
        la, lb, lc = (torch.linalg.vector_norm(side, dim=-1) for side in (a, b, c))
        volume = (a * torch.linalg.cross(b, c)).sum(-1)
        below = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
        angle = 2 * torch.atan2(volume, below).sum(dim=1)
        found[near[angle > 2 * math.pi]] = True
    return found
