"""Pruning of a finished fit: Gaussians that no photograph shows, and floaters."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatseg.core import Camera, Gaussians, View
from splatseg.fit._photographs import Photographs
from splatseg.render import prepare

# Minimum blending weight of a Gaussian, summed over pixels and training views. One fully visible
# pixel of one photograph counts 1.
_MIN_WEIGHT = 1.0
# A floater is visible in at most this many views with at least this weight, and more than half of
# its weight is where its depth is less than this share of the median depth.
_MAX_FLOATER_VIEWS = 2
_MIN_VIEW_WEIGHT = 0.5
_MAX_DEPTH_RATIO = 0.5
# Views are rendered downsampled if all of them together have more pixels: a matter of seconds.
_MAX_PIXELS = 10_000_000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MaskedView:
    """A view and the mask of its valid pixels."""

    camera: Camera
    """Pinhole."""

    mask: Bool[Tensor, "height width"] | None = None
    """None is all."""


def without_floaters(
    gaussians: Gaussians, photographs: Photographs, views: Sequence[View], *, backend: str
) -> Gaussians:
    """The Gaussians that the photographs need; see `needed`.

    Args:
        gaussians: The fitted Gaussians.
        photographs: The photographs that they were fitted to.
        views: Views with the final poses, found by name; there may be others.
        backend: Name of the renderer.
    """
    poses = {view.name: view.camera.cam_from_world for view in views}
    names = [view.name for view in photographs.views]
    reduction = reduction_for([photographs.camera(i) for i in range(len(names))])

    def seen() -> Iterator[MaskedView]:
        for i, name in enumerate(names):
            example = photographs.example(i, reduction=reduction)
            camera = replace(example.camera, cam_from_world=poses[name])
            yield MaskedView(camera=camera, mask=example.mask)

    return gaussians[needed(gaussians, seen(), reduction=reduction, backend=backend)]


def reduction_for(cameras: Sequence[Camera]) -> int:
    """Downsampling factor of the views, so that rendering all takes a few seconds."""
    pixels = sum(camera.width * camera.height for camera in cameras)
    shortest_side = min(min(camera.width, camera.height) for camera in cameras)
    return max(1, min(math.ceil(math.sqrt(pixels / _MAX_PIXELS)), shortest_side))


def needed(
    gaussians: Gaussians,
    views: Iterable[MaskedView],
    *,
    reduction: int = 1,
    backend: str = "auto",
) -> Bool[Tensor, "n"]:
    r"""Which Gaussians the training views need.

    With :math:`w_{vpi}` the blending weight of Gaussian i in pixel p of view v, those are pruned
    whose :math:`\sum_{v,p} w_{vpi}` is less than 1: they are hidden inside or behind surfaces.
    Floaters are pruned too: they are visible in at most two views, and more than half of their
    weight is in pixels whose median depth is more than twice theirs. Thin and long Gaussians are
    kept: they form edges, and renders are much worse without them.

    Args:
        gaussians: The fitted Gaussians.
        views: The training views, with their sides divided by `reduction`.
        reduction: See `reduction_for`. Weights are multiplied by its square.
        backend: Name of the renderer.
    """
    total = torch.zeros(len(gaussians))
    in_front = torch.zeros(len(gaussians))
    view_counts = torch.zeros(len(gaussians), dtype=torch.int32)
    area = reduction * reduction
    for view in views:
        weights, depth_behind = _view_weights(gaussians, view, backend)
        weights = area * weights
        pose = view.camera.cam_from_world
        depth = (gaussians.means.double() @ pose[2, :3] + pose[2, 3]).float()
        total += weights
        view_counts += weights >= _MIN_VIEW_WEIGHT
        in_front += torch.where(depth < _MAX_DEPTH_RATIO * depth_behind, weights, 0.0)
    floating = (view_counts <= _MAX_FLOATER_VIEWS) & (in_front > 0.5 * total)
    return (total >= _MIN_WEIGHT) & ~floating


def _view_weights(
    gaussians: Gaussians, view: MaskedView, backend: str
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Weight of each Gaussian in a view, and the weighted mean median depth of its pixels."""
    with torch.no_grad(), prepare(gaussians, view.camera, backend=backend) as prepared:
        depth = prepared.render().median_depth
        used = torch.ones_like(depth) if view.mask is None else view.mask.to(depth)
        # Where nothing opaque is behind, the background counts as the farthest depth.
        behind = torch.where(depth > 0, depth, depth.max())
        image = torch.stack((used, used * behind), dim=-1)
        sums = prepared.back_project(image).sums.cpu()
    return sums[:, 0], sums[:, 1] / sums[:, 0].clamp_min(1e-12)
