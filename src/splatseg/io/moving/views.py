"""Views and scans without what moves, and when they were taken, on the clock of boxes."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Bool
from torch import Tensor
from torch.nn.functional import interpolate, max_pool2d

from splatseg._check import check_choice
from splatseg.core import Capture, Scan, ScanSource, View
from splatseg.core.boundary import boundary
from splatseg.core.options import Natural, NonNegative, options
from splatseg.core.scans import MovingBox, boxes_at, inside_boxes, pixels_of_boxes
from splatseg.core.scene import camera_of_map, frame_number
from splatseg.errors import FileFormatError, InputError
from splatseg.io.atomic import path_inside
from splatseg.io.captures.kitti360 import SCANS, VELODYNE, find_drive
from splatseg.io.captures.nerfstudio import FILE
from splatseg.io.captures.waymo import MICROSECOND
from splatseg.io.evidence import Evidence
from splatseg.io.images import load_mask, save_png
from splatseg.io.json_files import read_json
from splatseg.io.schema import structured
from splatseg.io.text_numbers import frame_time, read_times

Clock = Literal["recorded", "frames"]
"""What times are. recorded: what the data set has, such as seconds, else frames. frames: the last
number in a name, as boxes of KITTI-360 are counted."""

CLOCKS = ("recorded", "frames")


@options
class MovingOptions:
    """What is left out with moving things."""

    margin: NonNegative = 0.1
    """Boxes are larger by this on every side, metres."""

    grow: Natural = 3
    """Pixels around those of moving classes that are left out too, as borders of labels are
    rough."""

    clock: Clock = "recorded"
    """What the times of boxes are. recorded: what the data set has, such as seconds. frames: the
    last number in the name of a view or scan."""


@boundary
def mask_moving(
    capture: Capture,
    folder: Path,
    *,
    boxes: Sequence[MovingBox] = (),
    labels: Evidence | None = None,
    classes: Sequence[str] = (),
    times: Mapping[str, float] | None = None,
    options: MovingOptions | None = None,
    report: Callable[[str], None] | None = None,
) -> Capture:
    """The capture whose training views have masks without moving things.

    Masks of the capture count as well. Views that show nothing that moves keep theirs.

    Args:
        capture: The capture.
        folder: Where masks are written, PNG by view name: 0 where something moves.
        boxes: Boxes of moving things, see `read_moving`.
        labels: Label maps of views, for `classes`.
        classes: Names of classes of these whose things move, such as ``car``.
        times: When views were taken, by their names; None is `view_times` of the options' clock.
        options: Margins.
        report: Told in a sentence what is left out.

    Raises:
        InputError: If classes are given without label maps, the maps do not know one, a view has
            no time, or no box is there at the time of any view.
        ShapeError: If a label map is not of its view.
        OutputError: If a mask cannot be written.
    """
    options = options or MovingOptions()
    ids = _ids_of(labels, classes)
    known = {} if times is None else times
    if boxes:
        known = view_times(capture, clock=options.clock) if times is None else times
        _check_clock(boxes, [_time_of(view, known) for view in capture.train_views])
    unit = capture.metres_per_unit or 1.0
    views: list[View] = []
    changed = left_out = pixels = 0
    for view in capture.views:
        moving = torch.zeros(view.camera.height, view.camera.width, dtype=torch.bool)
        if view.split == "train":
            if boxes:
                there = boxes_at(boxes, _time_of(view, known))
                moving |= pixels_of_boxes(view.camera, there, margin=options.margin / unit)
            if labels is not None and ids and view.name in labels.view_names:
                moving |= _labelled(labels, view, ids, options.grow)
            pixels += moving.numel()
        if bool(moving.any()):
            changed, left_out = changed + 1, left_out + int(moving.sum())
            view = _masked(view, moving, folder)
        views.append(view)
    if report is not None:
        share = left_out / max(pixels, 1)
        report(
            f"moving things are left out of {changed} of the {len(capture.train_views)} training "
            f"views, {share:.1%} of their pixels"
        )
    return replace(capture, views=tuple(views))


def _ids_of(labels: Evidence | None, classes: Sequence[str]) -> tuple[int, ...]:
    if not classes:
        return ()
    if labels is None or labels.classes is None:
        raise InputError(
            "classes: expected label maps with names of classes, to know what moves, got "
            f"{'none' if labels is None else 'maps without names'}."
        )
    return tuple(labels.classes.by_name(name).id for name in classes)


def _time_of(view: View, times: Mapping[str, float]) -> float:
    if view.name not in times:
        raise InputError(f"times: expected one of every training view, got none of {view.name!r}.")
    return times[view.name]


def _check_clock(boxes: Sequence[MovingBox], times: Sequence[float]) -> None:
    """Refuse boxes of which none is there when a view was taken: their clock is another."""
    if any(boxes_at(boxes, time) for time in times) or not times:
        return
    raise InputError(
        f"boxes: expected some at the times of views, {min(times):g} to {max(times):g}, got boxes "
        f"from {min(box.start for box in boxes):g} to {max(box.end for box in boxes):g}; is their "
        "clock another (recorded or frames)?"
    )


def _labelled(
    labels: Evidence, view: View, ids: Collection[int], grow: int
) -> Bool[Tensor, "height width"]:
    """Pixels of some classes, those around them too, in the size of the photograph."""
    found = labels.label_map(view.name).ids
    camera_of_map(view, found.shape[0], found.shape[1])
    moving = torch.isin(found, found.new_tensor(sorted(ids))).float()[None, None]
    size = (view.camera.height, view.camera.width)
    if tuple(found.shape) != size:
        moving = interpolate(moving, size=size, mode="nearest-exact")
    return max_pool2d(moving, 2 * grow + 1, stride=1, padding=grow)[0, 0] > 0


def _masked(view: View, moving: Bool[Tensor, "height width"], folder: Path) -> View:
    """The view with a mask that lacks some pixels as well, written to the folder."""
    own = load_mask(view)
    used = ~moving if own is None else ~moving & own.bool()
    path = path_inside(folder, f"{view.name}.png")
    save_png(torch.where(used, 255, 0).to(torch.uint8), path)
    return replace(view, mask=path)


@boundary
def view_times(capture: Capture, *, clock: Clock = "recorded") -> Mapping[str, float]:
    """The time of each view by its name.

    It is ``time`` of the view's frame in transforms.json where all frames have one; of Waymo the
    seconds of the frame; of KITTI-360 those of ``timestamps.txt`` of the turning laser, as its
    scans have them. Where there is none of these, or `clock` says frames, it is the last number in
    the view's name, which counts the frames.

    Raises:
        InputError: If a view has neither.
        FileFormatError: If transforms.json or timestamps.txt is broken.
    """
    check_choice("clock", clock, CLOCKS)
    if clock == "recorded" and capture.format in ("kitti360", "waymo"):
        return _of_data_set(capture)
    known = clock == "recorded" and capture.format == "nerfstudio"
    recorded = _recorded(capture) if known else {}
    times: dict[str, float] = {}
    for view in capture.views:
        number = frame_number(view.name)
        image = "" if view.image is None else str(view.image)
        if image in recorded:
            times[view.name] = recorded[image]
        elif not recorded and number is not None:
            times[view.name] = float(number[1])
        else:
            raise InputError(
                f"{capture.path}: expected a time of every view, to know which boxes of moving "
                f"things are there, got none of view {view.name!r}; give `time` of every frame in "
                "transforms.json, or number the views as their frames."
            )
    return times


def _of_data_set(capture: Capture) -> Mapping[str, float]:
    """Times of views of KITTI-360 or Waymo on the clock of their scans."""
    numbers = view_times(capture, clock="frames")
    if capture.format == "waymo":
        return {name: int(number) * MICROSECOND for name, number in numbers.items()}
    drive = find_drive(capture.path)
    path = None if drive is None else drive.of(SCANS, VELODYNE, "timestamps.txt")
    times = None if path is None else read_times(path)
    return {name: frame_time(times, int(number)) for name, number in numbers.items()}


@dataclass(frozen=True, slots=True)
class _TimedFrame:
    file_path: str
    time: float


def _recorded(capture: Capture) -> dict[str, float]:
    """Times by the path of the photograph; none where a frame has none."""
    path = capture.path / FILE
    frames = read_json(path).get("frames") if path.is_file() else None
    found: dict[str, float] = {}
    for frame in frames if isinstance(frames, list) else []:  # pyright: ignore[reportUnknownVariableType]
        try:
            row = structured(frame, _TimedFrame, where=path)
        except FileFormatError:
            return {}
        found[str(capture.path / row.file_path.replace("\\", "/"))] = row.time
    return found


def _scan_time(scan: Scan, clock: Clock) -> float:
    """When a scan was measured: `Scan.time`, or the last number in its name."""
    if clock == "recorded" and scan.time is not None:
        return scan.time
    number = frame_number(scan.name)
    if number is None:
        raise InputError(
            f"scan {scan.name!r}: expected the time at which it was measured, to know which boxes "
            "of moving things are there, got none."
        )
    return float(number[1])


class StaticScans:
    """Scans without their points in boxes of moving things; a `core.ScanSource`.

    The boxes of a scan are those that are there at its time: `Scan.time`, unless `clock` says
    frames, else the last number in its name, which counts the frames.

    Args:
        scans: The scans.
        boxes: Boxes of moving things.
        margin: By how much boxes are larger on every side, scene units.
        clock: What the times of boxes are.
        times: When scans were measured, by their names, where that is known better.
    """

    @boundary
    def __init__(
        self,
        scans: ScanSource,
        boxes: Sequence[MovingBox],
        *,
        margin: float = 0.0,
        clock: Clock = "recorded",
        times: Mapping[str, float] | None = None,
    ) -> None:
        self._scans, self._boxes, self._margin = scans, tuple(boxes), margin
        self._times = dict(times or {})
        self._clock: Clock = clock

    @property
    def scan_names(self) -> Sequence[str]:
        """All scans."""
        return self._scans.scan_names

    def scan(self, name: str) -> Scan:
        """One of them without what moves.

        Raises:
            InputError: If there is none of that name, its file is broken, or it has no time.
        """
        scan = self._scans.scan(name)
        known = self._times.get(name)
        there = boxes_at(self._boxes, _scan_time(scan, self._clock) if known is None else known)
        moving = inside_boxes(scan.points, there, margin=self._margin)
        return scan.take(torch.nonzero(~moving).squeeze(1)) if bool(moving.any()) else scan
