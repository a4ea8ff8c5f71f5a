r"""Depth of views, and rays that know how far they go.

A depth map holds z, along the optical axis; the paper's depth is the distance along the ray,

.. math:: t = z / (d \cdot a)

with d the unit direction of the ray and a the camera's axis.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg._check import check_shape, check_values
from splatseg.core import Camera
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError


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


@boundary
def distances_of(view: DepthView) -> Float[Tensor, "height width"]:
    """Distances along the rays of the pixels' centres, 0 where no depth is known."""
    _, directions = view.camera.rays()
    cosines = axis_cosines(view.camera, directions)
    seen = (view.depth > 0) & (cosines > 0)
    return torch.where(seen, view.depth / torch.where(seen, cosines, 1.0), 0.0).float()


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
