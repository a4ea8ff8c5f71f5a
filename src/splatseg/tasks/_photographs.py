"""The capture that a scene is made of: with poses, or to be found for bare photographs."""

from pathlib import Path
from typing import Literal

from splatseg.core import Capture
from splatseg.errors import InputError
from splatseg.io.atomic import check_utf8
from splatseg.io.captures import find_formats, read_capture
from splatseg.io.scene_folder import POSES_FOLDER
from splatseg.pose import (
    PoseOptions,
    PoseReport,
    PoseResult,
    holds_photographs,
    is_video,
    recover_poses,
)
from splatseg.pose.pointmaps import PointmapReport
from splatseg.tasks._observer import Observer
from splatseg.tasks._pointmaps import capture_of_pointmaps

Poses = Literal["auto", "given", "sfm", "pointmaps"]
"""Where cameras come from."""

# So many photographs without a pose are named; poses.json names all.
_NAMED = 10


def capture_of(
    data: Path,
    *,
    scene: Path,
    format: str,
    strict: bool,
    poses: Poses,
    pointmaps: str | None,
    max_points: int | None,
    frames: int,
    seed: int,
    observer: Observer,
) -> tuple[Capture, PoseReport | PointmapReport | None]:
    """Read a capture, or find the poses of photographs or a video and say how that went.

    Args:
        data: What the user gave.
        scene: The scene folder; poses that are found are kept in it, and read from there by a
            later run with the same photographs.
        format: How a capture is read; see `read_capture`.
        strict: Whether a capture may list photographs that are not there; see `read_capture`.
        poses: Where cameras come from.
        pointmaps: Whose pointmaps, with `poses` pointmaps; see `capture_of_pointmaps`.
        max_points: Most points of a cloud from pointmaps; None leaves it to them.
        frames: Frames taken from a video.
        seed: Of everything that is drawn at random.
        observer: Is told of the progress and of what was found.

    Returns:
        The capture, and how its poses were found; None where they came with it.
    """
    if pointmaps is not None and poses != "pointmaps":
        raise InputError(f"pointmaps: expected none with `poses` {poses}, got {pointmaps!r}.")
    if not _without_poses(data, format, poses):
        return read_capture(data, format=format, strict=strict), None
    if poses == "pointmaps":
        return capture_of_pointmaps(
            data, pointmaps, scene=scene, max_points=max_points, seed=seed, observer=observer
        )
    check_utf8(data)
    options = PoseOptions(seed=seed, frames=frames)
    with observer.pose_stage() as step:
        result = recover_poses(data, folder=scene / POSES_FOLDER, options=options, progress=step)
    for line in _sentences(data, scene / POSES_FOLDER, result):
        observer.info(line)
    return result.capture, result.report


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
    lines = [_placed(data, report)]
    if result.reused:
        lines.append(f"(as found before; remove {folder} to begin again)")
    else:
        stages = ", ".join(f"{stage} {seconds:.0f}" for stage, seconds in report.seconds.items())
        lines.append(f"poses took {sum(report.seconds.values()):.0f} s ({stages})")
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


def _placed(data: Path, report: PoseReport) -> str:
    return (
        f"{data}: {len(report.registered)} of {report.photographs} photographs placed by the "
        f"{report.mapper} mapper, {report.points} points seen in {report.track_length:.1f} "
        f"photographs each, mean reprojection error {report.error:.2f} px at {report.longest} px"
    )
