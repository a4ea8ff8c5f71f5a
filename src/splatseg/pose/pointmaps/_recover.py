"""Photographs and a network of pointmaps in, a capture with cameras and a dense cloud out."""

import tempfile
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from splatseg.core import Capture, PointCloud
from splatseg.core.boundary import boundary
from splatseg.core.models import PointmapModel
from splatseg.errors import InputError
from splatseg.io.pointmaps import RecordedPointmaps
from splatseg.pose._photographs import Photograph, find_photographs, read_headers, read_reduced
from splatseg.pose._recover import PoseProgress
from splatseg.pose._saved import content_digest
from splatseg.pose.pointmaps._align import Aligned
from splatseg.pose.pointmaps._cloud import Cloud, draw_cloud, read_depth_maps
from splatseg.pose.pointmaps._graph import wanted_pairs
from splatseg.pose.pointmaps._options import PointmapOptions
from splatseg.pose.pointmaps._report import PointmapReport
from splatseg.pose.pointmaps._samples import PairSource, PhotographSize, read_samples
from splatseg.pose.pointmaps._saved import (
    ANSWERS,
    SavedWorld,
    capture_of_world,
    load_world,
    save_world,
)
from splatseg.pose.pointmaps._solve import solve
from splatseg.pose.pointmaps._source import network_pairs, source_digest

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
    asked = asdict(options) | {"source": source_digest(source)}
    made_of = content_digest(files, asked)
    with _given_or_temporary(folder) as kept:
        world = load_world(kept, made_of=made_of)
        reused = world is not None
        if world is None:
            tell = _teller(progress)
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
        count=options.samples,
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
    cloud = draw_cloud(
        sizes, aligned, maps, count=options.max_points, keep=options.keep, seed=options.seed
    )
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


@contextmanager
def _given_or_temporary(folder: Path | None) -> Generator[Path]:
    """The folder; where there is none, one that is deleted afterwards. None is left empty."""
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        try:
            yield folder
        finally:
            with suppress(OSError):  # it is not empty
                folder.rmdir()
        return
    with tempfile.TemporaryDirectory(prefix="splatseg-") as temporary:
        yield Path(temporary)


def _teller(progress: Callable[[PoseProgress], None] | None) -> _Tell:
    def tell(stage: str, done: int, total: int) -> None:
        if progress is not None:
            progress(PoseProgress(stage=stage, done=done, total=total))

    return tell
