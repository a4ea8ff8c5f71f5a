"""Where depth comes from: scans, maps of the capture, evidence, a field, or points."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg._check import check_finite, check_range, check_shape
from splatseg.core import Camera, DepthMap, Renderable, Scan, ScanSource, View
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.fit import ScanDepthOptions, aligned_inverse, scan_depths
from splatseg.io.depths import depth_kind, load_depth
from splatseg.neighbours import NeighbourIndex
from splatseg.street.geometry.depth_views import DepthView

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
    options: ScanDepthOptions | None = None,
    metres_per_unit: float = 1.0,
) -> Iterator[DepthView]:
    """What all laser scans together say of the depth of each view (`fit.scan_depths`).

    Args:
        scans: In the world of the cameras.
        cameras: Of the views.
        options: How scans become depth maps.
        metres_per_unit: Length of a scene unit.
    """
    options = ScanDepthOptions() if options is None else options
    maps = scan_depths(scans, cameras, options=options, metres_per_unit=metres_per_unit)
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
    spacing = ScanDepthOptions().spacing
    if len(cloud) > _SPACING_NEIGHBOURS:
        step = max(1, len(cloud) // _SPACING_SAMPLE)
        found = NeighbourIndex(cloud).nearest(cloud[::step], _SPACING_NEIGHBOURS + 1)
        median = float(found.distances[:, -1].median()) * metres_per_unit
        spacing = median if median > 0 else spacing
    yield from scan_views(
        _OneScan(cloud),
        cameras,
        options=ScanDepthOptions(spacing=spacing),
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
