"""Initial Gaussians of a fit, from a capture's points."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import Capture, View
from splatseg.core.sh import SH_C0
from splatseg.errors import InputError
from splatseg.fit._options import FitOptions
from splatseg.fit._parameters import Parameters
from splatseg.neighbours import NeighbourIndex

_NEIGHBOURS = 3
# Scales are clamped to these shares of the distance to the nearest camera: isolated points would
# otherwise fill the view, and coincident ones would not be visible.
_MAX_SCALE_SHARE = 0.1
_MIN_SCALE_SHARE = 1e-5
# The cameras of a capture from one position have no extent; the distance of the points replaces it.
_MIN_EXTENT_SHARE = 1e-3


def scene_size(views: tuple[View, ...], points: Float[Tensor, "n 3"]) -> float:
    """Median distance of the points from the cameras' mean, at least `scene_extent`.

    It scales with the scene, so that a fit does not depend on the unit of length.
    """
    centres = torch.stack([view.camera.centre for view in views]).double()
    median_distance = float((points.double() - centres.mean(dim=0)).norm(dim=1).median())
    return max(scene_extent(views, points), median_distance)


def scene_extent(views: tuple[View, ...], points: Float[Tensor, "n 3"]) -> float:
    """Size of a scene: 1.1 times the largest distance of a camera from their mean.

    3DGS scales the learning rate of positions by it. Where all cameras are in one position, it is
    a thousandth of the median distance of the points.
    """
    centres = torch.stack([view.camera.centre for view in views]).double()
    mean = centres.mean(dim=0)
    radius = float((centres - mean).norm(dim=1).max())
    median_distance = float((points.double() - mean).norm(dim=1).median())
    return max(1.1 * radius, _MIN_EXTENT_SHARE * median_distance, 1e-6)


def initial_parameters(
    capture: Capture, *, options: FitOptions, generator: torch.Generator
) -> Parameters:
    """An isotropic Gaussian at each start point, of the point's colour.

    Its scale is the mean distance of the three nearest other points. If there are more points
    than `max_gaussians`, a random subset is taken, unless they are to stay.

    Raises:
        InputError: If the capture has no start points.
    """
    cloud = capture.points
    if cloud is None or len(cloud) == 0:
        raise InputError(
            f"{capture.path}: expected a capture with start points (a COLMAP model, or "
            "'ply_file_path' in transforms.json), got one without points."
        )
    points = cloud.points.float()
    finite = points.isfinite().all(dim=1)
    if not bool(finite.all()):
        raise InputError(
            f"{capture.path}: {int((~finite).sum())} of {len(points)} start points are not finite."
        )
    colours = torch.full_like(points, 0.5) if cloud.colours is None else cloud.colours / 255.0
    if len(points) > options.max_gaussians and options.strategy != "fixed":
        order = torch.randperm(len(points), generator=generator)
        chosen = order[: options.max_gaussians].sort().values
        points, colours = points[chosen], colours[chosen]

    spacing = _mean_neighbour_distances(points)
    centres = torch.stack([view.camera.centre for view in capture.train_views]).float()
    camera_distances = NeighbourIndex(centres).nearest(points, 1).distances[:, 0]
    distance = camera_distances.float().clamp_min(1e-6)
    scales = torch.maximum(
        torch.minimum(spacing, _MAX_SCALE_SHARE * distance), _MIN_SCALE_SHARE * distance
    )
    count, coefficients = len(points), (options.sh_degree + 1) ** 2
    rotations = torch.zeros(count, 4)
    rotations[:, 0] = 1
    sh = torch.zeros(count, 3 * coefficients)
    sh[:, :3] = (colours - 0.5) / SH_C0
    logit = math.log(options.start_opacity / (1 - options.start_opacity))
    return Parameters(
        means=points.clone(),
        log_scales=scales.log()[:, None].repeat(1, 3),
        rotations=rotations,
        logits=torch.full((count, 1), logit),
        sh=sh,
    )


def _mean_neighbour_distances(points: Tensor) -> Tensor:
    """Mean distance of each point to its three nearest others; infinite if there is only one."""
    neighbours = min(_NEIGHBOURS, len(points) - 1)
    if neighbours == 0:
        return torch.full((len(points),), math.inf)
    return NeighbourIndex(points).nearest_others(neighbours).distances.float().mean(dim=1)
