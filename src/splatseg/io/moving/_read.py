"""Boxes of moving things from whatever holds them."""

from pathlib import Path

from splatseg._check import check_choice
from splatseg.core.boundary import boundary
from splatseg.core.scans import MovingBox
from splatseg.io.foreign import is_file, is_folder
from splatseg.io.moving._json import read_json_boxes
from splatseg.io.moving._kitti360 import kitti360_boxes, read_kitti360_boxes
from splatseg.io.moving._times import CLOCKS, Clock
from splatseg.io.moving._waymo import find_waymo_boxes, read_waymo_boxes


@boundary
def read_moving(path: Path, *, clock: Clock = "recorded") -> tuple[MovingBox, ...]:
    """Boxes of moving things, of a file of our own or of a data set; in the order of the file.

    A path is a JSON file (`write_moving`); a drive of KITTI-360 or a window of one, or a file
    ``data_3d_bboxes/*/DRIVE.xml``; or a segment of Waymo, as `io.captures.read_capture` takes it.
    They are in the world of the captures and scans of the same data set.

    Args:
        path: The file or folder.
        clock: Which times boxes of a data set get, those that `view_times`, `mask_moving` and
            `StaticScans` take for the same word. A JSON file has its own.

    Raises:
        MissingFileError: If there is no such file, or a folder has no boxes.
        InputError: If a folder has several drives or segments.
        FileFormatError: If it is no file of boxes, or one of them cannot be.
        MissingPackageError: If it is of Waymo, and pyarrow is not installed.
    """
    check_choice("clock", clock, CLOCKS)
    if find_waymo_boxes(path):
        return read_waymo_boxes(path, clock)
    if path.suffix == ".xml" or is_folder(path) or _is_window(path):
        file, drive = kitti360_boxes(path)
        return read_kitti360_boxes(file, drive, clock)
    return read_json_boxes(path)


def _is_window(path: Path) -> bool:
    """Whether a path is that of a window, which is no folder."""
    return path.suffix == "" and is_folder(path.parent) and not is_file(path)
