"""The aligned pairs once more, at all their pixels: depth maps of photographs and a cloud."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.pose.pointmaps._align import Aligned
from splatseg.pose.pointmaps._geometry import ray_directions
from splatseg.pose.pointmaps._samples import (
    MIN_WEIGHT,
    PairSamples,
    PairSource,
    PhotographSize,
    pixel_offsets,
)

_MIN_PAIR_WEIGHT = 0.3
"""Pairs that are believed less take no part."""

_CONTRADICTION = 0.05
"""A point that lies nearer to another camera than that camera's surest depth, by this share of it,
hangs in the air there."""

_DRAWN_MORE = 1.6
"""Points drawn for each that is wanted, since some are dropped."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthMaps:
    """Depths of the photographs at the pixels of their pointmaps, float32."""

    depth: tuple[Float[Tensor, "rows columns"], ...]
    """Weighted geometric mean over pairs; 0 where none says anything."""

    sure: tuple[Float[Tensor, "rows columns"], ...]
    """Sum of the weights, less where pairs differ."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cloud:
    """Points of the photographs, in the world."""

    points: Float[Tensor, "n 3"]
    view: Tensor
    """Photograph of each, int64."""

    place: Float[Tensor, "n 2"]
    """Where it lies in the photograph: right and down, from 0 to 1."""


def read_depth_maps(
    photographs: Sequence[PhotographSize],
    samples: PairSamples,
    aligned: Aligned,
    source: PairSource,
    *,
    progress: Callable[[int, int], None],
) -> DepthMaps:
    """Bring all pixels of the pairs that are believed into their cameras, one pair at a time.

    Memory is three numbers a pixel of each photograph, however many pairs there are.
    """
    sums = [torch.zeros(3, *size) for size in samples.sizes]
    believed = (aligned.weight >= _MIN_PAIR_WEIGHT).nonzero()[:, 0].tolist()
    for done, e in enumerate(believed, start=1):
        ends = [int(i) for i in samples.views[e]]
        for view, one in zip(
            ends, source.pointmaps(*(photographs[i].name for i in ends)), strict=True
        ):
            depth = _depth_in_camera(aligned, e, view, one.points)
            weight = aligned.weight[e].float() * one.confidence.float().log().clamp_min(MIN_WEIGHT)
            weight = torch.where(depth > 0, weight, 0.0)
            logs = depth.clamp_min(1e-12).log()
            sums[view] += torch.stack((weight, weight * logs, weight * logs.square()))
        progress(done, len(believed))
    depths: list[Tensor] = []
    sures: list[Tensor] = []
    for weight, first, second in sums:
        total = weight.clamp_min(1e-12)
        mean = first / total
        spread = (second / total - mean.square()).clamp_min(0)
        depths.append(torch.where(weight > 0, mean.exp(), 0.0))
        # Pairs that differ by as much as a contradiction halve what is known.
        sures.append(weight / (1 + spread / _CONTRADICTION**2))
    return DepthMaps(depth=tuple(depths), sure=tuple(sures))


def draw_cloud(
    photographs: Sequence[PhotographSize],
    aligned: Aligned,
    maps: DepthMaps,
    *,
    count: int,
    keep: float,
    seed: int,
) -> Cloud:
    """At most `count` points of the surest pixels, of all photographs alike.

    Points that would hang in front of what another photograph sees, and is surer of, are left out.

    Args:
        photographs: The photographs.
        aligned: Their cameras.
        maps: Their depths.
        count: Most points.
        keep: Share of the pixels that are drawn from, the surest.
        seed: Of the drawing.
    """
    generator = torch.Generator().manual_seed(seed)
    flat = torch.cat([sure.flatten() for sure in maps.sure])
    rank = int((1 - keep) * (len(flat) - 1))
    least = max(float(flat.kthvalue(rank + 1).values), 1e-9)
    usable = (flat >= least).nonzero()[:, 0]
    order = torch.randperm(len(usable), generator=generator)[: round(_DRAWN_MORE * count)]
    chosen = usable[order.sort().values]
    points: list[Tensor] = []
    views: list[Tensor] = []
    places: list[Tensor] = []
    begin = 0
    for view, (one, depth) in enumerate(zip(photographs, maps.depth, strict=True)):
        size = (int(depth.shape[0]), int(depth.shape[1]))
        own = chosen[(chosen >= begin) & (chosen < begin + depth.numel())] - begin
        begin += depth.numel()
        rows, columns = own // size[1], own % size[1]
        offsets = pixel_offsets(one, size, rows, columns)
        local = (
            ray_directions(offsets, aligned.focal[view]) * depth[rows, columns].double()[:, None]
        )
        world = local @ aligned.rotation[view].T + aligned.centre[view]
        alone = _contradicted(
            photographs, aligned, maps, own=view, points=world, sure=maps.sure[view][rows, columns]
        )
        points.append(world[~alone])
        views.append(torch.full((int((~alone).sum()),), view))
        extent = offsets.new_tensor([one.width, one.height])
        places.append((offsets / extent + 0.5)[~alone])
    found = torch.cat(points)
    drawn = torch.randperm(len(found), generator=generator)[:count].sort().values
    return Cloud(
        points=found[drawn].float(), view=torch.cat(views)[drawn], place=torch.cat(places)[drawn]
    )


def _depth_in_camera(aligned: Aligned, pair: int, view: int, points: Tensor) -> Tensor:
    """z-depth of a pair's points in the camera of a photograph."""
    axis = aligned.rotation[view][:, 2]
    turned = aligned.scale[pair] * (axis @ aligned.pair_rotation[pair])
    shift = axis @ (aligned.pair_translation[pair] - aligned.centre[view])
    return (points.double() @ turned + shift).float()


def _contradicted(
    photographs: Sequence[PhotographSize],
    aligned: Aligned,
    maps: DepthMaps,
    *,
    own: int,
    points: Tensor,
    sure: Tensor,
) -> Tensor:
    """Which points of a photograph hang in front of what another one sees and is surer of."""
    found = torch.zeros(len(points), dtype=torch.bool)
    for view, (one, depth) in enumerate(zip(photographs, maps.depth, strict=True)):
        if view == own:
            continue
        local = (points - aligned.centre[view]) @ aligned.rotation[view]
        ahead = local[:, 2] > 1e-9
        plane = aligned.focal[view] * local[:, :2] / local[:, 2:].clamp_min(1e-9)
        share = plane / plane.new_tensor([one.width, one.height]) + 0.5
        inside = (ahead & (share >= 0).all(dim=1) & (share < 1).all(dim=1)).nonzero()[:, 0]
        rows = (share[inside, 1] * depth.shape[0]).long()
        columns = (share[inside, 0] * depth.shape[1]).long()
        seen = depth[rows, columns].double()
        in_front = local[inside, 2] < (1 - _CONTRADICTION) * seen
        surer = maps.sure[view][rows, columns] > sure[inside]
        found[inside[in_front & surer]] = True
    return found
