r"""Depth supervision: the expected depth of a view is compared with its depth map.

The loss of a view is

.. math:: \frac{\lambda}{m} \sum_p \left| \frac{s}{d(p)} - \frac{s}{D(p)} \right|

over the m pixels with a measured depth D and a rendered alpha of at least 0.5; d is the expected
depth and s the median of D, so that the unit of length does not matter. The 3DGS code regularises
inverse depth too: far surfaces, whose depth is uncertain, count less.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn.functional import max_pool2d

from splatseg._check import check_finite, check_shape
from splatseg.core import Camera, PointCloud, ScanSource, View
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, ShapeError
from splatseg.fit._options import FitOptions
from splatseg.io.depths import depth_kind, load_depth
from splatseg.render.warp import Warp, undistorted_camera

_FINAL_WEIGHT = 0.01
"""Factor of the weight at progress 1: the photographs dominate at the end."""

_MIN_ALPHA = 0.5
_MIN_DEPTH_SHARE = 0.1
"""Rendered depths are clamped to this share of the median: the gradient of 1 / d is unbounded, and
one Gaussian before the lens would dominate the loss."""

_ALIGNMENT_ROUNDS = 10
_MIN_POINTS = 20
"""Minimum number of start points in view to align a relative depth map."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthLoss:
    """The depth loss of one render."""

    value: float
    gradient: Float[Tensor, "height width"]
    """Derivative of `value` with respect to the expected depth."""


class DepthMaps:
    """Depth maps of the training views, read at first use.

    Args:
        views: The training views; those without a depth map have no depth loss.
        points: Points on the surfaces, to which relative maps are aligned.
        options: ``metric`` maps hold z-depth. ``relative`` ones hold inverse depth up to a scale
            and a shift of each view, as monocular depth networks predict it; the points in view
            determine both (see `aligned_inverse`). Evidence tells which of them it is: its metric
            maps may be taken as relative ones, by their inverse, but not the other way round.
        where: Prefix of messages.

    Raises:
        InputError: If no view has a depth map, relative maps have no points to align to, or
            metric ones are asked for and evidence is relative.
    """

    def __init__(
        self,
        views: Sequence[View],
        *,
        points: Float[Tensor, "n 3"] | None,
        options: FitOptions,
        where: str,
    ) -> None:
        if not any(view.depth is not None for view in views):
            raise InputError(
                f"{where}: expected depth maps of training views, as depth supervision "
                "needs them, got none."
            )
        self._views = tuple(views)
        self._relative = options.depth == "relative"
        self._kinds = [None if view.depth is None else depth_kind(view.depth) for view in views]
        if not self._relative and "relative" in self._kinds:
            name = views[self._kinds.index("relative")].name
            raise InputError(
                f"{where}: expected metric depth maps, got relative ones (view {name!r}); "
                "depth relative takes them."
            )
        self._weight = options.depth_weight
        self._points: Tensor | None = None
        if self._relative:
            if points is None or len(points) == 0:
                raise InputError(
                    f"{where}: expected start points to align relative depth maps to, got none."
                )
            self._points = points
        self._maps: dict[int, tuple[Tensor, float] | None] = {}

    def loss(
        self,
        index: int,
        depth: Float[Tensor, "height width"],
        alpha: Float[Tensor, "height width"],
        *,
        progress: float,
        mask: Bool[Tensor, "height width"] | None = None,
    ) -> DepthLoss | None:
        """The loss of a view's expected depth; None where the view has no depth map.

        Both are sampled at the coarser of the two resolutions, without interpolation: between an
        object and its background there is no depth.

        Args:
            index: Which training view.
            depth: The render's expected depth, at any resolution.
            alpha: Its alpha.
            progress: The weight decays exponentially with it.
            mask: Valid pixels; None is all.
        """
        known = self._map(index)
        if known is None:
            return None
        inverse, scale = known
        rows, map_rows = _matching_indices(depth.shape[0], inverse.shape[0])
        columns, map_columns = _matching_indices(depth.shape[1], inverse.shape[1])
        drawn = depth.detach()[rows][:, columns]
        target = inverse[map_rows][:, map_columns].to(drawn)
        counts = (target > 0) & (alpha.detach()[rows][:, columns] >= _MIN_ALPHA)
        if mask is not None:
            counts &= mask[rows][:, columns]
        weight = self._weight * _FINAL_WEIGHT**progress / max(1, int(counts.sum()))
        bounded = drawn.clamp_min(_MIN_DEPTH_SHARE * scale)
        difference = torch.where(counts, scale / bounded - scale * target, 0.0)
        depth_gradient = -weight * difference.sign() * scale / bounded.square()
        gradient = torch.zeros_like(depth)
        gradient[rows.unsqueeze(1), columns] = depth_gradient
        return DepthLoss(value=weight * float(difference.abs().sum()), gradient=gradient)

    def _map(self, index: int) -> tuple[Tensor, float] | None:
        """Inverse depth in one over scene units (0 is unknown) and the median depth."""
        if index not in self._maps:
            view = self._views[index]
            metric = self._kinds[index] == "metric"
            found = None if view.depth is None else self._read(view, inverted=metric)
            self._maps[index] = found
        return self._maps[index]

    def _read(self, view: View, *, inverted: bool) -> tuple[Tensor, float] | None:
        """The map of a view; of a relative one whether its file has the inverse of what it says."""
        values = load_depth(view)
        if not view.camera.is_pinhole:
            values = _undistorted_map(values, view.camera)
        if self._points is None:
            inverse = torch.where(values > 0, 1 / values.clamp_min(1e-12), 0.0)
        else:
            if inverted:
                values = torch.where(values > 0, 1 / values.clamp_min(1e-12), 0.0)
            aligned = aligned_inverse(values, view.camera, self._points)
            if aligned is None:
                return None
            inverse = aligned
        known = inverse[inverse > 0]
        return (inverse, float(1 / known.median())) if len(known) else None


@boundary
def aligned_inverse(
    values: Float[Tensor, "rows columns"], camera: Camera, points: Float[Tensor, "n 3"]
) -> Float[Tensor, "rows columns"] | None:
    """Align a relative map to inverse depth, by the points in its view.

    Scale and shift are initialised from medians and mean absolute deviations, as in the 3DGS code,
    and refined by ten rounds of least squares over the half of the points with the smallest
    residuals, because the others may be occluded. None where fewer than 20 points are in view,
    or the map is constant.

    Raises:
        ShapeError: If the map is no image of a pixel or more, or points are not (n, 3).
        RangeError: If a value of the map or a point is not finite.
    """
    check_shape("values", values, (None, None))
    if not values.numel():
        raise ShapeError(f"values: expected a map with pixels, got {tuple(values.shape)}.")
    check_shape("points", points, (None, 3))
    check_finite("values", values)
    check_finite("points", points)
    straight = undistorted_camera(camera)
    pixels, z = straight.project(points.double())
    size = pixels.new_tensor([straight.width, straight.height])
    inside = (z > 0) & (pixels >= 0).all(dim=1) & (pixels < size).all(dim=1)
    cell = pixels[inside] / size * pixels.new_tensor([values.shape[1], values.shape[0]])
    column, row = cell.long().unbind(1)
    seen = values[row, column].double()
    point_values = 1 / z[inside][seen > 0]
    seen = seen[seen > 0]
    if len(seen) < _MIN_POINTS:
        return None
    value_centre, target = seen.median(), point_values.median()
    spread = (seen - value_centre).abs().mean()
    if float(spread) <= 0:
        return None
    scale = (point_values - target).abs().mean() / spread
    for _ in range(_ALIGNMENT_ROUNDS):
        residuals = ((seen - value_centre) * scale + target - point_values).abs()
        near = residuals <= residuals.median()
        value_centre, target = seen[near].mean(), point_values[near].mean()
        centred = seen[near] - value_centre
        if float(centred.square().sum()) <= 0:
            return None
        scale = (centred * (point_values[near] - target)).sum() / centred.square().sum()
    inverse = ((values.double() - value_centre) * scale + target).float()
    return torch.where(values > 0, inverse.clamp_min(0), 0.0)


def _undistorted_map(values: Tensor, camera: Camera) -> Tensor:
    """A distorted photograph's depth map in the pixels of its undistorted image, nearest.

    Depth along the axis does not depend on the lens.
    """
    lens = camera.resized(values.shape[1], values.shape[0])
    pinhole = undistorted_camera(lens)
    return Warp.between(pinhole, lens, "nearest").apply(values.unsqueeze(-1)).squeeze(-1)


def _matching_indices(size: int, other: int) -> tuple[Tensor, Tensor]:
    """Indices of corresponding pixels along an axis of two sizes, at the coarser resolution."""
    count = min(size, other)
    step = torch.arange(count)
    return step * size // count, step * other // count


# Scans of lasers as depth maps of photographs, and as points that a fit starts from.
#
# Points of all scans are projected into a photograph, the nearest of each pixel is kept, and of
# these what lies behind a surface whose points are too sparse to hide it is left out: each point
# hides a square of the width at which the next point of its surface is to be expected,
#
# .. math:: r(z) = \lceil f\, s / z - 1/2 \rceil \text{ pixels}, \qquad
#           D(p) \text{ stays where } D(p) \le (1 + \rho) \min_{|q - p| \le r(D(q))} D(q) + \tau
#
# with f the focal length and s the spacing of points.


_MAX_RADIUS = 12
"""Pixels: nearer surfaces are dense enough."""

_NEAR = 0.3
"""Metres before the camera below which a laser's points are of the vehicle itself."""


# Metres, and a share of the depth: how far behind what is nearest around it a point of a scan may
# lie to be kept; both together count.
_TOLERANCE, _RELATIVE_TOLERANCE = 0.1, 0.02

SCAN_SPACING = 0.08
"""Metres between points on a surface that all scans together saw."""

_VIEWS = 256
"""Depth maps that are made at a time: the scans are read once for so many."""


def scan_depths(
    scans: ScanSource,
    cameras: Sequence[Camera],
    *,
    spacing: float = SCAN_SPACING,
    metres_per_unit: float = 1.0,
) -> Iterator[Float[Tensor, "height width"]]:
    """What all scans together say of the depth of each photograph.

    Args:
        scans: Scans of the drive, in the world of the cameras; read one at a time.
        cameras: Of the photographs.
        spacing: Distance of points on a surface that all scans together saw, metres.
        metres_per_unit: Length of a scene unit.

    Yields:
        z-depth in scene units, float32, 0 where no scan tells any; one map a camera.
    """
    for start in range(0, len(cameras), _VIEWS):
        part = cameras[start : start + _VIEWS]
        nearest = [torch.full((c.height * c.width,), torch.inf) for c in part]
        for name in scans.scan_names:
            points = scans.scan(name).points
            for camera, depth in zip(part, nearest, strict=True):
                _add(points, camera, depth, near=_NEAR / metres_per_unit)
        for camera, depth in zip(part, nearest, strict=True):
            yield unhidden(
                depth.view(camera.height, camera.width),
                focal=float(camera.fx),
                spacing=spacing / metres_per_unit,
                tolerance=_TOLERANCE / metres_per_unit,
                relative_tolerance=_RELATIVE_TOLERANCE,
            )


def _add(points: Tensor, camera: Camera, depth: Tensor, *, near: float) -> None:
    """Lower the depth of the pixels that points fall into to that of the nearest."""
    pixels, z = camera.project(points)
    size = pixels.new_tensor([camera.width, camera.height])
    inside = (z > near) & ((pixels >= 0) & (pixels < size)).all(dim=1)
    column, row = pixels[inside].long().unbind(dim=1)
    depth.scatter_reduce_(0, row * camera.width + column, z[inside].float(), "amin")


def unhidden(
    depth: Float[Tensor, "height width"],
    *,
    focal: float,
    spacing: float,
    tolerance: float,
    relative_tolerance: float,
) -> Float[Tensor, "height width"]:
    """The nearest depths without those behind a surface of sparse points.

    Args:
        depth: Depth of the nearest point of each pixel, infinite without one.
        focal: f, pixels.
        spacing: s, in the unit of the depths.
        tolerance: Tau, in the unit of the depths.
        relative_tolerance: Rho.

    Returns:
        Depths, 0 where there is none.
    """
    radius = (focal * spacing / depth - 0.5).ceil().clamp(0, _MAX_RADIUS)
    hides = depth.clone()
    for width in range(1, _MAX_RADIUS + 1):
        band = torch.where(radius == width, depth, torch.inf)
        if bool(torch.isfinite(band).any()):
            wide = -max_pool2d(-band[None, None], 2 * width + 1, stride=1, padding=width)[0, 0]
            hides = torch.minimum(hides, wide)
    kept = torch.isfinite(depth) & (depth <= (1 + relative_tolerance) * hides + tolerance)
    return torch.where(kept, depth, 0.0)


class DepthPoints:
    """Points to start from, of depth maps and photographs: one a cell, with its mean colour.

    Args:
        cell: Side of a cell, scene units.
    """

    def __init__(self, cell: float) -> None:
        self._cell = cell
        self._keys = np.zeros((0, 3), dtype=np.int64)
        self._sums = np.zeros((0, 7))

    def add(
        self,
        camera: Camera,
        depth: Float[Tensor, "height width"],
        image: UInt8[Tensor, "height width 3"],
    ) -> None:
        """Take the points of one view.

        Raises:
            ShapeError: If the image has not the size of the depth map.
        """
        check_shape("image", image, (*depth.shape, 3))
        row, column = torch.nonzero(depth > 0, as_tuple=True)
        pixels = torch.stack((column, row), dim=1).double() + 0.5
        points = camera.unproject(pixels, depth[row, column].double()).numpy()
        own = np.concatenate(
            (points, image[row, column].double().numpy(), np.ones((len(points), 1))), axis=1
        )
        keys = np.concatenate((self._keys, np.floor(points / self._cell).astype(np.int64)))
        rows = np.concatenate((self._sums, own))
        self._keys, place = np.unique(keys, axis=0, return_inverse=True)
        self._sums = np.zeros((len(self._keys), 7))
        np.add.at(self._sums, place.reshape(-1), rows)

    def cloud(self) -> PointCloud:
        """The points so far, ordered by their cells."""
        means = torch.from_numpy(self._sums[:, :6] / self._sums[:, 6:])
        return PointCloud(
            points=means[:, :3].float(), colours=means[:, 3:].round().clamp(0, 255).byte()
        )
