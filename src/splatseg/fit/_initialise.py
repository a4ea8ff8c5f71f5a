"""From a capture's points to the Gaussians a fit starts from."""

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
# Points alone in space would start as balls that fill the view: none is larger than this share
# of its distance to the nearest camera, nor smaller than the other, so that every one is drawn.
_LARGEST_SHARE = 0.1
_SMALLEST_SHARE = 1e-5
# A capture from one spot has no extent of its own; the distance of what it shows stands for it.
_LEAST_EXTENT_SHARE = 1e-3


def scene_size(views: tuple[View, ...], points: Float[Tensor, "n 3"]) -> float:
    """Size of what is shown: its usual distance from the cameras' middle, at least their extent.

    It scales with the scene, as everything that is to work in metres and in millimetres must.
    """
    centres = torch.stack([view.camera.centre for view in views]).double()
    reach = float((points.double() - centres.mean(dim=0)).norm(dim=1).median())
    return max(scene_extent(views, points), reach)


def scene_extent(views: tuple[View, ...], points: Float[Tensor, "n 3"]) -> float:
    """Size of a scene: 1.1 times the largest distance of a camera from their mean.

    It is what 3DGS scales the position rate by. Where the cameras stand in one spot, it is a
    thousandth of the median distance of the points.
    """
    centres = torch.stack([view.camera.centre for view in views]).double()
    mean = centres.mean(dim=0)
    radius = float((centres - mean).norm(dim=1).max())
    reach = float((points.double() - mean).norm(dim=1).median())
    return max(1.1 * radius, _LEAST_EXTENT_SHARE * reach, 1e-6)


def initial_parameters(
    capture: Capture, *, options: FitOptions, generator: torch.Generator
) -> Parameters:
    """A ball at each start point: its colour, the mean distance of its three nearest as scale.

    Of more points than `max_gaussians`, so many are drawn at random.

    Raises:
        InputError: If the capture has no start points.
    """
    cloud = capture.points
    if cloud is None or len(cloud) == 0:
        raise InputError(
            f"{capture.path}: expected a capture with start points (a COLMAP model, or "
            "'ply_file_path' in transforms.json), got one without."
        )
    points = cloud.points.float()
    finite = points.isfinite().all(dim=1)
    if not bool(finite.all()):
        raise InputError(
            f"{capture.path}: {int((~finite).sum())} of {len(points)} start points are not finite."
        )
    colours = torch.full_like(points, 0.5) if cloud.colours is None else cloud.colours / 255.0
    if len(points) > options.max_gaussians:
        order = torch.randperm(len(points), generator=generator)
        chosen = order[: options.max_gaussians].sort().values
        points, colours = points[chosen], colours[chosen]

    spacing = _spacing(points)
    centres = torch.stack([view.camera.centre for view in capture.train_views]).float()
    to_camera = NeighbourIndex(centres).nearest(points, 1).distances[:, 0]
    distance = to_camera.float().clamp_min(1e-6)
    scales = torch.maximum(
        torch.minimum(spacing, _LARGEST_SHARE * distance), _SMALLEST_SHARE * distance
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


def _spacing(points: Tensor) -> Tensor:
    """Mean distance of each point to its three nearest others; infinite for a lone point."""
    neighbours = min(_NEIGHBOURS, len(points) - 1)
    if neighbours == 0:
        return torch.full((len(points),), math.inf)
    return NeighbourIndex(points).nearest_others(neighbours).distances.float().mean(dim=1)
