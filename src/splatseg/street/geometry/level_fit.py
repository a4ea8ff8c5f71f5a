"""The primitives of one level, fitted to rays."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from splatseg.street.geometry.depth_views import DepthRays
from splatseg.street.geometry.loss import geometry_loss, usable
from splatseg.street.geometry.options import GeometryOptions
from splatseg.street.hits import MeshCaster
from splatseg.street.primitives import Primitives, world_vertices
from splatseg.street.shapes import ShapeAutoEncoder, mesh_regularisers
from splatseg.street.shapes.template import FACES, VERTICES, template

_CARVED_RAYS = 1 << 20
"""Rays that tell which primitives stand before measured surfaces."""

_MIN_SEEN = 8
"""Rays below which a primitive is not judged."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Hits:
    """Rays, and the triangles that they met when last searched for."""

    faces: Int[Tensor, "n"]
    """-1 where a ray met none."""

    directions: Float[Tensor, "n 3"]
    distances: Float[Tensor, "n"]
    """Measured."""

    points: Float[Tensor, "n 3"]
    """Measured, world, float64."""

    errors: Float[Tensor, "n"]
    """How much further than measured a ray went, float64."""


class LevelFit:
    """Codes and centres of the primitives of one level, on their way to the depth of rays.

    Args:
        primitives: Of one level, at least one.
        shapes: The decoder of their codes.
        options: How they are fitted; lengths in scene units.
    """

    def __init__(
        self, primitives: Primitives, shapes: ShapeAutoEncoder, options: GeometryOptions
    ) -> None:
        self._start, self._shapes, self._options = primitives, shapes, options
        self._codes = primitives.codes.clone().requires_grad_()
        self._offsets = torch.zeros_like(primitives.centres).requires_grad_()
        self._size = primitives.sizes[int(primitives.levels[0])]
        groups = [{"params": [self._codes], "lr": options.rate}]
        if options.offset_rate:
            groups.append({"params": [self._offsets], "lr": options.offset_rate})
        self._optimiser = torch.optim.Adam(groups)
        self._rates = [float(group["lr"]) for group in self._optimiser.param_groups]
        _, self._corners = template()

    def primitives(self) -> Primitives:
        """The primitives as they are now; codes that no ray moved are those that were given."""
        with torch.no_grad():
            # A unit vector divided by its norm again is another in its last bits.
            moved = (self._codes != self._start.codes).any(dim=1, keepdim=True)
            return Primitives(
                codes=torch.where(
                    moved, functional.normalize(self._codes, dim=1), self._start.codes
                ),
                centres=self._start.centres + self._offsets * self._start.scales[:, None],
                scales=self._start.scales,
                levels=self._start.levels,
                sizes=self._start.sizes,
            )

    def steps(self, rays: DepthRays, generator: torch.Generator) -> Iterator[tuple[float, float]]:
        """Fit; each step gives its loss of depth and the share of its rays that met a primitive."""
        options = self._options
        hits: _Hits | None = None
        drawn = -(-options.refresh * options.rays // options.reuse)
        for step in range(options.iterations):
            inside = step % options.refresh
            if inside == 0 or hits is None:
                rows = torch.randint(len(rays), (drawn,), generator=generator)
                hits = self._hits(rays, rows)
            share = options.final_rate ** (step / options.iterations)
            for group, rate in zip(self._optimiser.param_groups, self._rates, strict=True):
                group["lr"] = rate * share
            batch = (inside * options.rays + torch.arange(options.rays)) % drawn
            yield self._step(hits, batch)

    def before_surfaces(self, rays: DepthRays, generator: torch.Generator) -> Bool[Tensor, "m"]:
        """Primitives that enough of the rays which meet them first see through."""
        if len(rays) > _CARVED_RAYS:
            rows = torch.randint(len(rays), (_CARVED_RAYS,), generator=generator)
        else:
            rows = torch.arange(len(rays))
        hits = self._hits(rays, rows)
        met = hits.faces >= 0
        owners = hits.faces[met] // FACES
        past = (hits.errors[met] < -self._size).double()
        count = len(self._start)
        seen = torch.bincount(owners, minlength=count)
        through = torch.zeros(count, dtype=torch.float64).index_add_(0, owners, past)
        return (seen >= _MIN_SEEN) & (through >= self._options.carve * seen)

    def _hits(self, rays: DepthRays, rows: Int[Tensor, "n"]) -> _Hits:
        mesh = self.primitives().mesh(self._shapes)
        origins, directions, distances = rays.take(rows)
        found = MeshCaster(mesh).hits(origins, directions, max_hits=1)
        return _Hits(
            faces=found.faces[:, 0],
            directions=directions,
            distances=distances,
            points=origins + directions.double() * distances.double()[:, None],
            errors=(found.distances[:, 0] - distances.double()),
        )

    def _step(self, hits: _Hits, batch: Int[Tensor, "n"]) -> tuple[float, float]:
        options = self._options
        batch = batch[hits.faces[batch] >= 0]
        share = len(batch) / options.rays
        faces = hits.faces[batch]
        owners, owner_of = torch.unique(faces // FACES, return_inverse=True)
        if not len(owners):
            return 0.0, 0.0
        scales = self._start.scales[owners]
        # About the centres: single precision would round the coordinates of a long drive.
        local = world_vertices(
            self._shapes,
            self._codes[owners],
            self._offsets[owners] * scales[:, None],
            scales,
        )
        away = (self._start.centres[owners].double()[owner_of] - hits.points[batch]).float()
        # One index of rows: the gradient of two is added up many times more slowly.
        rows = (VERTICES * owner_of[:, None] + self._corners[faces % FACES]).reshape(-1)
        corners = local.view(-1, 3).index_select(0, rows).view(-1, 3, 3) + away[:, None]
        directions = hits.directions[batch]
        counted = usable(directions, corners, reach=options.truncation * self._size)
        rows = counted.nonzero()[:, 0]
        if not len(rows):
            return 0.0, share
        depth = geometry_loss(
            directions[rows],
            corners[rows],
            hits.distances[batch][rows],
            error=options.error,
            distance_power=options.distance_power,
        )
        loss = options.depth_weight * depth
        if options.regularised:
            loss = loss + self._regularisers(local / scales[:, None, None])
        self._optimiser.zero_grad(set_to_none=False)
        loss.backward()
        self._optimiser.step()
        return float(depth.detach()), share

    def _regularisers(self, shapes: Float[Tensor, "n 42 3"]) -> Float[Tensor, ""]:
        found = mesh_regularisers(shapes, self._corners)
        return (
            self._options.normal_weight * found.normal.mean()
            + self._options.laplacian_weight * found.laplacian.mean()
            + self._options.edge_weight * found.edge.mean()
        )
