"""Scans of lasers in the layouts people have, in the world, read one at a time.

One module a layout; `read_scans` finds out which. Points are in the world of the layout's poses,
float64; labels are -1 where the file says that there is none.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

from splatseg._check import check_choice
from splatseg.core import ClassTable
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, MissingFileError
from splatseg.io.captures.kitti360 import window_of
from splatseg.io.scans._source import Scans as Scans
from splatseg.io.scans.files import find_files, read_files
from splatseg.io.scans.kitti import find_kitti_raw, read_kitti_raw
from splatseg.io.scans.kitti360 import (
    find_accumulated,
    find_sick,
    find_velodyne,
    read_accumulated,
    read_sick,
    read_velodyne,
)
from splatseg.io.scans.nuscenes import find_nuscenes, read_nuscenes
from splatseg.io.scans.range_images import find_range_images, read_range_images
from splatseg.io.scans.semantic_kitti import (
    find_odometry,
    find_semantic_kitti,
    read_odometry,
    read_semantic_kitti,
)
from splatseg.io.scans.waymo import find_waymo_scans, read_waymo_scans

_READERS: Mapping[str, tuple[Callable[[Path], object], Callable[[Path], Scans]]] = {
    "lidar-npz": (find_range_images, read_range_images),
    "kitti360": (find_velodyne, read_velodyne),
    "kitti360-sick": (find_sick, read_sick),
    "kitti360-points": (find_accumulated, read_accumulated),
    "semantic-kitti": (find_semantic_kitti, read_semantic_kitti),
    "kitti-odometry": (find_odometry, read_odometry),
    "kitti-raw": (find_kitti_raw, read_kitti_raw),
    "waymo": (find_waymo_scans, read_waymo_scans),
    "nuscenes": (find_nuscenes, read_nuscenes),
    # Files of points come last: they may lie in the folder of any data set.
    "las": (lambda path: "las" in find_files(path), partial(read_files, format="las")),
    "ply": (lambda path: "ply" in find_files(path), partial(read_files, format="ply")),
    "npz": (lambda path: "npz" in find_files(path), partial(read_files, format="npz")),
}

FORMATS = tuple(_READERS)
"""Layouts that are read, in the order in which they are looked for."""


@boundary
def read_scans(
    path: Path | str, *, format: str = "auto", classes: ClassTable | None = None
) -> Scans:
    """Scans by name; each is read when it is asked for, so that no drive is in memory.

    Args:
        path: The folder of a drive, or a file of points. Of KITTI-360 a drive, a sensor of it, or
            a window of frames behind either (see `captures.kitti360_drive`).
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
    found = _READERS[format][1](path)
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
    return tuple(name for name, (found, _) in _READERS.items() if found(path))
