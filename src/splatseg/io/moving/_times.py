"""When views were taken and scans measured, on the clock of boxes."""

from collections.abc import Mapping
from typing import Any, Literal, cast

from splatseg._check import check_choice
from splatseg.core import Capture, Scan
from splatseg.core.boundary import boundary
from splatseg.core.json_values import is_json_number
from splatseg.core.view_names import frame_number
from splatseg.errors import InputError
from splatseg.io.captures.kitti360 import SCANS, VELODYNE, find_drive
from splatseg.io.captures.nerfstudio import FILE
from splatseg.io.captures.waymo_segment import MICROSECOND
from splatseg.io.json_files import read_json
from splatseg.io.text_numbers import frame_time, read_times

Clock = Literal["recorded", "frames"]
"""What times are. recorded: what the data set has, such as seconds, else frames. frames: the last
number in a name, as boxes of KITTI-360 are counted."""

CLOCKS = ("recorded", "frames")


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


def scan_time(scan: Scan, clock: Clock) -> float:
    """When a scan was measured: `Scan.time`, or the last number in its name.

    Raises:
        InputError: If it has neither.
    """
    if clock == "recorded" and scan.time is not None:
        return scan.time
    number = frame_number(scan.name)
    if number is None:
        raise InputError(
            f"scan {scan.name!r}: expected the time at which it was measured, to know which boxes "
            "of moving things are there, got none."
        )
    return float(number[1])


def _recorded(capture: Capture) -> dict[str, float]:
    """Times by the path of the photograph; none where a frame has none."""
    path = capture.path / FILE
    frames = read_json(path).get("frames") if path.is_file() else None
    found: dict[str, float] = {}
    for frame in cast("list[Any]", frames) if isinstance(frames, list) else []:
        row = cast("dict[str, Any]", frame) if isinstance(frame, dict) else {}
        time, name = row.get("time"), row.get("file_path")
        if not is_json_number(time) or not isinstance(name, str):
            return {}
        found[str(capture.path / name.replace("\\", "/"))] = float(time)
    return found
