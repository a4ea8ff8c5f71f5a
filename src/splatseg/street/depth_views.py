"""Depth of views: of scans, maps of the capture, evidence, a field, or points."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg._check import check_finite, check_range, check_shape, check_values
from splatseg.core import Camera, DepthMap, Renderable, Scan, ScanSource, View
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError
from splatseg.fit import SCAN_SPACING, aligned_inverse, scan_depths
from splatseg.io.depths import depth_kind, load_depth
from splatseg.neighbours import NeighbourIndex


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthView:
    """The depth that is known of one view.

    Raises:
        ShapeError: If the map has not the camera's pixels; `Camera.resized` makes a camera of them.
        RangeError: If a depth is NaN, infinite or negative.
    """

    camera: Camera
    """Of the pixels of the map."""

    depth: Float[Tensor, "height width"]
    """z-depth, scene units, float32; 0 where nothing is known."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_shape("depth", self.depth, (self.camera.height, self.camera.width))
        check_values("depth", self.depth, 0.0, math.inf)
        object.__setattr__(self, "depth", self.depth.detach().cpu().float())


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthRays:
    """Rays of which it is known where they end."""

    origins: Float[Tensor, "views 3"]
    """Centres of the views, world, float64."""

    views: Int[Tensor, "n"]
    """View of each ray, int32."""

    directions: Float[Tensor, "n 3"]
    """Unit directions, world, float32."""

    distances: Float[Tensor, "n"]
    """Along the ray, scene units, float32."""

    def __len__(self) -> int:
        """How many rays there are."""
        return len(self.views)

    def take(self, rows: Int[Tensor, "m"]) -> tuple[Tensor, Tensor, Tensor]:
        """Origins (m, 3), directions (m, 3) and distances (m,) of some rays."""
        return self.origins[self.views[rows].long()], self.directions[rows], self.distances[rows]


@boundary
def axis_cosines(camera: Camera, directions: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
    """Cosines between directions of length 1 and the camera's axis: z-depth over distance."""
    return directions @ camera.cam_from_world[2, :3].to(directions)


def collect_rays(
    views: Iterable[DepthView], *, max_rays: int, max_depth: float, generator: torch.Generator
) -> DepthRays:
    """The rays of all views with a depth, or an even sample of them.

    Views are taken one at a time. Each ray has a random number, and once there are too many, those
    with the larger half of the numbers are left out, of later views too.

    Args:
        views: Read once.
        max_rays: How many are kept.
        max_depth: z-depth above which a ray is not used, scene units.
        generator: Of the numbers.

    Raises:
        InputError: If no ray has a depth.
    """
    kept: list[tuple[Tensor, ...]] = []
    origins: list[Tensor] = []
    bound, count = 1.0, 0
    for view in views:
        depth = torch.where(view.depth <= max_depth, view.depth, 0.0)
        row, column = torch.nonzero(depth > 0, as_tuple=True)
        drawn = torch.rand(len(row), generator=generator)
        row, column, drawn = (part[drawn < bound] for part in (row, column, drawn))
        pixels = torch.stack((column, row), dim=1).double() + 0.5
        origin, directions = view.camera.rays(pixels)
        cosines = axis_cosines(view.camera, directions)
        which = torch.full((len(row),), len(origins), dtype=torch.int32)
        forward = cosines > 0
        parts = (which, directions.float(), (depth[row, column] / cosines).float(), drawn)
        kept.append(tuple(part[forward] for part in parts))
        origins.append(origin.double())
        count += int(forward.sum())
        while count > max_rays:
            bound /= 2
            kept = [tuple(part[rays[3] < bound] for part in rays) for rays in kept]
            count = sum(len(rays[0]) for rays in kept)
    if not count:
        raise InputError(
            f"depths: expected views with depth to fit to, got {len(origins)} views without any."
        )
    which, directions, distances, _ = (torch.cat(parts) for parts in zip(*kept, strict=True))
    return DepthRays(
        origins=torch.stack(origins), views=which, directions=directions, distances=distances
    )


# Where depth comes from: scans, maps of the capture, evidence, a field, or points.


_MIN_ALPHA = 0.5
_SPACING_SAMPLE = 4096
_SPACING_NEIGHBOURS = 4


@runtime_checkable
class DepthSource(Protocol):
    """Depth maps by view name, read when asked for: evidence of depth."""

    def depth_map(self, name: str) -> DepthMap:
        """The depth map of one view."""
        ...


@boundary
def scan_views(
    scans: ScanSource,
    cameras: Sequence[Camera],
    *,
    spacing: float = SCAN_SPACING,
    metres_per_unit: float = 1.0,
) -> Iterator[DepthView]:
    """What all laser scans together say of the depth of each view (`fit.scan_depths`).

    Args:
        scans: In the world of the cameras.
        cameras: Of the views.
        spacing: Distance of points on a surface that all scans together saw, metres.
        metres_per_unit: Length of a scene unit.
    """
    maps = scan_depths(scans, cameras, spacing=spacing, metres_per_unit=metres_per_unit)
    for camera, depth in zip(cameras, maps, strict=True):
        yield DepthView(camera=camera, depth=depth)


@boundary
def point_views(
    points: Float[Tensor, "n 3"],
    cameras: Sequence[Camera],
    *,
    metres_per_unit: float = 1.0,
) -> Iterator[DepthView]:
    """The depth of the points that no nearer point hides, such as those of structure from motion.

    A point hides what lies behind it within the distance at which its neighbours are, the median
    over points of that of the fourth nearest.

    Args:
        points: On surfaces, world, scene units.
        cameras: Of the views.
        metres_per_unit: Length of a scene unit.

    Raises:
        InputError: If there are no points.
        RangeError: If a point is not finite.
    """
    check_shape("points", points, (None, 3))
    check_finite("points", points)
    if not len(points):
        raise InputError("points: expected at least one point to see, got none.")
    cloud = points.detach().cpu().double()
    spacing = SCAN_SPACING
    if len(cloud) > _SPACING_NEIGHBOURS:
        step = max(1, len(cloud) // _SPACING_SAMPLE)
        found = NeighbourIndex(cloud).nearest(cloud[::step], _SPACING_NEIGHBOURS + 1)
        median = float(found.distances[:, -1].median()) * metres_per_unit
        spacing = median if median > 0 else spacing
    yield from scan_views(
        _OneScan(cloud),
        cameras,
        spacing=spacing,
        metres_per_unit=metres_per_unit,
    )


@boundary
def capture_views(views: Iterable[View]) -> Iterator[DepthView]:
    """The depth maps of a capture; views without one are left out.

    Raises:
        InputError: If a map is relative: it tells no distance.
    """
    for view in views:
        if view.depth is None:
            continue
        if depth_kind(view.depth) == "relative":
            raise InputError(
                f"view {view.name!r}: expected a metric depth map, got a relative one; give it as "
                "evidence, which is aligned to points."
            )
        yield _resized(view.camera, load_depth(view))


@boundary
def evidence_views(
    source: DepthSource,
    views: Iterable[View],
    *,
    points: Float[Tensor, "n 3"] | None = None,
    metres_per_unit: float = 1.0,
) -> Iterator[DepthView]:
    """Depth that a model or a sensor recorded as evidence.

    Args:
        source: Maps by the names of views. Metric ones are in metres; relative ones are aligned to
            the points in view, and a view with too few of them is left out.
        views: Of which there is a map.
        points: On surfaces, world, scene units; relative maps need them.
        metres_per_unit: Length of a scene unit.

    Raises:
        InputError: If a map is relative and there are no points.
    """
    for view in views:
        found = source.depth_map(view.name)
        values: Tensor | None = found.values / metres_per_unit
        if found.kind == "relative":
            if points is None or not len(points):
                raise InputError(
                    f"points: expected points to align the relative depth of view {view.name!r} "
                    "to, got none."
                )
            inverse = aligned_inverse(found.values, view.camera, points)
            values = None if inverse is None else torch.where(inverse > 0, 1 / inverse, 0.0)
        if values is not None:
            yield _resized(view.camera, values)


@boundary
def field_views(
    field: Renderable, cameras: Iterable[Camera], *, min_alpha: float = _MIN_ALPHA
) -> Iterator[DepthView]:
    """The depth that a field shows, such as that of Gaussians of the same drive.

    It is the median depth, or the expected one of a field that knows no other.

    Args:
        field: What is looked at.
        cameras: Of the views.
        min_alpha: Pixels whose alpha is less have no depth.
    """
    check_range("min_alpha", min_alpha, 0.0, 1.0)
    for camera in cameras:
        with field.view(camera) as view:
            signals = view.signals(colour=False)
        depth = signals.depth if signals.median_depth is None else signals.median_depth
        seen = (signals.alpha >= min_alpha) & (depth > 0)
        yield DepthView(camera=camera, depth=torch.where(seen, depth, 0.0))


def filled_views(first: Iterable[DepthView], other: Iterable[DepthView]) -> Iterator[DepthView]:
    """Depth of the same views from two sources: the first's, and the other's where it has none.

    Args:
        first: Depth of views.
        other: Of the same, in the same order and size.

    Raises:
        ShapeError: If two maps of a view differ in size.
        ValueError: If one source has more views than the other.
    """
    for one, two in zip(first, other, strict=True):
        check_shape("other: depth", two.depth, tuple(one.depth.shape))
        yield DepthView(camera=one.camera, depth=torch.where(one.depth > 0, one.depth, two.depth))


def _resized(camera: Camera, depth: Tensor) -> DepthView:
    height, width = depth.shape
    return DepthView(camera=camera.resized(width, height), depth=depth)


class _OneScan:
    """Points as the only scan of a source."""

    scan_names = ("points",)

    def __init__(self, points: Tensor) -> None:
        self._points = points

    def scan(self, name: str) -> Scan:
        """All points."""
        return Scan(name=name, points=self._points)
