r"""Scans of lasers as depth maps of photographs, and as points that a fit starts from.

Points of all scans are projected into a photograph, the nearest of each pixel is kept, and of these
what lies behind a surface whose points are too sparse to hide it is left out: each point hides a
square of the width at which the next point of its surface is to be expected,

.. math:: r(z) = \lceil f\, s / z - 1/2 \rceil \text{ pixels}, \qquad
          D(p) \text{ stays where } D(p) \le (1 + \rho) \min_{|q - p| \le r(D(q))} D(q) + \tau

with f the focal length and s the spacing of points.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn.functional import max_pool2d

from splatseg._check import check_shape
from splatseg.core import Camera, PointCloud, ScanSource
from splatseg.core.boundary import convert_fields
from splatseg.errors import RangeError

_MAX_RADIUS = 12
"""Pixels: nearer surfaces are dense enough."""

_NEAR = 0.3
"""Metres before the camera below which a laser's points are of the vehicle itself."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanDepthOptions:
    """How scans become depth maps. Lengths are metres."""

    spacing: float = 0.08
    """Distance of points on a surface that all scans together saw."""

    tolerance: float = 0.1
    """How far behind what is nearest around it a point may lie to be kept."""

    relative_tolerance: float = 0.02
    """The same, as a part of the depth; both together count."""

    start_cell: float = 0.12
    """Side of the cells of which each gives one point to start from."""

    views: int = 256
    """Depth maps that are made at a time: the scans are read once for so many."""

    def __post_init__(self) -> None:
        convert_fields(self)
        for name in ("spacing", "start_cell", "views"):
            if not getattr(self, name) > 0:
                raise RangeError(f"{name}: expected a positive number, got {getattr(self, name)}.")
        for name in ("tolerance", "relative_tolerance"):
            if not getattr(self, name) >= 0:
                raise RangeError(f"{name}: expected 0 or more, got {getattr(self, name)}.")


_DEFAULT = ScanDepthOptions()


def scan_depths(
    scans: ScanSource,
    cameras: Sequence[Camera],
    *,
    options: ScanDepthOptions = _DEFAULT,
    metres_per_unit: float = 1.0,
) -> Iterator[Float[Tensor, "height width"]]:
    """What all scans together say of the depth of each photograph.

    Args:
        scans: Scans of the drive, in the world of the cameras; read one at a time.
        cameras: Of the photographs.
        options: How they become depth maps.
        metres_per_unit: Length of a scene unit.

    Yields:
        z-depth in scene units, float32, 0 where no scan tells any; one map a camera.
    """
    for start in range(0, len(cameras), options.views):
        part = cameras[start : start + options.views]
        nearest = [torch.full((c.height * c.width,), torch.inf) for c in part]
        for name in scans.scan_names:
            points = scans.scan(name).points
            for camera, depth in zip(part, nearest, strict=True):
                _add(points, camera, depth, near=_NEAR / metres_per_unit)
        for camera, depth in zip(part, nearest, strict=True):
            yield unhidden(
                depth.view(camera.height, camera.width),
                focal=float(camera.fx),
                spacing=options.spacing / metres_per_unit,
                tolerance=options.tolerance / metres_per_unit,
                relative_tolerance=options.relative_tolerance,
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
