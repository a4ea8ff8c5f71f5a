"""Shapes of primitives fitted to depth (eq. 2)."""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from msgspec import Meta
from torch import Tensor
from torch.nn import functional

from splatseg._check import check_range
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.options import (
    MAY_BE_INFINITE,
    Count,
    Natural,
    NonNegative,
    Positive,
    options,
)
from splatseg.errors import InputError, RangeError
from splatseg.raycast import through_triangles
from splatseg.street.depth_views import DepthRays, DepthView, collect_rays
from splatseg.street.hits import MeshCaster, enclosing
from splatseg.street.primitives import Primitives, world_vertices
from splatseg.street.shapes import (
    FACES,
    VERTICES,
    ShapeAutoEncoder,
    template,
)

ErrorKind = Literal["ray", "plane"]
"""ray: |t - d| along the ray, as published. plane: the distance of the measured point from the
plane of the triangle, |t - d| times the cosine between ray and normal."""


_UNUSED = "no setting uses it: it was measured and did not help"


@options(
    removed={
        "max_rays": "4 million rays are kept",
        "max_depth": "depths of up to 50 m are used",
        "truncation": _UNUSED,
        "distance_power": _UNUSED,
        "normal_weight": _UNUSED,
        "laplacian_weight": _UNUSED,
        "edge_weight": _UNUSED,
    }
)
class GeometryOptions:
    """How primitives are fitted to depth (eq. 2). Lengths are metres."""

    iterations: Natural = 1000
    """Steps of the optimiser, 0 or more."""

    rays: Count = 32768
    """Rays of a step."""

    refresh: Count = 20
    """Steps after which first hits are searched again. Between, a ray keeps its triangle, and its
    distance is that of the triangle's plane as it is now."""

    reuse: Count = 10
    """In how many of these steps a ray is used; as many fewer rays are searched for."""

    rate: Positive = 0.02
    """Learning rate of the codes (Adam)."""

    offset_rate: NonNegative = 0.01
    """Learning rate of the offsets of centres, in units of their primitive; 0 leaves centres where
    the points' means are."""

    final_rate: Positive = 0.05
    """What part of both rates is left at the last step; they fall exponentially."""

    depth_weight: Positive = 1.0
    """Factor of the error of depth."""

    error: ErrorKind = "plane"
    """What is minimised."""

    carve: Annotated[float, Meta(gt=0, extra=MAY_BE_INFINITE)] = math.inf
    """Primitives before measured surfaces are removed after the fit: those through which at least
    this share of their rays sees further than a side of their voxel. Above 1 none is, as
    published, and a camera inside a primitive is refused; else such a primitive is removed
    first."""


MAX_DEPTH = 50.0
"""Metres: larger z-depths are not used."""

_MAX_RAYS = 4_000_000
"""Rays with depth that are kept in memory, drawn evenly from all views: 24 bytes each, and as much
again when they are put together."""


PUBLISHED_GEOMETRY = GeometryOptions(
    iterations=5000,
    rays=4096,
    refresh=100,
    reuse=1,
    rate=5e-4,
    offset_rate=5e-4,
    final_rate=0.999999**5000,
    depth_weight=0.05,
    error="ray",
)
"""The paper's iterations and rays, and the rates of the public code of DNMP, which rasterises its
meshes in each step where first hits are searched every 100 here."""


# The geometry loss of rays (eq. 2), differentiable in the triangles that they meet.
#
# With the measured point p at distance d along the ray of unit direction r, and the triangle that
# the ray meets first, the error is how much further the ray goes to the triangle's plane:
#
# .. math:: t - d = \frac{(a - p) \cdot n}{r \cdot n}
#
# It is computed about p, so that single precision is enough at any place of a drive.


_FLAT = 1e-4
"""Cosines between ray and normal below this have no usable gradient."""


def plane_errors(
    directions: Float[Tensor, "n 3"], corners: Float[Tensor, "n 3 3"]
) -> Float[Tensor, "n"]:
    """Errors t - d of rays, differentiable in the corners of their triangles.

    Args:
        directions: Of length 1.
        corners: Of the triangles, from the measured point of each ray.

    Returns:
        How much further than measured each ray goes to the plane of its triangle; NaN where it is
        parallel to it.
    """
    errors, _ = through_triangles(torch.zeros_like(directions), directions, corners)
    return errors


def incidence(
    directions: Float[Tensor, "n 3"], corners: Float[Tensor, "n 3 3"]
) -> Float[Tensor, "n"]:
    """Cosines between rays and the normals of triangles, not negative; 0 without an area."""
    a, b, c = corners.unbind(-2)
    normals = torch.linalg.cross(b - a, c - a)
    lengths = torch.linalg.vector_norm(normals, dim=-1)
    return (normals * directions).sum(-1).abs() / lengths.clamp_min(torch.finfo(lengths.dtype).tiny)


def usable(directions: Float[Tensor, "n 3"], corners: Float[Tensor, "n 3 3"]) -> Bool[Tensor, "n"]:
    """Rays whose error and its gradient are finite."""
    with torch.no_grad():
        errors = plane_errors(directions, corners).abs()
        return errors.isfinite() & (incidence(directions, corners) > _FLAT)


def geometry_loss(
    directions: Float[Tensor, "n 3"],
    corners: Float[Tensor, "n 3 3"],
    *,
    error: ErrorKind = "ray",
) -> Float[Tensor, ""]:
    """The mean absolute error of rays, each of them usable and with its triangle.

    Args:
        directions: Of length 1.
        corners: From the measured point of each ray.
        error: Along the ray or to the plane; the latter's cosines count as constants.
    """
    errors = plane_errors(directions, corners).abs()
    if error == "plane":
        errors = errors * incidence(directions, corners).detach()
    return errors.mean()


# The primitives of one level, fitted to rays.


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
        counted = usable(directions, corners)
        rows = counted.nonzero()[:, 0]
        if not len(rows):
            return 0.0, share
        depth = geometry_loss(
            directions[rows],
            corners[rows],
            error=options.error,
        )
        loss = options.depth_weight * depth
        self._optimiser.zero_grad(set_to_none=False)
        loss.backward()
        self._optimiser.step()
        return float(depth.detach()), share


# Primitives to the depth of views (eq. 2).


_RECORDED = 100
"""Records of each level's fit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GeometryRecord:
    """How far the fit of one level is."""

    level: int
    """Level of the primitives, 0 the finest; levels are fitted one after the other."""

    step: int
    """Steps of this level that are done."""

    loss: float
    """Mean error of the depth of this step's rays, scene units (or as `GeometryOptions` has it)."""

    hit_share: float
    """Share of this step's rays that met a primitive of the level."""

    progress: float
    """Share of the whole fit that is done, in [0, 1]."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GeometryFit:
    """Primitives that were fitted to depth."""

    primitives: Primitives
    """With the shapes and centres that were found, those that were removed left out."""

    records: tuple[GeometryRecord, ...]
    """The loss on its way, about a hundred records a level."""

    rays: int
    """Rays with depth that were kept to fit to."""

    enclosing: int
    """Primitives that were removed because a camera stood inside."""

    carved: int
    """Primitives that were removed because they stood before measured surfaces."""

    def __post_init__(self) -> None:
        convert_fields(self)


@boundary
def fit_geometry(
    primitives: Primitives,
    shapes: ShapeAutoEncoder,
    depths: Iterable[DepthView],
    *,
    options: GeometryOptions | None = None,
    seed: int = 0,
    metres_per_unit: float = 1.0,
    progress: Callable[[GeometryRecord], None] | None = None,
) -> GeometryFit:
    """Fit shapes and centres of primitives to depth, each level by itself.

    The same arguments give the same bits, whatever the number of threads.

    Args:
        primitives: Where they start.
        shapes: The auto-encoder of their codes, which stays as it is.
        depths: Depth of views, read once, one at a time.
        options: How they are fitted.
        seed: Of the rays that are drawn, 0 or more.
        metres_per_unit: Length of a scene unit.
        progress: Told every record.

    Raises:
        InputError: If there are no primitives, no view has depth, a camera stands inside a
            primitive and primitives are not carved, or all of them would be removed.
        ShapeError: If codes have not the size of the shapes' codes.
        RangeError: If a depth is NaN.
    """
    options = GeometryOptions() if options is None else options
    if not len(primitives):
        raise InputError("primitives: expected at least one to fit, got none.")
    check_range("seed", seed, 0, 2**63 - 1)
    if not 0 < metres_per_unit < float("inf"):
        raise RangeError(f"metres_per_unit: expected a positive length, got {metres_per_unit:g}.")
    rays = collect_rays(
        depths,
        max_rays=_MAX_RAYS,
        max_depth=MAX_DEPTH / metres_per_unit,
        generator=_generator(seed, 0),
    )
    around = enclosing(primitives.mesh(shapes), rays.origins)
    if bool(around.any()) and options.carve > 1:
        row = int(around.nonzero()[0])
        raise InputError(
            f"primitives: expected none around a camera, got primitive {row} (and "
            f"{int(around.sum()) - 1} more) with one inside; carving would remove it."
        )
    left = _left(primitives, ~around)
    fitted: list[Primitives] = []
    records: list[GeometryRecord] = []
    carved = 0
    levels = torch.unique(left.levels).tolist()
    for i, level in enumerate(levels):
        generator = _generator(seed, 1 + level)
        fit = LevelFit(left.subset(left.levels == level), shapes, options)
        for record in _records(fit, rays, options, generator):
            told = replace(record, level=level, progress=(i + record.progress) / len(levels))
            records.append(told)
            if progress is not None:
                progress(told)
        found = fit.primitives()
        if options.carve <= 1:
            before = fit.before_surfaces(rays, generator)
            carved += int(before.sum())
            found = found.subset(~before)
        fitted.append(found)
    return GeometryFit(
        primitives=_joined(fitted),
        records=tuple(records),
        rays=len(rays),
        enclosing=int(around.sum()),
        carved=carved,
    )


def _generator(seed: int, stream: int) -> torch.Generator:
    """Random numbers of its own for what is independent of all else."""
    state = np.random.SeedSequence([seed, stream]).generate_state(1)
    return torch.Generator().manual_seed(int(state[0]))


def _records(
    fit: LevelFit, rays: DepthRays, options: GeometryOptions, generator: torch.Generator
) -> Iterable[GeometryRecord]:
    every = max(1, options.iterations // _RECORDED)
    for step, (loss, share) in enumerate(fit.steps(rays, generator), start=1):
        if step % every == 0 or step == options.iterations:
            yield GeometryRecord(
                level=0,
                step=step,
                loss=loss,
                hit_share=share,
                progress=step / options.iterations,
            )


def _left(primitives: Primitives, kept: torch.Tensor) -> Primitives:
    left = primitives.subset(kept)
    if not len(left):
        raise InputError(
            f"primitives: expected some without a camera inside, got {len(primitives)} that have."
        )
    return left


def _joined(parts: list[Primitives]) -> Primitives:
    joined = Primitives(
        codes=torch.cat([part.codes for part in parts]),
        centres=torch.cat([part.centres for part in parts]),
        scales=torch.cat([part.scales for part in parts]),
        levels=torch.cat([part.levels for part in parts]),
        sizes=parts[0].sizes,
    )
    if not len(joined):
        raise InputError("primitives: expected some on measured surfaces, got all before them.")
    return joined
