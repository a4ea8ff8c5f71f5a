"""Start points where a capture has none or few: a sparse plane sweep over random pixels.

Each pixel's ray is sampled at many depths, and each sample is projected into nearby views. The
depth of lowest photometric cost is taken. This is rough, but far better than points at random
depths, as floaters are hard to remove. Where a capture has points, but few, as after structure
from motion, their depths bound the samples, and only points of low cost are added to them.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.core import Camera, Capture, PointCloud, View
from splatseg.core.boundary import boundary
from splatseg.core.sh import SH_C0
from splatseg.errors import InputError
from splatseg.fit._options import START_OPACITY, FitOptions
from splatseg.fit._parameters import Parameters
from splatseg.fit._photographs import Example, TrainingPhotographs
from splatseg.neighbours import NeighbourIndex

COUNT = 30_000
"""Number of points where a capture has none, unless `max_gaussians` is less."""

_MAX_GAUSSIANS_SHARE = 0.5
"""The capture's own points are filled up to `COUNT`, or to this share of `max_gaussians`."""

MAX_DIFFERENCE = 0.05
"""Maximum photometric cost of points that are added to the capture's own, mean difference of
colours in [0, 1]."""

_MIN_DEPTHS = 100
"""Minimum number of depths of the capture's points in its views for a depth range."""

_MAX_SIDE = 200  # longest side of the photographs that are compared, pixels
_MAX_SOURCE_VIEWS = 150  # views whose pixels are sampled
_NEIGHBOURS = 8
_RAY_SAMPLES = 48
# Views whose axes differ by more show other sides of objects.
_MIN_COSINE = 0.5
# A point that no second view sees has the highest cost.
_UNSEEN_COST = 1.0
# Where the costs of all depths are equal (a white wall, a black sky) the typical depth is the best
# guess, and one close to the camera the worst: it occludes everything. This is the cost of a depth
# that is e times nearer than the typical one, mean difference of colours in [0, 1].
_DEPTH_PRIOR = 0.03


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthRange:
    """Range of depths to sample, z-depth in scene units."""

    near: float
    far: float
    typical: float

    object_range: tuple[float, float] | None
    """Depths of the object that all cameras are directed at, if there is one."""


def with_start_points(
    capture: Capture,
    photographs: TrainingPhotographs,
    *,
    options: FitOptions,
    generator: torch.Generator,
) -> Capture:
    """The capture with start points according to `FitOptions.start`.

    Args:
        capture: With points or without.
        photographs: Those of its training views.
        options: ``start`` and ``max_gaussians``.
        generator: Source of randomness, on the CPU.
    """
    count = random_point_count(capture, options)
    if count == 0:
        return capture
    own = None if options.start == "random" else capture.points
    if own is None or len(own) == 0:
        points = random_points(photographs, count=count, generator=generator)
        return replace(capture, points=points)
    if not bool(own.points.isfinite().all()):
        return capture  # `initial_parameters` refuses it
    more = random_points(
        photographs,
        count=count,
        generator=generator,
        depth_range=depth_range_of_points(own, photographs),
        max_difference=MAX_DIFFERENCE,
    )
    return replace(capture, points=_joined(own, more))


@boundary
def random_point_count(capture: Capture, options: FitOptions) -> int:
    """Number of start points that a fit of this capture adds to the capture's own."""
    own = 0 if capture.points is None else len(capture.points)
    if options.start == "points":
        return 0
    if options.start == "random" or own == 0:
        return min(COUNT, options.max_gaussians)
    if options.strategy == "classic":
        return 0  # as published
    return max(0, min(COUNT, int(_MAX_GAUSSIANS_SHARE * options.max_gaussians)) - own)


def depth_range_of_points(points: PointCloud, photographs: TrainingPhotographs) -> DepthRange:
    """Depths of points in the views, with a margin; that of the cameras if there are few."""
    cameras = [photographs.camera(i) for i in range(len(photographs))]
    found: list[Tensor] = []
    for camera in cameras:
        pixels, depth = camera.project(points.points.double())
        shown = (depth > 0) & (pixels >= 0).all(dim=1)
        shown &= (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
        found.append(depth[shown])
    depths = torch.cat(found).sort().values
    if len(depths) < _MIN_DEPTHS:
        return depth_range_of_cameras(cameras)
    near, typical, far = (float(depths[int(q * (len(depths) - 1))]) for q in (0.01, 0.5, 0.99))
    return DepthRange(near=0.8 * near, far=1.25 * far, typical=typical, object_range=None)


def _joined(own: PointCloud, more: PointCloud) -> PointCloud:
    """Both clouds in one; without colours if either has none."""
    points = torch.cat((own.points.float(), more.points))
    if own.colours is None or more.colours is None:
        colours = own.colours if len(more) == 0 else None
        return PointCloud(points=points, colours=colours)
    return PointCloud(points=points, colours=torch.cat((own.colours, more.colours)))


def depth_range_of_cameras(cameras: list[Camera]) -> DepthRange:
    r"""Range of depths to sample, from the cameras alone.

    Cameras are directed at one object if nine of ten have in view the point closest to all
    optical axes, :math:`\sum_i (I - d_i d_i^T)(x - c_i) = 0`, and most axes pass it closely. Then
    depths range from a third to twenty times its distance, and half of them are sampled in a ball
    around it that fills the images. Otherwise, in a room or a street, they range from a tenth to
    fifty times the median distance of the cameras from their mean.
    """
    centres = torch.stack([camera.centre for camera in cameras]).double()
    axes = torch.stack([camera.cam_from_world[2, :3] for camera in cameras]).double()
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    total = across.mean(dim=0)
    # Parallel axes do not meet: the pseudo-inverse then gives a point that fails the test below.
    shift = (across @ (centres - centres.mean(dim=0))[:, :, None]).mean(dim=0)
    focus = centres.mean(dim=0) + (torch.linalg.pinv(total, rtol=1e-6) @ shift).squeeze(1)
    distances = ((focus - centres) * axes).sum(dim=1)
    axis_distances = (across @ (focus - centres)[:, :, None]).squeeze(2).norm(dim=1)
    inside = torch.tensor([_is_in_view(camera, focus) for camera in cameras])
    distance = float(distances.median())
    close = (
        distance > 0 and float((axis_distances / distances.abs().clamp_min(1e-12)).median()) < 0.1
    )
    if close and float(inside.double().mean()) >= 0.9:
        half_fov = [min(c.width / c.fx, c.height / c.fy) / 2 for c in cameras]
        radius = min(0.9, float(torch.tensor(half_fov).median())) * distance
        object_range = (distance - radius, distance + radius)
        near = min(distance / 3, object_range[0])
        return DepthRange(near=near, far=20 * distance, typical=distance, object_range=object_range)
    spread = float((centres - centres.mean(dim=0)).norm(dim=1).median())
    spread = spread if spread > 0 else 1.0
    return DepthRange(near=0.1 * spread, far=50 * spread, typical=spread, object_range=None)


def random_points(
    photographs: TrainingPhotographs,
    *,
    count: int,
    generator: torch.Generator,
    depth_range: DepthRange | None = None,
    max_difference: float | None = None,
    first: int | None = None,
) -> PointCloud:
    """Points on rays of random pixels, each at the depth of lowest photometric cost.

    Args:
        photographs: At least one.
        count: Number of points.
        generator: Source of randomness, on the CPU.
        depth_range: Depths to sample; None is `depth_range_of_cameras`, with a prior against near
            depths.
        max_difference: Points with this photometric cost or more are left out, mean
            difference of colours in [0, 1]; None keeps all.
        first: Photographs of which so many, the first ones, have their pixels sampled; the others
            are compared with. None is all.
    """
    use_prior = depth_range is None
    if depth_range is None:
        depth_range = depth_range_of_cameras(
            [photographs.camera(i) for i in range(len(photographs))]
        )
    sources = torch.linspace(0, len(photographs) - 1, min(len(photographs), _MAX_SOURCE_VIEWS))
    indices = sources.round().long().unique().tolist()
    examples = [_reduced(photographs, index) for index in indices]
    patches = [_colour_patches(example) for example in examples]
    order = _neighbour_views([example.camera for example in examples])
    points: list[Tensor] = []
    colours: list[Tensor] = []
    sampled = sum(index < first for index in indices) if first is not None else len(examples)
    for i, example in enumerate(examples[:sampled]):
        ray_count = count * (i + 1) // sampled - count * i // sampled
        pixels = _sampled_pixels(example, ray_count, generator)
        if len(pixels) == 0:
            continue
        depths = _sampled_depths(depth_range, len(pixels), generator)
        pixel_centres = pixels[:, None].expand(-1, depths.shape[1], -1).to(torch.float64) + 0.5
        samples = example.camera.unproject(pixel_centres, depths.double())
        own = patches[i][pixels[:, 1], pixels[:, 0]]
        costs = _photometric_cost(samples, own, [(examples[j], patches[j]) for j in order[i]])
        best = (costs + _depth_penalty(depth_range, depths) if use_prior else costs).argmin(dim=1)
        chosen = torch.arange(len(pixels))
        kept = (
            chosen
            if max_difference is None
            else (costs[chosen, best] < max_difference).nonzero().squeeze(1)
        )
        points.append(samples[chosen, best].float()[kept])
        colours.append(example.photograph[pixels[:, 1], pixels[:, 0]][kept])
    if not points:
        return PointCloud(points=torch.zeros(0, 3))
    bytes_ = (torch.cat(colours).clamp(0, 1) * 255 + 0.5).to(torch.uint8)
    return PointCloud(points=torch.cat(points), colours=bytes_)


def _is_in_view(camera: Camera, point: Tensor) -> bool:
    pixel, depth = camera.project(point)
    x, y = pixel.tolist()
    return float(depth) > 0 and 0 <= x <= camera.width and 0 <= y <= camera.height


def _reduced(photographs: TrainingPhotographs, index: int) -> Example:
    camera = photographs.camera(index)
    reduction = max(1, round(max(camera.width, camera.height) / _MAX_SIDE))
    reduction = min(reduction, camera.width, camera.height)
    return photographs.example(index, reduction=reduction)


def _colour_patches(example: Example) -> Float[Tensor, "height width 15"]:
    """Each pixel with its four neighbours two pixels away: one colour alone is ambiguous."""
    image = example.photograph.movedim(-1, 0)[None]
    padded = torch.nn.functional.pad(image, (2, 2, 2, 2), mode="replicate")[0]
    height, width = image.shape[2:]
    shifts = ((2, 2), (0, 2), (4, 2), (2, 0), (2, 4))
    shifted = [padded[:, y : y + height, x : x + width] for y, x in shifts]
    return torch.cat(shifted).movedim(0, -1).contiguous()


def _neighbour_views(cameras: list[Camera]) -> list[list[int]]:
    """For each camera the nearest others with a similar viewing direction."""
    centres = torch.stack([camera.centre for camera in cameras]).double()
    axes = torch.stack([camera.cam_from_world[2, :3] for camera in cameras]).double()
    distances = torch.cdist(centres, centres)
    distances[(axes @ axes.T) < _MIN_COSINE] = torch.inf
    distances.fill_diagonal_(torch.inf)
    nearest = distances.argsort(dim=1, stable=True)[:, :_NEIGHBOURS]
    return [
        [int(j) for j in row if bool(torch.isfinite(distances[i, j]))]
        for i, row in enumerate(nearest)
    ]


def _sampled_pixels(
    example: Example, count: int, generator: torch.Generator
) -> Int64[Tensor, "count 2"]:
    """Columns and rows of random pixels that are valid and not transparent."""
    height, width = example.photograph.shape[:2]
    usable = torch.ones(height, width, dtype=torch.bool) if example.mask is None else example.mask
    if example.alpha is not None:
        usable = usable & (example.alpha > 0.5)
    rows, columns = usable.nonzero(as_tuple=True)
    if len(rows) == 0:
        return torch.zeros(0, 2, dtype=torch.int64)
    chosen = torch.randint(len(rows), (count,), generator=generator)
    return torch.stack((columns[chosen], rows[chosen]), dim=1)


def _sampled_depths(
    depth_range: DepthRange, count: int, generator: torch.Generator
) -> Float[Tensor, "count depths"]:
    """Depths along each ray, uniform in the logarithm; half of them in the object range, if any."""
    jitter = torch.rand(count, 1, generator=generator)
    whole = _RAY_SAMPLES if depth_range.object_range is None else _RAY_SAMPLES // 2
    share = (torch.arange(whole) + jitter) / whole
    depths = depth_range.near * (depth_range.far / depth_range.near) ** share
    if depth_range.object_range is None:
        return depths
    low, high = depth_range.object_range
    within = low + (high - low) * (torch.arange(_RAY_SAMPLES - whole) + jitter) / (
        _RAY_SAMPLES - whole
    )
    return torch.cat((depths, within), dim=1)


def _depth_penalty(
    depth_range: DepthRange, depths: Float[Tensor, "count depths"]
) -> Float[Tensor, "count depths"]:
    """Prior cost of each depth. Far ones cost only where there is an object range."""
    away = (depths / depth_range.typical).log()
    return _DEPTH_PRIOR * (-away if depth_range.object_range is None else away.abs()).clamp_min(0)


def _photometric_cost(
    samples: Float[Tensor, "count depths 3"],
    own: Float[Tensor, "count channels"],
    others: list[tuple[Example, Tensor]],
) -> Float[Tensor, "count depths"]:
    """Mean colour difference over the better half of the views that have a point in their image.

    In the worse half the point may be occluded.
    """
    costs = torch.full((max(1, len(others)), *samples.shape[:2]), torch.inf)
    for cost, (example, patch) in zip(costs, others, strict=False):
        pixels, depth = example.camera.project(samples)
        height, width = patch.shape[:2]
        inside = (depth > 0) & (pixels >= 0).all(dim=-1)
        inside &= (pixels[..., 0] < width) & (pixels[..., 1] < height)
        column = pixels[..., 0].nan_to_num(0, 0, 0).clamp(0, width - 1).long()
        row = pixels[..., 1].nan_to_num(0, 0, 0).clamp(0, height - 1).long()
        if example.mask is not None:
            inside &= example.mask[row, column]
        difference = (patch[row, column] - own[:, None]).abs().mean(dim=-1)
        cost[:] = torch.where(inside, difference, torch.inf)
    seen = costs.isfinite().sum(dim=0)
    better = torch.arange(len(costs))[:, None, None] < (seen + 1) // 2
    ordered = torch.where(better, costs.sort(dim=0).values, 0.0)
    found = ordered.sum(dim=0) / ((seen + 1) // 2).clamp_min(1)
    return torch.where(seen > 0, found, _UNSEEN_COST)


# Initial Gaussians of a fit, from a capture's points.


_SPACING_NEIGHBOURS = 3
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
    logit = math.log(START_OPACITY / (1 - START_OPACITY))
    return Parameters(
        means=points.clone(),
        log_scales=scales.log()[:, None].repeat(1, 3),
        rotations=rotations,
        logits=torch.full((count, 1), logit),
        sh=sh,
    )


def _mean_neighbour_distances(points: Tensor) -> Tensor:
    """Mean distance of each point to its three nearest others; infinite if there is only one."""
    neighbours = min(_SPACING_NEIGHBOURS, len(points) - 1)
    if neighbours == 0:
        return torch.full((len(points),), math.inf)
    return NeighbourIndex(points).nearest_others(neighbours).distances.float().mean(dim=1)
