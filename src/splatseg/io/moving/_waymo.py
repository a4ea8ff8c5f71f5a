"""Boxes of Waymo around what moves: lidar_box, or laser_labels of frames of version 1.

A box is upright in the axes of the vehicle in its frame; it has a place, lengths, a heading about
z, and the velocity of the thing, m/s. Sun et al., CVPR 2020.
"""

import math
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core.json_values import MAX_NUMBER
from splatseg.core.moving import MovingBox
from splatseg.core.rigid import quaternion_from_rotation
from splatseg.errors import FileFormatError, quoted
from splatseg.io.captures.waymo_segment import (
    BOXES,
    MICROSECOND,
    SUFFIX,
    TIMESTAMP,
    VEHICLE_POSES,
    find_segments,
    one_segment,
)
from splatseg.io.captures.waymo_tfrecord import ENDING
from splatseg.io.foreign import made_from
from splatseg.io.moving._times import Clock
from splatseg.io.parquet import Row, integer_of, number_of, read_rows

_COMPONENT = "[LiDARBoxComponent]"
_ID = "key.laser_object_id"
_PLACE, _SIZE, _SPEED = (
    tuple(f"{_COMPONENT}.{name}.{axis}" for axis in "xyz")
    for name in ("box.center", "box.size", "speed")
)
_HEADING = f"{_COMPONENT}.box.heading"
_TYPE = f"{_COMPONENT}.type"
_TYPES = {1: "vehicle", 2: "pedestrian", 3: "sign", 4: "cyclist"}

SLOWEST = 0.5
"""m/s: a thing that is faster in any frame moves, and all of its boxes count, also those of when it
waits; annotators' boxes of parked cars tremble by less."""


def find_waymo_boxes(path: Path) -> bool:
    """Whether a folder has segments with boxes, or a file is of a segment."""
    if path.suffix in (SUFFIX, ENDING):
        return True
    return path.is_dir() and any(segment.has(BOXES) for segment in find_segments(path))


def read_waymo_boxes(path: Path, clock: Clock) -> tuple[MovingBox, ...]:
    """Boxes of what moves, in the world of the capture and in the order of the component.

    Args:
        path: The folder of the components, if it has one segment, else the file of any component
            of it, or a TFRecord file of version 1.
        clock: recorded: seconds, as scans have them. frames: the numbers in names of views and
            scans, microseconds.

    Raises:
        MissingFileError: If lidar_box or vehicle_pose is missing.
        InputError: If there are several segments, or a component is damaged.
        MissingPackageError: If pyarrow is not installed.
    """
    segment = one_segment(path)
    segment.needed(BOXES, VEHICLE_POSES)
    file = segment.component(BOXES)
    rows = read_rows(file, (TIMESTAMP, _ID, *_PLACE, *_SIZE, _HEADING, _TYPE, *_SPEED))
    # What has no name is a thing of its own in every frame.
    ids = [_id(row, where=f"{file}: row {i}") or f"{i}" for i, row in enumerate(rows)]
    moving = {
        id
        for i, (id, row) in enumerate(zip(ids, rows, strict=True))
        if _speed(row, where=f"{file}: row {i}") > SLOWEST
    }
    world_from_vehicle = {time: segment.placed(p) for time, p in segment.vehicle_poses.items()}
    found: list[MovingBox] = []
    for i, (id, row) in enumerate(zip(ids, rows, strict=True)):
        if id not in moving:
            continue
        where = f"{file}: row {i}"
        time = integer_of(row, TIMESTAMP, where=where)
        if time not in world_from_vehicle:
            raise FileFormatError(f"{where}: expected the pose of this frame in {VEHICLE_POSES}.")
        at = time * MICROSECOND if clock == "recorded" else float(time)
        kind = _TYPES.get(integer_of(row, _TYPE, where=where), "thing")
        found.append(_box(row, world_from_vehicle[time], at, f"{kind} {id}", where))
    return tuple(found)


def _box(row: Row, pose: NDArray[np.float64], time: float, name: str, where: str) -> MovingBox:
    place = np.array([_number(row, column, where=where) for column in _PLACE])
    x, y, z = (_number(row, column, where=where) for column in _SIZE)
    heading = _number(row, _HEADING, where=where)
    cos, sin = math.cos(heading), math.sin(heading)
    turned = pose[:3, :3] @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])
    with made_from(where):
        return MovingBox(
            centre=torch.from_numpy(pose[:3, :3] @ place + pose[:3, 3]),
            size=(x, y, z),
            rotation=quaternion_from_rotation(torch.from_numpy(turned)),
            start=time,
            end=time,
            name=name,
        )


def _speed(row: Row, *, where: str) -> float:
    """m/s; 0 where none is known."""
    if any(row[column] is None for column in _SPEED):
        return 0.0
    return math.hypot(*(number_of(row, column, where=where) for column in _SPEED))


def _id(row: Row, *, where: str) -> str:
    value: object = row[_ID]
    if not isinstance(value, str):
        raise FileFormatError(f"{where}: expected a name in {_ID}, got {quoted(value)}.")
    return value


def _number(row: Row, column: str, *, where: str) -> float:
    value = number_of(row, column, where=where)
    if abs(value) > MAX_NUMBER:
        raise FileFormatError(
            f"{where}: expected numbers up to {MAX_NUMBER:g} in {column}, got {value:g}."
        )
    return value
