"""Boxes of KITTI-360 around what moves.

    ROOT/data_3d_bboxes/train_full/DRIVE.xml    all that was annotated
    ROOT/data_3d_bboxes/train/DRIVE.xml         what lies in windows with labels

An object has ``timestamp``: the frame in which it was there, or -1 of what stands, which is left
out here. Its box is ``vertices`` (8, of half a metre to each side) under ``transform`` (4 x 4, with
the lengths of the box), in the world of the poses.
"""

import math
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core.moving import MovingBox
from splatseg.core.rigid import quaternion_from_rotation
from splatseg.errors import FileFormatError, MissingFileError
from splatseg.io.captures.kitti360 import SCANS, VELODYNE, Drive, find_drive
from splatseg.io.foreign import is_file, made_from
from splatseg.io.moving._opencv_storage import StoredObject, stored_objects
from splatseg.io.moving._times import Clock
from splatseg.io.text_numbers import frame_time, read_times

FOLDER = "data_3d_bboxes"
_SPLITS = ("train_full", "train")
_SUFFIX = ".xml"
_STANDS = -1
_PARTS = ("rows", "cols", "data")
_WANTED = frozenset(
    (
        "label", "instanceId", "timestamp",
        *(f"transform.{part}" for part in _PARTS),
        *(f"vertices.{part}" for part in _PARTS),
    )
)  # fmt: skip
_LONGEST_NAME = 80


def kitti360_boxes(path: Path) -> tuple[Path, Drive]:
    """The file of boxes that a path names, and its drive.

    A path is a file of ``data_3d_bboxes``, or names a drive or a window of one.

    Raises:
        MissingFileError: If there is none.
        InputError: If it is the data set's folder, with several drives.
    """
    if path.suffix == _SUFFIX:
        parents = path.absolute().parents
        return path, Drive(root=parents[min(2, len(parents) - 1)], name=path.stem)
    drive = find_drive(path)
    if drive is not None:
        for split in _SPLITS:
            file = drive.root / FOLDER / split / f"{drive.name}{_SUFFIX}"
            if is_file(file):
                return file, drive
    raise MissingFileError(
        f"{path}: expected boxes of moving things, a JSON file, {FOLDER}/*/DRIVE{_SUFFIX} of "
        "KITTI-360 or lidar_box of Waymo, got none."
    )


def read_kitti360_boxes(path: Path, drive: Drive, clock: Clock) -> tuple[MovingBox, ...]:
    """Boxes of what moves in the frames that are meant, in the order of the file.

    A box is there from half-way after the frame before to half-way before the next, so that rows
    of points that are measured between frames find the nearest one.

    Args:
        path: The file.
        drive: Its drive; where it has a window, boxes of other frames are left out.
        clock: recorded: seconds of ``timestamps.txt`` of the turning laser, as scans have them,
            or the frame's number where it has none. frames: the frame's number.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is damaged, or an object is no box.
    """
    times = None
    if clock == "recorded":
        times = read_times(drive.of(SCANS, VELODYNE, "timestamps.txt"))
    found: list[MovingBox] = []
    for stored in stored_objects(path, _WANTED):
        if not stored.has("transform"):
            continue
        frame = stored.whole("timestamp")
        if frame < _STANDS:
            raise FileFormatError(
                f"{stored.where}: timestamp: expected a frame, or {_STANDS} of what stands, got "
                f"{frame}."
            )
        if frame != _STANDS and drive.has(frame):
            found.append(_box(stored, frame, times))
    return tuple(found)


def _box(stored: StoredObject, frame: int, times: NDArray[np.float64] | None) -> MovingBox:
    """The smallest box along the axes of an object's transform that holds its vertices."""
    transform, vertices = stored.matrix("transform"), stored.matrix("vertices")
    if transform.shape != (4, 4) or vertices.shape[1] != 3:
        raise FileFormatError(
            f"{stored.where}: expected a transform of 4 x 4 and vertices of 3 numbers, got "
            f"{transform.shape} and {vertices.shape}."
        )
    axes = _axes(transform[:3, :3], stored.where)
    along = (vertices @ transform[:3, :3].T) @ axes
    low, high = along.min(axis=0), along.max(axis=0)
    centre = transform[:3, 3] + axes @ ((low + high) / 2)
    start, end = _span(times, frame)
    name = f"{stored.text('label') or 'thing'} {stored.text('instanceId')}"
    with made_from(stored.where):
        return MovingBox(
            centre=torch.from_numpy(centre),
            size=(float(high[0] - low[0]), float(high[1] - low[1]), float(high[2] - low[2])),
            rotation=quaternion_from_rotation(torch.from_numpy(axes)),
            start=start,
            end=end,
            name=name.strip()[:_LONGEST_NAME],
        )


def _span(times: NDArray[np.float64] | None, frame: int) -> tuple[float, float]:
    """When what was annotated in a frame is there: half-way to the frames around it."""
    now = frame_time(times, frame)
    if times is None:
        return now - 0.5, now + 0.5
    if not _known(times, frame):
        return now, now
    before, after = (float(times[f]) if _known(times, f) else now for f in (frame - 1, frame + 1))
    return (now + min(before, now)) / 2, (now + max(after, now)) / 2


def _known(times: NDArray[np.float64], frame: int) -> bool:
    return 0 <= frame < len(times) and math.isfinite(times[frame])


def _axes(matrix: NDArray[np.float64], where: str) -> NDArray[np.float64]:
    """The rotation nearest to the directions of a matrix's columns; boxes may be mirrored."""
    lengths = np.linalg.norm(matrix, axis=0)
    if not (lengths > 0).all() or not math.isfinite(float(lengths.max())):
        raise FileFormatError(f"{where}: transform: expected the axes of a box, got none.")
    left, _, right = np.linalg.svd(matrix / lengths)
    axes: NDArray[np.float64] = left @ right
    if np.linalg.det(axes) < 0:
        axes[:, 2] = -axes[:, 2]
    return axes
