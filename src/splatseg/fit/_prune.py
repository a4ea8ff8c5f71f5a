"""What a finished fit leaves out: Gaussians that no photograph shows, and floaters."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatseg.core import Camera, Gaussians, View
from splatseg.fit._photographs import Photographs
from splatseg.render import prepare

# Blending weight, summed over pixels and training views, that a Gaussian needs. One fully
# visible pixel of one photograph counts 1.
_LEAST_WEIGHT = 1.0
# A floater is seen by at most so many views with at least so much weight, and mostly where the
# surface behind it is more than so much further away.
_FLOATER_VIEWS = 2
_SEEN = 0.5
_IN_FRONT = 0.5
# Views are drawn reduced if all of them together have more pixels: a few seconds are enough.
_MOST_PIXELS = 10_000_000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewOfPixels:
    """A view and which of its pixels taught something."""

    camera: Camera
    """Pinhole."""

    mask: Bool[Tensor, "height width"] | None = None
    """None is all."""


def without_floaters(
    gaussians: Gaussians, photographs: Photographs, views: Sequence[View], *, backend: str
) -> Gaussians:
    """The Gaussians that the photographs need; see `needed`.

    Args:
        gaussians: What was fitted.
        photographs: What it was fitted to.
        views: With the poses at the end, by name; more than the photographs' may be there.
        backend: Which renderer.
    """
    poses = {view.name: view.camera.cam_from_world for view in views}
    names = [view.name for view in photographs.views]
    reduction = reduction_for([photographs.camera(i) for i in range(len(names))])

    def seen() -> Iterator[ViewOfPixels]:
        for i, name in enumerate(names):
            example = photographs.example(i, reduction=reduction)
            camera = replace(example.camera, cam_from_world=poses[name])
            yield ViewOfPixels(camera=camera, mask=example.mask)

    return gaussians[needed(gaussians, seen(), reduction=reduction, backend=backend)]


def reduction_for(cameras: Sequence[Camera]) -> int:
    """By how much views are to be reduced, so that looking at all takes a few seconds."""
    pixels = sum(camera.width * camera.height for camera in cameras)
    least = min(min(camera.width, camera.height) for camera in cameras)
    return max(1, min(math.ceil(math.sqrt(pixels / _MOST_PIXELS)), least))


def needed(
    gaussians: Gaussians,
    views: Iterable[ViewOfPixels],
    *,
    reduction: int = 1,
    backend: str = "auto",
) -> Bool[Tensor, "n"]:
    r"""Which Gaussians the training views need.

    With :math:`w_{vpi}` the blending weight of Gaussian i in pixel p of view v, those are left
    out whose :math:`\sum_{v,p} w_{vpi}` is less than 1: what hides inside or behind things.
    Floaters are left out too: at most two views see them, and more than half of their weight is
    in pixels whose median depth is more than twice theirs. Thin and long ones stay: they are
    edges, and pictures are much worse without.

    Args:
        gaussians: What was fitted.
        views: Those that it was fitted to, with their sides divided by `reduction`.
        reduction: See `reduction_for`. Weights count its square.
        backend: Which renderer.
    """
    total = torch.zeros(len(gaussians))
    in_front = torch.zeros(len(gaussians))
    seen_by = torch.zeros(len(gaussians), dtype=torch.int32)
    area = reduction * reduction
    for view in views:
        weights, depth_behind = _seen(gaussians, view, backend)
        weights = area * weights
        pose = view.camera.cam_from_world
        depth = (gaussians.means.double() @ pose[2, :3] + pose[2, 3]).float()
        total += weights
        seen_by += weights >= _SEEN
        in_front += torch.where(depth < _IN_FRONT * depth_behind, weights, 0.0)
    floating = (seen_by <= _FLOATER_VIEWS) & (in_front > 0.5 * total)
    return (total >= _LEAST_WEIGHT) & ~floating


def _seen(
    gaussians: Gaussians, view: ViewOfPixels, backend: str
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Weight of each Gaussian in a view, and the mean median depth of the pixels it is in."""
    with torch.no_grad(), prepare(gaussians, view.camera, backend=backend) as prepared:
        depth = prepared.render().median_depth
        used = torch.ones_like(depth) if view.mask is None else view.mask.to(depth)
        # Nothing opaque is behind: whatever is there floats before something far away.
        behind = torch.where(depth > 0, depth, depth.max())
        image = torch.stack((used, used * behind), dim=-1)
        sums = prepared.back_project(image).sums.cpu()
    return sums[:, 0], sums[:, 1] / sums[:, 0].clamp_min(1e-12)
