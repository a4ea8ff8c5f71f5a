"""Scans of lasers in the layouts people have, in the world, read one at a time.

`LAYOUTS` is the table of them; `read_scans` finds out which. Points are in the world of the
layout's poses, float64; labels are -1 where the file says that there is none.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

from splatseg._check import check_choice
from splatseg.core import ClassTable
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, MissingFileError
from splatseg.io.captures.kitti360 import window_of
from splatseg.io.scans import files, kitti, kitti360, waymo
from splatseg.io.scans._source import LastResult as LastResult
from splatseg.io.scans._source import Scans as Scans


class Layout(NamedTuple):
    """How scans of a layout are found and read."""

    name: str
    find: Callable[[Path], object]
    """Whether a folder or file has some: anything that counts as true."""

    read: Callable[[Path], Scans]


def _files(format: str) -> Layout:
    def find(path: Path) -> bool:
        return format in files.find_files(path)

    return Layout(format, find, partial(files.read_files, format=format))


LAYOUTS = (
    Layout("lidar-npz", files.find_range_images, files.read_range_images),
    Layout("kitti360", kitti360.find_velodyne, kitti360.read_velodyne),
    Layout("kitti360-sick", kitti360.find_sick, kitti360.read_sick),
    Layout("kitti360-points", kitti360.find_accumulated, kitti360.read_accumulated),
    Layout("semantic-kitti", kitti.find_semantic_kitti, kitti.read_semantic_kitti),
    Layout("kitti-odometry", kitti.find_odometry, kitti.read_odometry),
    Layout("kitti-raw", kitti.find_kitti_raw, kitti.read_kitti_raw),
    Layout("waymo", waymo.find_waymo_scans, waymo.read_waymo_scans),
    # Files of points come last: they may lie in the folder of any data set.
    *(_files(format) for format in ("las", "ply", "npz")),
)
"""Layouts that are read, in the order in which they are looked for."""

FORMATS = tuple(layout.name for layout in LAYOUTS)


@boundary
def read_scans(
    path: Path | str, *, format: str = "auto", classes: ClassTable | None = None
) -> Scans:
    """Scans by name; each is read when it is asked for, so that no drive is in memory.

    Args:
        path: The folder of a drive, or a file of points. Of KITTI-360 a drive, a sensor of it, or
            a window of frames behind either (see `captures.kitti360`).
        format: One of `FORMATS`, or ``auto`` for the first of them that is found.
        classes: Names of the ids of ``semantic``, instead of the format's own. A label that the
            table lacks is refused when its scan is read.

    Raises:
        MissingFileError: If there is no such path.
        InputError: If no layout is found, poses are missing, or a file is broken; one sentence.
    """
    check_choice("format", format, ("auto", *FORMATS))
    path = Path(path)
    if not path.exists() and window_of(path.name) is None:
        raise MissingFileError(f"{path}: there is no such folder or file of scans.")
    if format == "auto":
        format = find_scans(path)
    found = next(layout for layout in LAYOUTS if layout.name == format).read(path)
    return found if classes is None else replace(found, classes=classes)


@boundary
def find_scans(path: Path) -> str:
    """The layout of a folder or file: the first of `FORMATS` that it has.

    Raises:
        InputError: If it has none of them.
    """
    known = scan_formats(path)
    if known:
        return known[0]
    raise InputError(f"{path}: expected scans of a laser ({', '.join(FORMATS)}), got none of them.")


@boundary
def scan_formats(path: Path) -> tuple[str, ...]:
    """Layouts of scans that a folder or file has, the one that would be read first; none is ()."""
    return tuple(layout.name for layout in LAYOUTS if layout.find(path))
