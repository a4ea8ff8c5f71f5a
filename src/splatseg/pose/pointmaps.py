"""Photographs and a network of pointmaps in, a capture with cameras and a dense cloud out."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import Capture, PointCloud
from splatseg.core.boundary import boundary
from splatseg.core.models import PointmapModel
from splatseg.errors import InputError
from splatseg.io.pointmaps import RecordedPointmaps
from splatseg.pose._photographs import Photograph, find_photographs, read_headers, read_reduced
from splatseg.pose._pointmap_align import Aligned, align, initial
from splatseg.pose._pointmap_pixels import (
    MIN_WEIGHT,
    PairSamples,
    PairSource,
    PhotographSize,
    network_pairs,
    pixel_offsets,
    read_samples,
    source_digest,
    wanted_pairs,
)
from splatseg.pose._pointmap_pixels import (
    PairGraph as PairGraph,
)
from splatseg.pose._pointmap_pixels import (
    PointmapOptions as PointmapOptions,
)
from splatseg.pose._pointmap_refine import refine
from splatseg.pose._pointmap_start import (
    agreement,
    average,
    lens_focals,
    pair_geometry,
    ray_directions,
    spanning_tree,
    tree_world,
)
from splatseg.pose._recover import PoseProgress, requested_or_temporary, teller
from splatseg.pose._saved import (
    ANSWERS,
    SavedWorld,
    capture_of_world,
    content_digest,
    load_world,
    save_world,
)
from splatseg.pose._saved import PointmapReport as PointmapReport

# From pairs that were read to one world, by either way.


_ROBUST_ITERATIONS = 60

_SAMPLES = 768
"""Pixels of each photograph that cameras are found from."""

_KEPT_SHARE = 0.8
"""Share of the pixels, the surest, that the cloud is taken from."""

# Options of version 0.1 that are constants now: its digests have them.
_CONSTANTS = {
    "complete_up_to": 16,
    "neighbours": 6,
    "alignment": "robust",
    "symmetric": True,
    "samples": 768,
    "iterations": None,
    "block": 50,
    "keep": 0.8,
}


def solve(
    samples: PairSamples, *, options: PointmapOptions, progress: Callable[[int, int], None]
) -> Aligned:
    """Cameras, depths and pairs in one world."""
    focal = lens_focals(samples)
    geometry = pair_geometry(samples, focal)
    tree = spanning_tree(samples, agreement(samples, geometry))
    world = average(samples, geometry, tree_world(samples, geometry, tree))
    start = initial(samples, geometry, world, focal)
    stages = 2 if options.refine else 1

    def percent(stage: int) -> Callable[[int, int], None]:
        return lambda done, total: progress(100 * stage + 100 * done // total, 100 * stages)

    aligned = align(samples, start, iterations=_ROBUST_ITERATIONS, progress=percent(0))
    if not options.refine:
        return aligned
    return refine(samples, aligned, progress=percent(1))


_LONGEST_OF_COLOURS = 1600
_MIN_WEIGHT = 0.1
"""A pair that is believed less is called contradictory."""

_Tell = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointmapResult:
    """Photographs with cameras and a cloud, and how they came by them."""

    capture: Capture
    report: PointmapReport
    reused: bool
    """Whether all of it was there from an earlier run."""


@boundary
def recover_from_pointmaps(
    photographs: Path,
    source: PointmapModel | RecordedPointmaps,
    *,
    folder: Path | None = None,
    options: PointmapOptions = PointmapOptions(),  # noqa: B008  (frozen)
    progress: Callable[[PoseProgress], None] | None = None,
) -> PointmapResult:
    """Cameras and a dense cloud of bare photographs from pointmaps of pairs of them.

    Focal lengths are found from single maps (eq. 4), relative cameras by resection, a start from
    a spanning tree of pairs that agree and averages over all pairs, and the rest by global
    alignment (eq. 5); then all pixels of the pairs are brought into that world. Photographs are
    taken for straight lenses with their principal point in the middle. The unit is one in which
    the product of the pairs' scales is one. Every 8th photograph by name is a test view.

    Args:
        photographs: A folder of photographs, or with a folder ``images``.
        source: A network, or what one answered before.
        folder: Where the result, and what a network answers, is kept: a second call with the same
            photographs, options and source reads it, and a call after one that was stopped asks
            only about pairs that are not there. None keeps nothing.
        options: How.
        progress: Told now and then where the work stands.

    Returns:
        The capture and a report; the same at every call with the same seed.

    Raises:
        MissingFileError: If there are no such photographs, or a recorded pair is not there.
        FileFormatError: If a photograph or a recorded pair is damaged.
        InputError: If photographs are in no pair, pairs do not hang together, or pointmaps of
            one photograph differ in size.
    """
    begun = time.monotonic()
    files = find_photographs(photographs)
    good, bad = read_headers(files)
    if bad:
        raise InputError(f"{bad[0].name}: expected photographs that can be read, got {bad[0].why}.")
    asked = _CONSTANTS | asdict(options) | {"source": source_digest(source)}
    made_of = content_digest(files, asked)
    with requested_or_temporary(folder) as kept:
        world = load_world(kept, made_of=made_of)
        reused = world is not None
        if world is None:
            tell = teller(progress)
            world = _find(good, source, kept, options=options, tell=tell, begun=begun)
            save_world(world, kept, made_of=made_of)
    capture = capture_of_world(world, good, files[0].parent)
    notes = (*capture.notes, *world.report.notes)
    return PointmapResult(capture=replace(capture, notes=notes), report=world.report, reused=reused)


def _find(
    photographs: Sequence[Photograph],
    source: PointmapModel | RecordedPointmaps,
    folder: Path,
    *,
    options: PointmapOptions,
    tell: _Tell,
    begun: float,
) -> SavedWorld:
    seconds = {"photographs": time.monotonic() - begun}
    sizes = [
        PhotographSize(name=one.path.name, width=one.width, height=one.height)
        for one in photographs
    ]
    there = _recorded_pairs(source, sizes) if isinstance(source, RecordedPointmaps) else None
    pairs = wanted_pairs(photographs, options, there=there)
    answers: PairSource = (
        source
        if isinstance(source, RecordedPointmaps)
        else network_pairs(source, photographs, folder / ANSWERS, longest=options.longest)
    )
    begin = time.monotonic()
    samples = read_samples(
        sizes,
        pairs,
        answers,
        count=_SAMPLES,
        shared_focal=options.shared_focal,
        seed=options.seed,
        progress=lambda done, total: tell("pairs", done, total),
    )
    seconds["pairs"] = time.monotonic() - begin
    begin = time.monotonic()
    aligned = solve(
        samples, options=options, progress=lambda done, total: tell("alignment", done, total)
    )
    seconds["alignment"] = time.monotonic() - begin
    begin = time.monotonic()
    maps = read_depth_maps(
        sizes, samples, aligned, answers, progress=lambda done, total: tell("cloud", done, total)
    )
    cloud = draw_cloud(sizes, aligned, maps, count=options.max_points, seed=options.seed)
    colours = _colours(photographs, cloud)
    seconds["cloud"] = time.monotonic() - begin
    report = _report(source, sizes, pairs, aligned, points=len(cloud.points), seconds=seconds)
    return SavedWorld(
        cam_from_world=_cam_from_world(aligned),
        focal=aligned.focal,
        cloud=PointCloud(points=cloud.points, colours=colours),
        report=report,
    )


def _recorded_pairs(
    source: RecordedPointmaps, sizes: Sequence[PhotographSize]
) -> list[tuple[int, int]]:
    """Pairs of a folder, by places in the list of photographs; of other photographs, none."""
    place = {one.name: i for i, one in enumerate(sizes)}
    return [(place[a], place[b]) for a, b in source.pairs if a in place and b in place]


def _cam_from_world(aligned: Aligned) -> Tensor:
    out = torch.eye(4, dtype=torch.float64).repeat(len(aligned.centre), 1, 1)
    rotation = aligned.rotation.transpose(1, 2)
    out[:, :3, :3] = rotation
    out[:, :3, 3] = -(rotation @ aligned.centre.unsqueeze(-1)).squeeze(-1)
    return out


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cloud:
    """Points of the photographs, in the world."""

    points: Float[Tensor, "n 3"]
    view: Tensor
    """Photograph of each, int64."""

    place: Float[Tensor, "n 2"]
    """Where it lies in the photograph: right and down, from 0 to 1."""


def _colours(photographs: Sequence[Photograph], cloud: Cloud) -> Tensor:
    """What the photographs show where the points were taken from."""
    colours = torch.zeros(len(cloud.points), 3, dtype=torch.uint8)
    for view, one in enumerate(photographs):
        mine = (cloud.view == view).nonzero()[:, 0]
        if not len(mine):
            continue
        image = read_reduced(one, longest=_LONGEST_OF_COLOURS)
        size = cloud.place.new_tensor([image.shape[1], image.shape[0]])
        pixels = torch.minimum((cloud.place[mine] * size).long(), size.long() - 1)
        colours[mine] = image[pixels[:, 1], pixels[:, 0]]
    return colours


def _report(
    source: PointmapModel | RecordedPointmaps,
    sizes: Sequence[PhotographSize],
    pairs: Sequence[tuple[int, int]],
    aligned: Aligned,
    *,
    points: int,
    seconds: dict[str, float],
) -> PointmapReport:
    order = aligned.weight.argsort(stable=True)
    wrong: list[int] = order[aligned.weight[order] < _MIN_WEIGHT].tolist()
    believed = aligned.weight >= _MIN_WEIGHT
    held = {i for e in believed.nonzero()[:, 0].tolist() for i in pairs[e]}
    notes = tuple(
        f"every pair of {one.name} contradicts the others; its camera is a guess"
        for i, one in enumerate(sizes)
        if i not in held
    )
    return PointmapReport(
        photographs=len(sizes),
        model=source.folder.name if isinstance(source, RecordedPointmaps) else source.name,
        pairs=len(pairs),
        contradictory=tuple((sizes[pairs[e][0]].name, sizes[pairs[e][1]].name) for e in wrong),
        residual=float(aligned.residual[believed].median()),
        focals={one.name: float(f) for one, f in zip(sizes, aligned.focal, strict=True)},
        points=points,
        seconds=seconds,
        notes=notes,
    )


# The aligned pairs once more, at all their pixels: depth maps of photographs and a cloud.


_MIN_PAIR_WEIGHT = 0.3
"""Pairs that are believed less take no part."""

_CONTRADICTION = 0.05
"""A point that lies nearer to another camera than that camera's surest depth, by this share of it,
hangs in the air there."""

_DRAWN_MORE = 1.6
"""Points drawn for each that is wanted, since some are dropped."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointmapDepths:
    """Depths of the photographs at the pixels of their pointmaps, float32."""

    depth: tuple[Float[Tensor, "rows columns"], ...]
    """Weighted geometric mean over pairs; 0 where none says anything."""

    sure: tuple[Float[Tensor, "rows columns"], ...]
    """Sum of the weights, less where pairs differ."""


def read_depth_maps(
    photographs: Sequence[PhotographSize],
    samples: PairSamples,
    aligned: Aligned,
    source: PairSource,
    *,
    progress: Callable[[int, int], None],
) -> PointmapDepths:
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
    return PointmapDepths(depth=tuple(depths), sure=tuple(sures))


def draw_cloud(
    photographs: Sequence[PhotographSize],
    aligned: Aligned,
    maps: PointmapDepths,
    *,
    count: int,
    seed: int,
) -> Cloud:
    """At most `count` points of the surest pixels, of all photographs alike.

    Points that would hang in front of what another photograph sees, and is surer of, are left out.

    Args:
        photographs: The photographs.
        aligned: Their cameras.
        maps: Their depths.
        count: Most points.
        seed: Of the drawing.
    """
    generator = torch.Generator().manual_seed(seed)
    flat = torch.cat([sure.flatten() for sure in maps.sure])
    rank = int((1 - _KEPT_SHARE) * (len(flat) - 1))
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
    maps: PointmapDepths,
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
