"""Points that primitives are put at: of scans, of depth maps, of Gaussians."""

from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import Gaussians, ScanSource
from splatseg.core.boundary import boundary
from splatseg.errors import RangeError
from splatseg.lift.point_shapes import thin
from splatseg.street.geometry import DepthView

_MIN_OPACITY = 0.5
_HELD = 2_000_000
"""Points that are held before they are thinned."""


class ThinnedCloud:
    """Points of many sources as one cloud, a point a cell: memory is that of the cells.

    The same points in the same portions give the same cloud.

    Args:
        cell: Side of a cell, scene units, positive.
    """

    def __init__(self, cell: float) -> None:
        if not cell > 0:
            raise RangeError(f"cell: expected a positive length, got {cell}.")
        self._cell = cell
        self._parts: list[Tensor] = []
        self._held = 0
        self._limit = _HELD

    def add(self, points: Float[Tensor, "n 3"]) -> None:
        """Take more points, world, scene units."""
        self._parts.append(thin(points, self._cell).centres)
        self._held += len(self._parts[-1])
        if self._held > self._limit:
            self._parts = [self._together()]
            self._held = len(self._parts[0])
            self._limit = max(_HELD, 2 * self._held)

    def points(self) -> Float[Tensor, "n 3"]:
        """The points so far, ordered by their cells, float64."""
        return self._together()

    def _together(self) -> Tensor:
        if not self._parts:
            return torch.zeros(0, 3, dtype=torch.float64)
        return thin(torch.cat(self._parts), self._cell).centres


@boundary
def scan_points(scans: ScanSource, cell: float) -> Float[Tensor, "n 3"]:
    """Points of all scans, thinned; scans are read one at a time.

    Args:
        scans: In the world of the views.
        cell: Side of the cells of which each gives one point, scene units.

    Raises:
        InputError: If a scan is broken.
    """
    cloud = ThinnedCloud(cell)
    for name in scans.scan_names:
        cloud.add(scans.scan(name).points)
    return cloud.points()


@boundary
def depth_points(
    depths: Iterable[DepthView], cell: float, *, max_depth: float
) -> Float[Tensor, "n 3"]:
    """Points of depth maps, thinned; maps are taken one at a time.

    Args:
        depths: Depth of views.
        cell: Side of the cells of which each gives one point, scene units.
        max_depth: z-depth above which no point is taken, scene units.
    """
    cloud = ThinnedCloud(cell)
    for view in depths:
        row, column = torch.nonzero((view.depth > 0) & (view.depth <= max_depth), as_tuple=True)
        pixels = torch.stack((column, row), dim=1).double() + 0.5
        cloud.add(view.camera.unproject(pixels, view.depth[row, column].double()))
    return cloud.points()


@boundary
def gaussian_points(gaussians: Gaussians, cell: float) -> Float[Tensor, "n 3"]:
    """Centres of the Gaussians that are at least half opaque, thinned.

    Args:
        gaussians: Of a scene.
        cell: Side of the cells of which each gives one point, scene units.
    """
    solid = gaussians.opacities.detach().cpu() >= _MIN_OPACITY
    cloud = ThinnedCloud(cell)
    cloud.add(gaussians.means.detach().cpu()[solid])
    return cloud.points()
