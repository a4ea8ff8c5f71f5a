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
from splatseg.io.scans._source import Scans as Scans
from splatseg.io.scans.files import find_files, find_range_images, read_files, read_range_images
from splatseg.io.scans.kitti import (
    find_kitti_raw,
    find_odometry,
    find_semantic_kitti,
    read_kitti_raw,
    read_odometry,
    read_semantic_kitti,
)
from splatseg.io.scans.kitti360 import (
    find_accumulated,
    find_sick,
    find_velodyne,
    read_accumulated,
    read_sick,
    read_velodyne,
)
from splatseg.io.scans.nuscenes import find_nuscenes, read_nuscenes
from splatseg.io.scans.waymo import find_waymo_scans, read_waymo_scans


class Layout(NamedTuple):
    """How scans of a layout are found and read."""

    name: str
    find: Callable[[Path], object]
    """Whether a folder or file has some: anything that counts as true."""

    read: Callable[[Path], Scans]


def _files(format: str) -> Layout:
    return Layout(
        format, lambda path: format in find_files(path), partial(read_files, format=format)
    )


LAYOUTS = (
    Layout("lidar-npz", find_range_images, read_range_images),
    Layout("kitti360", find_velodyne, read_velodyne),
    Layout("kitti360-sick", find_sick, read_sick),
    Layout("kitti360-points", find_accumulated, read_accumulated),
    Layout("semantic-kitti", find_semantic_kitti, read_semantic_kitti),
    Layout("kitti-odometry", find_odometry, read_odometry),
    Layout("kitti-raw", find_kitti_raw, read_kitti_raw),
    Layout("waymo", find_waymo_scans, read_waymo_scans),
    Layout("nuscenes", find_nuscenes, read_nuscenes),
    # Files of points come last: they may lie in the folder of any data set.
    _files("las"),
    _files("ply"),
    _files("npz"),
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
