"""Where rays meet triangles first: Embree's search, and the point of a known triangle."""

import contextlib
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, RangeError, ShapeError, import_package


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


# Triangles arranged by Embree, to be met by rays.


_RAYS = 1 << 18
"""Rays that are looked at together: about 60 MB."""


class RayCaster:
    """Triangles, arranged so that rays find the first one that they meet.

    Embree searches in single precision, about the middle of the triangles and watertight: no ray
    slips through an edge that two triangles share. Distance and weights are then computed in
    double precision. Both sides of a triangle are met. Where two triangles are met at distances
    that single precision does not tell apart, it may be either; the answer is the same in every
    call.

    Args:
        vertices: Corners of the triangles, world.
        faces: Vertices of each triangle, at least one triangle.

    Raises:
        ShapeError: If they are not (n, 3) and (m, 3).
        RangeError: If a vertex is not finite, or a corner is no vertex.
        InputError: If there is no triangle.
        MissingPackageError: If embreex is not installed.

    Example:
        >>> caster = RayCaster(torch.eye(3), torch.tensor([[0, 1, 2]]))
        >>> hits = caster.cast(torch.zeros(3), torch.tensor([[1.0, 1, 1], [1, 0, -1]]))
        >>> hits.faces.tolist(), round(float(hits.distances[0]), 6)
        ([0, -1], 0.333333)
    """

    @boundary
    def __init__(self, vertices: Float[Tensor, "n 3"], faces: Int[Tensor, "m 3"]) -> None:
        check_finite("vertices", vertices)
        if not len(faces):
            raise InputError("faces: expected at least one triangle, got none.")
        self._vertices = vertices.detach().cpu().double()
        self._faces = faces.detach().cpu().long()
        if int(self._faces.min()) < 0 or int(self._faces.max()) >= len(vertices):
            raise RangeError(
                f"faces: expected indices of {len(vertices)} vertices, got "
                f"[{int(self._faces.min())}, {int(self._faces.max())}]."
            )
        used = self._vertices[self._faces.unique()]
        self._middle = (used.amin(dim=0) + used.amax(dim=0)) / 2
        self._scene = _scene(self._vertices - self._middle, self._faces)

    def __len__(self) -> int:
        """How many triangles there are."""
        return len(self._faces)

    @boundary
    def cast(self, origins: Float[Tensor, "*n 3"], directions: Float[Tensor, "n 3"]) -> RayHits:
        """The first triangle that each ray meets.

        Args:
            origins: Where rays start, world: one each, or one point for all.
            directions: Where they go, of any length but 0.

        Raises:
            ShapeError: If there is not one origin, or as many as directions.
            RangeError: If a value is not finite, or a direction is 0.
        """
        check_shape("origins", origins, (3,) if origins.ndim < 2 else (len(directions), 3))
        check_finite("origins", origins)
        check_finite("directions", directions)
        if bool((directions == 0).all(dim=-1).any()):
            raise RangeError("directions: expected lengths above 0, got one of 0.")
        directions = directions.detach().cpu().double()
        starts = origins.detach().cpu().double().expand_as(directions)
        parts = [
            self._cast(o, d)
            for o, d in zip(starts.split(_RAYS), directions.split(_RAYS), strict=True)
        ]
        return RayHits(
            faces=torch.cat([one.faces for one in parts]),
            distances=torch.cat([one.distances for one in parts]),
            weights=torch.cat([one.weights for one in parts]),
        )

    def _cast(self, origins: Tensor, directions: Tensor) -> RayHits:
        lengths = torch.linalg.vector_norm(directions, dim=-1, keepdim=True)
        found = self._scene.run(
            (origins - self._middle).float().numpy(),
            (directions / lengths).float().numpy(),
            output=1,
        )
        faces = torch.from_numpy(found["primID"].astype(np.int64))
        hit = (faces >= 0).nonzero()[:, 0]
        corners = self._vertices[self._faces[faces[hit]]]
        t, weights = through_triangles(origins[hit], directions[hit], corners)
        # Seen exactly along its plane a triangle has no point of its own; Embree's will do.
        rough = _rough_weights(found, hit)
        flat = ~(t.isfinite() & (weights > -1).all(dim=-1))
        t = torch.where(flat, torch.from_numpy(found["tfar"]).double()[hit] / lengths[hit, 0], t)
        distances = torch.full((len(faces),), math.inf, dtype=torch.float64)
        distances[hit] = t
        all_weights = torch.zeros(len(faces), 3, dtype=torch.float64)
        all_weights[hit] = torch.where(flat[:, None], rough, weights)
        return RayHits(faces=faces, distances=distances, weights=all_weights)


def _rough_weights(found: Any, hit: Tensor) -> Tensor:
    u, v = (torch.from_numpy(found[name]).double()[hit] for name in ("u", "v"))
    return torch.stack((1 - u - v, u, v), dim=-1)


def _scene(vertices: Tensor, faces: Tensor) -> Any:
    scenes = import_package("embreex.rtcore_scene", "casting rays at meshes", "mesh")
    meshes = import_package("embreex.mesh_construction", "casting rays at meshes", "mesh")
    scene = scenes.EmbreeScene(robust=True)
    # The corners of each triangle beside each other: indices of Embree have 32 bits.
    corners = vertices.float()[faces].contiguous().numpy()
    meshes.TriangleMesh(scene, corners)
    return scene
