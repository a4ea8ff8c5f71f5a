r"""Which points a camera saw, by depth maps of its views.

A view sees the points x that lie in its picture and no more than a little behind its surface there:

.. math:: z(x) \le (1 + \rho)\, D(x) + \tau

with z the z-depth of the point and D the depth of its pixel, where that is known. The same test
lets views of a field vote (`lift.points.votes`); here it parts points for a report, those about
which a method was shown something from those about which it was not.
"""

from collections.abc import Iterable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core import Camera
from splatseg.core.boundary import boundary

SIGHT_TOLERANCE = 0.1
"""Tau, metres: noise of a laser, and of depth maps."""

SIGHT_RELATIVE_TOLERANCE = 0.03
"""Rho: the depth of a pixel is that of its centre, and far ones cover more."""


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
        pixels, z = camera.project(at[left])
        size = pixels.new_tensor([camera.width, camera.height])
        inside = (z > 0) & ((pixels >= 0) & (pixels < size)).all(dim=1)
        column, row = pixels[inside].long().unbind(dim=1)
        surface = depth[row, column].double()
        limit = (1 + SIGHT_RELATIVE_TOLERANCE) * surface + SIGHT_TOLERANCE / metres_per_unit
        found[left[inside]] = (surface > 0) & (z[inside] <= limit)
    return found
