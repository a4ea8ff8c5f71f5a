"""Points on triangles of primitives: where they are, and the vertices they interpolate (eq. 3)."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn import functional

from splatseg._check import check_shape
from splatseg.core import Camera
from splatseg.core.boundary import boundary
from splatseg.core.threads import caller_threads
from splatseg.street.hits import MeshCaster, MeshHits
from splatseg.street.primitives import PrimitiveMesh
from splatseg.street.radiance import RadianceModel, RadianceOptions, ray_weights
from splatseg.street.shapes import FACES, VERTICES, template


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SurfaceSamples:
    """Points on triangles."""

    corners: Int64[Tensor, "s 3"]
    """Vertices of each point's triangle."""

    weights: Float[Tensor, "s 3"]
    """Barycentric."""

    positions: Float[Tensor, "s 3"]
    """World, scene units, float32."""

    normals: Float[Tensor, "s 3"]
    """Of the triangles, outwards, of length 1; 0 where a triangle has no area."""

    def interpolate(self, values: Float[Tensor, "v c"]) -> Float[Tensor, "s c"]:
        """Values of vertices at the points (eq. 3)."""
        flat = values.index_select(0, self.corners.reshape(-1))
        flat = flat.view(len(self.corners), 3, values.shape[1])
        return torch.einsum("sk,skc->sc", self.weights, flat)


class Surface:
    """The triangles of primitives, to be asked for points on them.

    Args:
        mesh: The primitives.
    """

    def __init__(self, mesh: PrimitiveMesh) -> None:
        self._vertices = mesh.vertices.detach().float()
        self._levels = mesh.levels
        _, faces = template()
        self._faces = faces.to(self._vertices.device)

    def samples(self, faces: Int64[Tensor, "s"], weights: Float[Tensor, "s 3"]) -> SurfaceSamples:
        """Points of triangles, with barycentric weights of their corners."""
        corners = self._faces.index_select(0, faces % FACES)
        corners += (VERTICES * (faces // FACES))[:, None]
        found = self._vertices.index_select(0, corners.T.reshape(-1))
        a, b, c = found.view(3, len(corners), 3).unbind(0)
        positions = weights[:, :1] * a + weights[:, 1:2] * b + weights[:, 2:] * c
        normals = functional.normalize(torch.linalg.cross(b - a, c - a), dim=1)
        return SurfaceSamples(
            corners=corners, weights=weights, positions=positions, normals=normals
        )

    def ordered(self, hits: MeshHits, options: RadianceOptions) -> MeshHits:
        """Hits as the options let them stand behind each other."""
        if options.order == "distance":
            return hits
        levels = self._levels.cpu()[hits.faces.clamp_min(0) // FACES]
        # What is no hit comes after all levels.
        levels = torch.where(hits.valid, levels, len(self._levels) + 1)
        order = levels.argsort(dim=1, stable=True)
        return MeshHits(
            faces=hits.faces.gather(1, order),
            distances=hits.distances.gather(1, order),
            weights=hits.weights.gather(1, order[..., None].expand(-1, -1, 3)),
        )

    def ray_hits(
        self,
        caster: MeshCaster,
        origins: Float[Tensor, "*n 3"],
        directions: Float[Tensor, "n 3"],
        options: RadianceOptions,
    ) -> MeshHits:
        """The hits that the samples of rays are made of, front to back."""
        hits = caster.hits(
            origins,
            directions,
            max_hits=options.max_hits,
            fine_hits=options.fine_hits,
            coarse_hits=options.coarse_hits,
            sides=options.sides,
        )
        return self.ordered(hits, options)


# Rays and views through a trained field.


_RAYS = 4096
"""Rays that one thread looks at together."""

_HALF = 0.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RayValues:
    """What rays see; of a view each has the axes (height, width) first."""

    alpha: Float[Tensor, "*n"]
    """How much primitives stop, in [0, 1]."""

    distance: Float[Tensor, "*n"]
    """Mean distance of what stops it, in units of the direction's length; 0 where nothing does."""

    median_distance: Float[Tensor, "*n"]
    """Distance at which half is stopped; 0 where it is not."""

    probabilities: Float[Tensor, "*n k"]
    """Of the classes, the background's included."""

    colour: Float[Tensor, "*n 3"] | None = None
    """Red, green, blue, the background's included; None where it was not asked for."""


@boundary
def render_rays(
    model: RadianceModel,
    caster: MeshCaster,
    origins: Float[Tensor, "*n 3"],
    directions: Float[Tensor, "n 3"],
    *,
    colour: bool = True,
) -> RayValues:
    """Cast rays at primitives and composite what the field says there (eq. 3 to 5).

    Rays are gone through in blocks of a fixed size, which threads share: memory is needed for the
    answers only, and their bits do not depend on the number of threads.

    Args:
        model: The field.
        caster: Its primitives.
        origins: Where rays start, world: one each, or one point for all.
        directions: Where they go, of any length but 0.
        colour: Whether colours are computed.

    Raises:
        ShapeError: If the shapes do not fit, or the field is of other primitives.
        RangeError: If a value is not finite, or a direction is 0.
    """
    check_shape("directions", directions, (None, 3))
    check_shape("origins", origins, (3,) if origins.ndim < 2 else (len(directions), 3))
    check_shape("caster: vertices", caster.mesh.vertices, (len(model.features), 3))
    surface = Surface(caster.mesh)
    count = len(directions)

    def block(begin: int) -> RayValues:
        part = slice(begin, begin + _RAYS)
        start = origins if origins.ndim < 2 else origins[part]
        return _block(model, caster, surface, start, directions[part], colour=colour)

    parts = list(in_threads(block, range(0, max(count, 1), _RAYS)))
    return RayValues(
        alpha=torch.cat([part.alpha for part in parts]),
        distance=torch.cat([part.distance for part in parts]),
        median_distance=torch.cat([part.median_distance for part in parts]),
        probabilities=torch.cat([part.probabilities for part in parts]),
        colour=torch.cat([part.colour for part in parts if part.colour is not None])
        if colour
        else None,
    )


@boundary
def render_view(
    model: RadianceModel, caster: MeshCaster, camera: Camera, *, colour: bool = True
) -> RayValues:
    """What a camera sees, its lens included: `render_rays` of the centres of its pixels.

    Distances are along the rays; `depth_from_distance` makes z-depths of them.
    """
    origin, directions = camera.rays()
    size = (camera.height, camera.width)
    seen = render_rays(model, caster, origin, directions.reshape(-1, 3), colour=colour)
    return RayValues(
        alpha=seen.alpha.view(size),
        distance=seen.distance.view(size),
        median_distance=seen.median_distance.view(size),
        probabilities=seen.probabilities.view(*size, -1),
        colour=None if seen.colour is None else seen.colour.view(*size, 3),
    )


@boundary
def depth_from_distance(
    camera: Camera, distance: Float[Tensor, "height width"]
) -> Float[Tensor, "height width"]:
    """z-depths of points at distances along the rays of pixels."""
    _, directions = camera.rays()
    forward = camera.world_from_cam[:3, 2]
    return distance * (directions @ forward).to(distance)


def in_threads(work: Callable[[int], RayValues], items: range) -> Iterator[RayValues]:
    """Do work on as many threads as torch has, each by itself with one; results in order."""
    threads = caller_threads()
    if threads == 1 or len(items) == 1:
        yield from map(work, items)
        return
    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(work, items)


def _block(
    model: RadianceModel,
    caster: MeshCaster,
    surface: Surface,
    origins: Tensor,
    directions: Tensor,
    *,
    colour: bool,
) -> RayValues:
    with torch.no_grad():
        hits = surface.ray_hits(caster, origins, directions, model.options)
        valid = hits.valid
        rows = valid.reshape(-1).nonzero()[:, 0]
        width = valid.shape[1]
        samples = surface.samples(hits.faces[valid], hits.weights[valid])
        unit = functional.normalize(directions.detach().cpu().double(), dim=1).float()
        hidden = model.hidden(samples.positions, samples.interpolate(model.features))
        behind, behind_probabilities = model.background_of(unit)
        opacity = torch.zeros(valid.numel())
        opacity[rows] = model.opacity_of(hidden)
        weights, passed = ray_weights(opacity.view_as(valid))
        probabilities = _summed(weights, rows, model.probabilities_of(hidden))
        shown = None
        if colour:
            colours = model.colour_of(hidden, unit[rows // width], samples.normals)
            shown = _summed(weights, rows, colours) + passed[:, None] * behind
        distances = torch.where(valid, hits.distances, 0.0).float()
        stopped = weights.sum(dim=1)
        mean = (weights * distances).sum(dim=1) / stopped.clamp_min(1e-12)
        reached = weights.cumsum(dim=1) >= _HALF
        first = reached.int().argmax(dim=1, keepdim=True)
        median = distances.gather(1, first)[:, 0]
        return RayValues(
            alpha=(1 - passed).clamp(0, 1),
            distance=torch.where(stopped > 0, mean, 0.0),
            median_distance=torch.where(reached.any(dim=1), median, 0.0),
            probabilities=probabilities + passed[:, None] * behind_probabilities,
            colour=shown,
        )


def _summed(
    weights: Float[Tensor, "n hits"], rows: Tensor, values: Float[Tensor, "s c"]
) -> Float[Tensor, "n c"]:
    """Sums over the samples of each ray, which stand in `rows` of ``n * hits`` places."""
    all_values = values.new_zeros(weights.numel(), values.shape[1])
    all_values[rows] = values
    return torch.einsum("nl,nlc->nc", weights, all_values.view(*weights.shape, values.shape[1]))
