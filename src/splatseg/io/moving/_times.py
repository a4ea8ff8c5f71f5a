"""When views were taken, on the clock of boxes and scans."""

from collections.abc import Mapping
from typing import Any, cast

from splatseg.core import Capture
from splatseg.core.boundary import boundary
from splatseg.core.json_numbers import is_json_number
from splatseg.core.view_names import frame_number
from splatseg.errors import InputError
from splatseg.io.captures.nerfstudio import FILE
from splatseg.io.json_files import read_json


@boundary
def view_times(capture: Capture) -> Mapping[str, float]:
    """The time of each view by its name.

    It is ``time`` of the view's frame in transforms.json where all frames have one, else the last
    number in the view's name, which counts the frames of a drive.

    Raises:
        InputError: If a view has neither.
        FileFormatError: If transforms.json is broken.
    """
    recorded = _recorded(capture) if capture.format == "nerfstudio" else {}
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
