"""Start points where a capture has none or few: on rays of the photographs, where others agree.

A pixel's ray is cut at many depths, and each place is looked up in views nearby. Where they
show what the pixel shows there may be a surface; elsewhere there is none. That is rough, but far
better than a cloud drawn blindly: floaters are hard to get rid of. Where a capture has points,
but few, as after structure from motion, they say how deep things may lie, and only places where
the views really agree are added to them.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.core import Camera, Capture, PointCloud
from splatseg.fit._options import FitOptions
from splatseg.fit._photographs import Example, Photographs

COUNT = 30_000
"""Points drawn where a capture has none, unless `max_gaussians` is less."""

_FULL_SHARE = 0.5
"""The capture's own points are filled up to `COUNT`, or to so much of `max_gaussians`."""

_AGREED = 0.05
"""Places beside the capture's own points agree to so much, mean difference of colours in
[0, 1]."""

_FEWEST_DEPTHS = 100
"""Depths of the capture's points in its views that it takes to say how deep things lie."""

_LONGEST = 200  # pixels of a photograph at which it is looked up
_MOST_SOURCES = 150  # views that rays start from
_NEIGHBOURS = 8
_DEPTHS = 48
# Views that look another way by more than this show other sides of things.
_LEAST_COSINE = 0.5
# Unseen by a second view, a place costs as much as the worst disagreement.
_UNSEEN = 1.0
# Where nothing tells depths apart (a white wall, a black sky) the usual one is the best guess, and
# one close to the camera the worst: what is there hides everything. So much better must a place
# agree that is e times nearer, mean difference of colours in [0, 1].
_PRIOR = 0.03


@dataclass(frozen=True, slots=True, kw_only=True)
class Region:
    """How far from the cameras things may be, z-depth in scene units."""

    near: float
    far: float
    usual: float

    core: tuple[float, float] | None
    """Depths of what all cameras look at, where they look at one thing."""


def with_start_points(
    capture: Capture,
    photographs: Photographs,
    *,
    options: FitOptions,
    generator: torch.Generator,
) -> Capture:
    """The capture with points to start from, as `FitOptions.start` says.

    Args:
        capture: With points or without.
        photographs: Of its training views.
        options: ``start`` and ``max_gaussians``.
        generator: Source of randomness, on the CPU.
    """
    count = random_start_count(capture, options)
    if count == 0:
        return capture
    own = None if options.start == "random" else capture.points
    if own is None or len(own) == 0:
        points = random_points(photographs, count=count, generator=generator)
        return replace(capture, points=points)
    if not bool(own.points.isfinite().all()):
        return capture  # and be refused
    more = random_points(
        photographs,
        count=count,
        generator=generator,
        region=_region_of(own, photographs),
        agreed=_AGREED,
    )
    return replace(capture, points=_together(own, more))


def random_start_count(capture: Capture, options: FitOptions) -> int:
    """How many places a fit of this capture would try that are not the capture's points."""
    own = 0 if capture.points is None else len(capture.points)
    if options.start == "points":
        return 0
    if options.start == "random" or own == 0:
        return min(COUNT, options.max_gaussians)
    if options.strategy == "classic":
        return 0  # as published
    return max(0, min(COUNT, int(_FULL_SHARE * options.max_gaussians)) - own)


def _region_of(points: PointCloud, photographs: Photographs) -> Region:
    """Depths at which points lie in the views, with some room; of all cameras if few do."""
    cameras = [photographs.camera(i) for i in range(len(photographs))]
    found: list[Tensor] = []
    for camera in cameras:
        pixels, depth = camera.project(points.points.double())
        shown = (depth > 0) & (pixels >= 0).all(dim=1)
        shown &= (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
        found.append(depth[shown])
    depths = torch.cat(found).sort().values
    if len(depths) < _FEWEST_DEPTHS:
        return visible_region(cameras)
    near, usual, far = (float(depths[int(q * (len(depths) - 1))]) for q in (0.01, 0.5, 0.99))
    return Region(near=0.8 * near, far=1.25 * far, usual=usual, core=None)


def _together(own: PointCloud, more: PointCloud) -> PointCloud:
    """Both; points without a colour are grey."""
    points = torch.cat((own.points.float(), more.points))
    if own.colours is None or more.colours is None:
        colours = own.colours if len(more) == 0 else None
        return PointCloud(points=points, colours=colours)
    return PointCloud(points=points, colours=torch.cat((own.colours, more.colours)))


def visible_region(cameras: list[Camera]) -> Region:
    r"""Depths worth looking at.

    Cameras look at one thing if nine of ten have in their picture the point closest to all
    optical axes, :math:`\sum_i (I - d_i d_i^T)(x - c_i) = 0`, and most pass it closely: an
    object, or something in front. Then depths go from a third to twenty times its distance, and
    half of them are tried in a ball around it that fills the pictures. Else, in a room or a
    street, they go from a tenth to fifty times the typical distance of cameras from their middle.
    """
    centres = torch.stack([camera.centre for camera in cameras]).double()
    axes = torch.stack([camera.cam_from_world[2, :3] for camera in cameras]).double()
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    total = across.mean(dim=0)
    # Parallel axes meet nowhere: the pseudo-inverse then gives a point that fails the test below.
    shift = (across @ (centres - centres.mean(dim=0))[:, :, None]).mean(dim=0)
    focus = centres.mean(dim=0) + (torch.linalg.pinv(total, rtol=1e-6) @ shift).squeeze(1)
    distances = ((focus - centres) * axes).sum(dim=1)
    beside = (across @ (focus - centres)[:, :, None]).squeeze(2).norm(dim=1)
    inside = torch.tensor([_shows(camera, focus) for camera in cameras])
    distance = float(distances.median())
    close = distance > 0 and float((beside / distances.abs().clamp_min(1e-12)).median()) < 0.1
    if close and float(inside.double().mean()) >= 0.9:
        slope = [min(c.width / c.fx, c.height / c.fy) / 2 for c in cameras]
        radius = min(0.9, float(torch.tensor(slope).median())) * distance
        core = (distance - radius, distance + radius)
        near = min(distance / 3, core[0])
        return Region(near=near, far=20 * distance, usual=distance, core=core)
    spread = float((centres - centres.mean(dim=0)).norm(dim=1).median())
    spread = spread if spread > 0 else 1.0
    return Region(near=0.1 * spread, far=50 * spread, usual=spread, core=None)


def random_points(
    photographs: Photographs,
    *,
    count: int,
    generator: torch.Generator,
    region: Region | None = None,
    agreed: float | None = None,
) -> PointCloud:
    """Points on rays of random pixels, each at the depth at which most views agree on it.

    Args:
        photographs: At least one.
        count: How many points.
        generator: Source of randomness, on the CPU.
        region: Depths worth looking at; None is `visible_region` of the cameras, of which near
            depths must agree better.
        agreed: Places at which views differ by this much or more are left out, mean difference
            of colours in [0, 1]; None keeps all.
    """
    guessed = region is None
    if region is None:
        region = visible_region([photographs.camera(i) for i in range(len(photographs))])
    sources = torch.linspace(0, len(photographs) - 1, min(len(photographs), _MOST_SOURCES))
    indices = sources.round().long().unique().tolist()
    examples = [_reduced(photographs, index) for index in indices]
    pictures = [_with_surroundings(example) for example in examples]
    order = _neighbours([example.camera for example in examples])
    points: list[Tensor] = []
    colours: list[Tensor] = []
    for i, example in enumerate(examples):
        wanted = count * (i + 1) // len(examples) - count * i // len(examples)
        pixels = _drawn_pixels(example, wanted, generator)
        if len(pixels) == 0:
            continue
        depths = _drawn_depths(region, len(pixels), generator)
        at = pixels[:, None].expand(-1, depths.shape[1], -1).to(torch.float64) + 0.5
        places = example.camera.unproject(at, depths.double())
        own = pictures[i][pixels[:, 1], pixels[:, 0]]
        costs = _disagreement(places, own, [(examples[j], pictures[j]) for j in order[i]])
        best = (costs + _unlikeliness(region, depths) if guessed else costs).argmin(dim=1)
        chosen = torch.arange(len(pixels))
        kept = chosen if agreed is None else (costs[chosen, best] < agreed).nonzero().squeeze(1)
        points.append(places[chosen, best].float()[kept])
        colours.append(example.photograph[pixels[:, 1], pixels[:, 0]][kept])
    if not points:
        return PointCloud(points=torch.zeros(0, 3))
    bytes_ = (torch.cat(colours).clamp(0, 1) * 255 + 0.5).to(torch.uint8)
    return PointCloud(points=torch.cat(points), colours=bytes_)


def _shows(camera: Camera, point: Tensor) -> bool:
    pixel, depth = camera.project(point)
    x, y = pixel.tolist()
    return float(depth) > 0 and 0 <= x <= camera.width and 0 <= y <= camera.height


def _reduced(photographs: Photographs, index: int) -> Example:
    camera = photographs.camera(index)
    reduction = max(1, round(max(camera.width, camera.height) / _LONGEST))
    reduction = min(reduction, camera.width, camera.height)
    return photographs.example(index, reduction=reduction)


def _with_surroundings(example: Example) -> Float[Tensor, "height width 15"]:
    """Each pixel with its four neighbours two pixels away: one colour alone is found anywhere."""
    image = example.photograph.movedim(-1, 0)[None]
    padded = torch.nn.functional.pad(image, (2, 2, 2, 2), mode="replicate")[0]
    height, width = image.shape[2:]
    shifts = ((2, 2), (0, 2), (4, 2), (2, 0), (2, 4))
    shifted = [padded[:, y : y + height, x : x + width] for y, x in shifts]
    return torch.cat(shifted).movedim(0, -1).contiguous()


def _neighbours(cameras: list[Camera]) -> list[list[int]]:
    """For each camera the nearest others that look roughly the same way."""
    centres = torch.stack([camera.centre for camera in cameras]).double()
    axes = torch.stack([camera.cam_from_world[2, :3] for camera in cameras]).double()
    distances = torch.cdist(centres, centres)
    distances[(axes @ axes.T) < _LEAST_COSINE] = torch.inf
    distances.fill_diagonal_(torch.inf)
    nearest = distances.argsort(dim=1, stable=True)[:, :_NEIGHBOURS]
    return [
        [int(j) for j in row if bool(torch.isfinite(distances[i, j]))]
        for i, row in enumerate(nearest)
    ]


def _drawn_pixels(
    example: Example, count: int, generator: torch.Generator
) -> Int64[Tensor, "count 2"]:
    """Columns and rows of random pixels that count and are not transparent."""
    height, width = example.photograph.shape[:2]
    usable = torch.ones(height, width, dtype=torch.bool) if example.mask is None else example.mask
    if example.alpha is not None:
        usable = usable & (example.alpha > 0.5)
    rows, columns = usable.nonzero(as_tuple=True)
    if len(rows) == 0:
        return torch.zeros(0, 2, dtype=torch.int64)
    chosen = torch.randint(len(rows), (count,), generator=generator)
    return torch.stack((columns[chosen], rows[chosen]), dim=1)


def _drawn_depths(
    region: Region, count: int, generator: torch.Generator
) -> Float[Tensor, "count depths"]:
    """Depths along each ray, evenly in their logarithm; half of them in the core, if any."""
    jitter = torch.rand(count, 1, generator=generator)
    whole = _DEPTHS if region.core is None else _DEPTHS // 2
    share = (torch.arange(whole) + jitter) / whole
    depths = region.near * (region.far / region.near) ** share
    if region.core is None:
        return depths
    low, high = region.core
    within = low + (high - low) * (torch.arange(_DEPTHS - whole) + jitter) / (_DEPTHS - whole)
    return torch.cat((depths, within), dim=1)


def _unlikeliness(
    region: Region, depths: Float[Tensor, "count depths"]
) -> Float[Tensor, "count depths"]:
    """What is added to the disagreement at a depth. Far ones cost only where a thing is near."""
    away = (depths / region.usual).log()
    return _PRIOR * (-away if region.core is None else away.abs()).clamp_min(0)


def _disagreement(
    places: Float[Tensor, "count depths 3"],
    own: Float[Tensor, "count channels"],
    others: list[tuple[Example, Tensor]],
) -> Float[Tensor, "count depths"]:
    """Mean colour difference of the better half of the views that have a place in their picture.

    The worse half may have something else in front of it.
    """
    costs = torch.full((max(1, len(others)), *places.shape[:2]), torch.inf)
    for cost, (example, picture) in zip(costs, others, strict=False):
        pixels, depth = example.camera.project(places)
        height, width = picture.shape[:2]
        inside = (depth > 0) & (pixels >= 0).all(dim=-1)
        inside &= (pixels[..., 0] < width) & (pixels[..., 1] < height)
        column = pixels[..., 0].nan_to_num(0, 0, 0).clamp(0, width - 1).long()
        row = pixels[..., 1].nan_to_num(0, 0, 0).clamp(0, height - 1).long()
        if example.mask is not None:
            inside &= example.mask[row, column]
        difference = (picture[row, column] - own[:, None]).abs().mean(dim=-1)
        cost[:] = torch.where(inside, difference, torch.inf)
    seen = costs.isfinite().sum(dim=0)
    better = torch.arange(len(costs))[:, None, None] < (seen + 1) // 2
    ordered = torch.where(better, costs.sort(dim=0).values, 0.0)
    found = ordered.sum(dim=0) / ((seen + 1) // 2).clamp_min(1)
    return torch.where(seen > 0, found, _UNSEEN)
