r"""Which points a camera saw, by depth maps of its views.

A view sees the points x that lie in its picture and no more than a little behind its surface there:

.. math:: z(x) \le (1 + \rho)\, D(x) + \tau

with z the z-depth of the point and D the depth of its pixel, where that is known. So views of a
field vote (`lift.points.votes`), and a report parts points about which a method was shown
something from those about which it was not.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core import Camera
from splatseg.core.boundary import boundary

SIGHT_TOLERANCE = 0.1
"""Tau, metres: noise of a laser, and of depth maps."""

SIGHT_RELATIVE_TOLERANCE = 0.03
"""Rho: the depth of a pixel is that of its centre, and far ones cover more."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenPoints:
    """Points that a view saw, ascending, and where."""

    points: Int64[Tensor, "m"]
    columns: Int64[Tensor, "m"]
    rows: Int64[Tensor, "m"]
    depth: Float[Tensor, "m"]
    """Their z-depth, float64."""


def seen_points(
    points: Float[Tensor, "n 3"],
    camera: Camera,
    depth: Float[Tensor, "height width"],
    *,
    tolerance: float,
    relative_tolerance: float,
    near: float = 0.0,
) -> SeenPoints:
    """The points that one view saw.

    Args:
        points: World, float64.
        camera: Of the view.
        depth: Z-depth of its pixels, 0 where it is not known.
        tolerance: Tau, scene units.
        relative_tolerance: Rho.
        near: Z-depth up to which nothing is seen.
    """
    pixels, z = camera.project(points)
    size = pixels.new_tensor([camera.width, camera.height])
    inside = (z > near) & ((pixels >= 0) & (pixels < size)).all(dim=1)
    found = torch.nonzero(inside).squeeze(1)
    columns, rows = pixels[found].long().unbind(dim=1)
    surface = depth[rows, columns].double()
    seen = (surface > 0) & (z[found] <= (1 + relative_tolerance) * surface + tolerance)
    return SeenPoints(
        points=found[seen], columns=columns[seen], rows=rows[seen], depth=z[found[seen]]
    )


@boundary
def points_in_sight(
    points: Float[Tensor, "n 3"],
    views: Iterable[tuple[Camera, Float[Tensor, "height width"]]],
    *,
    metres_per_unit: float = 1.0,
) -> Bool[Tensor, "n"]:
    """Which points at least one view saw.

    Args:
        points: World, scene units.
        views: Cameras with z-depth maps of their size, scene units, 0 where it is not known; taken
            one at a time.
        metres_per_unit: Length of a scene unit.

    Raises:
        ShapeError: If the points are not (n, 3), or a map is not of its camera's size.
        RangeError: If a point is not finite.
    """
    check_shape("points", points, (None, 3))
    check_finite("points", points)
    at = points.detach().cpu().double()
    found = torch.zeros(len(at), dtype=torch.bool)
    for camera, depth in views:
        check_shape("depth", depth, (camera.height, camera.width))
        left = torch.nonzero(~found).squeeze(1)
        seen = seen_points(
            at[left],
            camera,
            depth,
            tolerance=SIGHT_TOLERANCE / metres_per_unit,
            relative_tolerance=SIGHT_RELATIVE_TOLERANCE,
        )
        found[left[seen.points]] = True
    return found
