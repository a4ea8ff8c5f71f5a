"""The capture that a scene is made of: with poses, or to be found for bare photographs."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import torch

from splatseg.core import Capture, DepthMap, PointCloud, ScanSource, View
from splatseg.core.boundary import boundary
from splatseg.core.models import PointmapModel
from splatseg.core.options import Count
from splatseg.core.options import options as options_class
from splatseg.errors import InputError, MissingFileError
from splatseg.fit import DepthPoints, scan_depths
from splatseg.io.atomic import check_utf8
from splatseg.io.captures import find_formats, read_capture
from splatseg.io.evidence import DepthEvidence, find_evidence, open_evidence, save_depth_map
from splatseg.io.pointmaps import HEADER_FILE, RecordedPointmaps, holds_pointmaps, open_pointmaps
from splatseg.io.scene_folder import POSES_FOLDER
from splatseg.models import model_names
from splatseg.pose import (
    PoseOptions,
    PoseProgress,
    PoseReport,
    PoseResult,
    holds_photographs,
    is_video,
    recover_poses,
)
from splatseg.pose.doctor import (
    Diagnosis,
    DoctorOptions,
    diagnose,
    read_for_doctor,
    write_corrected,
)
from splatseg.pose.pointmaps import (
    PointmapOptions,
    PointmapReport,
    PointmapResult,
    recover_from_pointmaps,
)
from splatseg.tasks.checkpoints import CheckpointOptions
from splatseg.tasks.moving import MovingClock
from splatseg.tasks.see import model_of, name_of
from splatseg.tasks.work import Observer, Step, check_new_folder

Poses = Literal["auto", "given", "sfm", "pointmaps"]
"""Where cameras come from."""


@options_class(removed={"preset": "`FitOptions.preset` gives the options of a preset"})
class MakeSceneOptions(CheckpointOptions):
    """How photographs are read, where cameras come from, and how a stopped fit goes on."""

    format: str = "auto"
    """Layout of the capture: auto, nerfstudio, blender, colmap, llff, idr, replica, scannet,
    scannetpp, kitti360 or waymo. auto takes the first of these that is found."""

    strict: bool = False
    """Refuse a capture with photographs that are missing, unreadable, of another shape than their
    intrinsics or mask or with an impossible pose, or with start points that are not finite. Without
    it they are left out and named, as long as half of the photographs remain."""

    poses: Poses = "auto"
    """Source of the cameras. given: the capture. sfm: structure from motion on the photographs,
    kept in SCENE/capture. pointmaps: pointmaps of pairs of photographs by a network such as
    DUSt3R, with a dense cloud to start from; for few photographs. auto: sfm where the capture has
    no poses."""

    pointmaps: str | None = None
    """With `poses` pointmaps: a folder of recorded pointmaps, or a model of another package,
    MODEL[=WEIGHTS][,OPTION=VALUE...]. None takes the folder pointmaps beside the photographs."""

    frames: Count = 120
    """Number of frames taken from a video."""

    add: Path | None = None
    """Scene folder that the photographs are added to: they are placed among its own, Gaussians are
    added where it has none, and all are optimised for some steps more (steps, or 5 a view). The
    result is a new scene, with the layers and the evidence of this one."""

    keep_checkpoint: bool = False
    """Keep the checkpoint of the finished fit, so that `resume` with more minutes or steps can make
    it longer."""

    blocks: Literal["auto", "off"] | Count = "off"
    """Fit in blocks, which need less memory and can be fitted on several machines: cells of the
    plan with an overlap, each fitted to the views that see it, and joined. A number of blocks;
    auto: one for 150 training views or a million Gaussians. They share the length and the largest
    number of Gaussians."""

    depth_evidence: str | None = None
    """Evidence of depth, as see --what depth writes it, instead of the capture's depth maps: a
    folder, or its name in the capture or in a scene that is replaced."""

    evidence: str | None = None
    """Evidence of objects that is learnt beside the photographs: label maps or masks, a folder or
    its name in the capture or in a scene that is replaced. Gaussians that lie on two objects are
    split; takes up to twice the time."""

    scans: Path | None = None
    """Laser scans in the world of the capture: the fit starts at their points and learns their
    depth as metric depth. For streets, whose far and thin objects photographs place badly."""

    points: Path | None = None
    """PLY file of points, or of a mesh, in the world of the capture: the fit starts there instead
    of at the capture's points."""

    moving: Path | None = None
    """Boxes of moving objects, which are left out of training views and scans: a JSON file, a drive
    of KITTI-360 or a segment of Waymo."""

    moving_classes: tuple[str, ...] = ()
    """Classes of label maps that move, such as car pedestrian: they are left out of training
    views."""

    moving_evidence: str | None = None
    """Label maps of `moving_classes`: a folder, or its name in the capture or in a scene that is
    replaced. None takes the only label maps there are."""

    moving_clock: MovingClock = "recorded"
    """Times of the boxes. recorded: those of the data set, such as seconds. frames: the last number
    in the name of a view or scan."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Examination:
    """What was found, and where a corrected capture was written."""

    diagnosis: Diagnosis
    written: Path | None
    """None where nothing was to be corrected, or no correction helps, or none was asked for."""


@boundary
def examine_capture(
    data: Path,
    *,
    fix: Path | None = None,
    options: DoctorOptions | None = None,
    format: str = "auto",
) -> Examination:
    """Find the usual faults of a capture with poses, and write a corrected one.

    Args:
        data: The capture.
        fix: Folder to write the corrected capture to; nothing of `data` is changed.
        options: How many photographs are looked at.
        format: How the capture is read.

    Raises:
        InputError: If the capture cannot be read, or something is in the way of `fix`.
    """
    options = options or DoctorOptions()
    if options.max_views < 2:
        raise InputError(f"max_views: expected at least 2, got {options.max_views}.")
    if fix is not None:
        check_new_folder(fix)
    read = read_for_doctor(data, format=format)
    diagnosis = diagnose(read.capture, options=options, found=read.faults, declared=read.declared)
    if fix is None or diagnosis.corrected is None:
        return Examination(diagnosis=diagnosis, written=None)
    write_corrected(diagnosis, fix)
    return Examination(diagnosis=diagnosis, written=fix)


# So many photographs without a pose are named; poses.json names all.
_NAMED = 10


def capture_of(
    data: Path,
    options: MakeSceneOptions,
    *,
    scene: Path,
    max_points: int | None,
    seed: int,
    observer: Observer,
) -> tuple[Capture, PoseReport | PointmapReport | None]:
    """Read a capture, or find the poses of photographs or a video and say how that went.

    Args:
        data: What the user gave.
        options: How it is read, and where cameras come from.
        scene: The scene folder; poses that are found are kept in it, and read from there by a
            later run with the same photographs.
        max_points: Most points of a cloud from pointmaps; None leaves it to them.
        seed: Of everything that is drawn at random.
        observer: Is told of the progress and of what was found.

    Returns:
        The capture, and how its poses were found; None where they came with it.
    """
    format, poses, pointmaps = options.format, options.poses, options.pointmaps
    if pointmaps is not None and poses != "pointmaps":
        raise InputError(f"pointmaps: expected none with `poses` {poses}, got {pointmaps!r}.")
    if not _without_poses(data, format, poses):
        return read_capture(data, format=format, strict=options.strict), None
    if poses == "pointmaps":
        return capture_of_pointmaps(
            data, pointmaps, scene=scene, max_points=max_points, seed=seed, observer=observer
        )
    check_utf8(data)
    how = PoseOptions(seed=seed, frames=options.frames)
    with observer.stage("poses") as step:
        result = recover_poses(
            data, folder=scene / POSES_FOLDER, options=how, progress=partial(_told, step)
        )
    for line in _sentences(data, scene / POSES_FOLDER, result):
        observer.info(line)
    return result.capture, result.report


def _told(step: Step, now: PoseProgress) -> None:
    """Stages take differently long: their names say more than an estimate of the whole."""
    step(now.done, 0, f"{now.stage} {now.done}/{now.total}" if now.total else now.stage)


def _without_poses(data: Path, format: str, poses: Poses) -> bool:
    if poses in ("sfm", "pointmaps"):
        if format != "auto":
            raise InputError(f"format: expected none with `poses` {poses}, got {format!r}.")
        return True
    if poses == "given" or format != "auto":
        return False
    if is_video(data):
        return True
    return data.is_dir() and not find_formats(data) and holds_photographs(data)


def _sentences(data: Path, folder: Path, result: PoseResult) -> list[str]:
    """What was placed, how well, by whom, and what was left out and why."""
    report = result.report
    lines = [_placed(data, report), _how_long(folder, result)]
    lines += [
        f"the {attempt.mapper} mapper placed {attempt.registered} ({attempt.error:.2f} px)"
        for attempt in report.tries
        if attempt.mapper != report.mapper
    ]
    lines += [
        f"lens of {lens.photographs} photographs: {lens.width}x{lens.height}, focal length "
        f"{lens.focal:.1f} px (first from {lens.start}), k1 {lens.k1:.4f}"
        for lens in report.lenses[:_NAMED]
    ]
    lines += [f"left out {left.name}: {left.why}" for left in report.left_out[:_NAMED]]
    more = len(report.left_out) - _NAMED
    if more > 0:
        lines.append(f"left out {more} more; {folder / 'poses.json'} names them")
    return lines


def _how_long(folder: Path, result: PoseResult | PointmapResult) -> str:
    if result.reused:
        return f"(as found before; remove {folder} to begin again)"
    seconds = result.report.seconds
    stages = ", ".join(f"{stage} {spent:.0f}" for stage, spent in seconds.items())
    return f"poses took {sum(seconds.values()):.0f} s ({stages})"


def _placed(data: Path, report: PoseReport) -> str:
    return (
        f"{data}: {len(report.registered)} of {report.photographs} photographs placed by the "
        f"{report.mapper} mapper, {report.points} points seen in {report.track_length:.1f} "
        f"photographs each, mean reprojection error {report.error:.2f} px at {report.longest} px"
    )


POINTMAPS_FOLDER = "pointmaps"
"""Where photographs have their recorded pointmaps, unless another folder is named."""

# So many pairs that contradict the rest are named; the report counts all.
_NAMED_PAIRS = 5


def capture_of_pointmaps(
    data: Path,
    named: str | None,
    *,
    scene: Path,
    max_points: int | None,
    seed: int,
    observer: Observer,
) -> tuple[Capture, PointmapReport]:
    """Find cameras and a cloud of photographs from pointmaps, and say how that went.

    Args:
        data: Folder of the photographs.
        named: A folder of recorded pointmaps, or a model as `model_of` takes it; None is the
            folder ``pointmaps`` in that of the photographs.
        scene: The scene folder; what was found is kept in it.
        max_points: Most points of the cloud; None is what `PointmapOptions` has.
        seed: Of everything that is drawn.
        observer: Is told of the progress and of what was found.

    Raises:
        MissingFileError: If there are no such photographs.
        InputError: If there is neither such a folder nor such a model.
    """
    check_utf8(data)
    source = _pointmap_source(data, named, observer)
    options = PointmapOptions(seed=seed)
    if max_points is not None:
        options = PointmapOptions(seed=seed, max_points=max_points)
    folder = scene / POSES_FOLDER
    with observer.stage("poses") as step:
        result = recover_from_pointmaps(
            data, source, folder=folder, options=options, progress=partial(_told, step)
        )
    for line in _pointmap_sentences(data, folder, result):
        observer.info(line)
    return result.capture, result.report


def _pointmap_source(
    data: Path, named: str | None, observer: Observer
) -> PointmapModel | RecordedPointmaps:
    if not data.is_dir():
        raise MissingFileError(f"{data}: there is no such folder of photographs.")
    if named is None:
        if not holds_pointmaps(data / POINTMAPS_FOLDER):
            raise InputError(
                f"pointmaps: expected a folder of recorded ones or the name of a model, or "
                f"{data / POINTMAPS_FOLDER} with {HEADER_FILE}, got none."
            )
        return open_pointmaps(data / POINTMAPS_FOLDER)
    # A name comes before a folder, as with evidence.
    if name_of(named) not in model_names() and Path(named).is_dir():
        return open_pointmaps(Path(named))
    if name_of(named) not in model_names():
        # Models that are there give none but where another package brings one: no list of them.
        raise InputError(
            f"pointmaps: expected a folder with {HEADER_FILE}, or a model of another package, got "
            f"{named!r}."
        )
    model = model_of(named, report=observer.note)
    if not isinstance(model, PointmapModel):
        raise InputError(f"pointmaps: expected a model that gives pointmaps, got {model.name}.")
    return model


def _pointmap_sentences(data: Path, folder: Path, result: PointmapResult) -> list[str]:
    """How many pairs agree, with which focal lengths, and who contradicts."""
    report = result.report
    lines = [
        f"{data}: {report.photographs} photographs placed by {report.pairs} pairs of pointmaps "
        f"({report.model}), which differ by {100 * report.residual:.1f} % of the depth; "
        f"{report.points} points",
        _how_long(folder, result),
    ]
    focals = sorted(report.focals.values())
    low, high = focals[0], focals[-1]
    lines.append(
        f"focal length {low:.1f} px" if low == high else f"focal lengths {low:.1f} to {high:.1f} px"
    )
    if report.contradictory:
        some = ", ".join(f"{a} with {b}" for a, b in report.contradictory[:_NAMED_PAIRS])
        more = len(report.contradictory) - _NAMED_PAIRS
        lines.append(
            f"{len(report.contradictory)} pairs contradict the rest and were left out: {some}"
            + (f" and {more} more" if more > 0 else "")
        )
    return lines


def with_depth_evidence(
    capture: Capture,
    asked: str,
    *,
    scene: Path,
    depth: str,
    report: Callable[[str], None],
) -> Capture:
    """The capture whose training views have the depth maps of evidence, and no others.

    Metric maps are brought to scene units where they are to count as metric.

    Args:
        capture: The capture.
        asked: Folder of the evidence, or its name.
        scene: The scene folder that the fit writes; one that is there may have the evidence.
        depth: How the fit takes it: metric or relative.
        report: Told in a sentence what the user should know.

    Raises:
        InputError: If there is no such evidence, it is of another kind or of other views, or its
            metres cannot be brought to scene units.
        FileFormatError: If it is broken.
    """
    folder = Path(asked)
    if not folder.is_dir():
        folder = find_evidence([capture.path, scene], asked)
    evidence = open_evidence(folder)
    if not isinstance(evidence, DepthEvidence):
        raise InputError(f"{folder}: expected evidence of depth, got {evidence.kind}.")
    kind = evidence.depth_kind()
    if depth == "metric" and kind == "relative":
        raise InputError(
            f"{folder}: expected evidence of metric depth, got relative depth; depth relative "
            "takes it."
        )
    unit = 1.0
    if depth == "metric":
        if capture.metres_per_unit is None:
            raise InputError(
                f"{folder}: expected a capture that tells how long its unit is, as this depth is "
                "in metres, got one that does not; depth relative takes it."
            )
        unit = 1 / capture.metres_per_unit
    files = evidence.files
    train = capture.train_views
    there = [view.name for view in train if view.name in files]
    if not there:
        raise InputError(
            f"{folder}: expected depth of the {len(train)} training views, got that of others "
            f"({', '.join(list(files)[:3])})."
        )
    if len(there) < len(train):
        report(f"{folder} has depth of {len(there)} of the {len(train)} training views")
    names = {view.name for view in train}
    views = tuple(
        view
        if view.name not in names
        else replace(view, depth=files.get(view.name), depth_unit=unit)
        if view.name in files
        else replace(view, depth=None, depth_unit=None)
        for view in capture.views
    )
    return replace(capture, views=views)


_START_CELL = 0.12
"""Metres: side of the cells of which each gives one point to start from."""

EVIDENCE = "depth_scans"
"""Folder of the depth maps in the evidence of a scene."""


def with_scans(
    capture: Capture,
    scans: ScanSource,
    *,
    scene: Path,
    report: Callable[[str], None],
) -> Capture:
    """The capture whose training views have depth maps of scans, and whose points are theirs too.

    The maps are written to the scene's evidence, where a fit that goes on finds them.

    Args:
        capture: The capture.
        scans: Scans of the same drive, in the same world.
        scene: The scene folder that the fit writes.
        report: Told in a sentence what the user should know.

    Raises:
        InputError: If no point of any scan is seen by a training view.
    """
    metres = capture.metres_per_unit or 1.0
    train = capture.train_views
    folder = scene / "evidence" / EVIDENCE
    points = DepthPoints(_START_CELL / metres)
    seen: dict[str, Path] = {}
    maps = scan_depths(scans, [view.camera for view in train], metres_per_unit=metres)
    for view, depth in zip(train, maps, strict=True):
        if not bool((depth > 0).any()):
            continue
        save_depth_map(DepthMap(values=depth * metres, kind="metric"), folder, view.name)
        seen[view.name] = folder / f"{view.name}.npz"
        points.add(view.camera, depth, view.read_image())
    if not seen:
        raise InputError(
            f"scans: expected points that the {len(train)} training views see, found none; are "
            "they in the world of the capture's poses?"
        )
    found = points.cloud()
    report(
        f"scans tell the depth of {len(seen)} of the {len(train)} training views, and give "
        f"{len(found):,} points to start from"
    )
    names = {view.name for view in train}
    views = tuple(
        _with_depth(view, seen.get(view.name), 1 / metres) if view.name in names else view
        for view in capture.views
    )
    return replace(capture, views=views, points=_together(capture.points, found))


def _with_depth(view: View, depth: Path | None, unit: float) -> View:
    return replace(view, depth=depth, depth_unit=None if depth is None else unit)


def _together(given: PointCloud | None, found: PointCloud) -> PointCloud:
    """Both clouds; of unknown colour the capture's are grey."""
    if given is None:
        return found
    grey = torch.full((len(given), 3), 128, dtype=torch.uint8)
    colours = [cloud if cloud is not None else grey for cloud in (given.colours, found.colours)]
    return PointCloud(
        points=torch.cat((given.points.float(), found.points.float())), colours=torch.cat(colours)
    )
