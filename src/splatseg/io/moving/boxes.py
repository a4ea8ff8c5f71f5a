"""Boxes of moving things: a JSON file of our own, KITTI-360's annotations, Waymo's laser labels.

    {"boxes": [{"centre": [x, y, z], "size": [x, y, z], "rotation": [w, x, y, z],
                "start": 12, "end": 12.5, "name": "car 3"}, ...]}

World and scene units of the capture; ``rotation`` is world_from_box, and without it a box lies
along the axes of the world. ``time`` may stand for a ``start`` and ``end`` that are equal; without
any a box is always there.

    ROOT/data_3d_bboxes/train_full/DRIVE.xml    of KITTI-360, all that was annotated
    ROOT/data_3d_bboxes/train/DRIVE.xml         what lies in windows with labels

An object has ``timestamp``: the frame in which it was there, or -1 of what stands, which is left
out here. Its box is ``vertices`` (8, of half a metre to each side) under ``transform`` (4 x 4, with
the lengths of the box), in the world of the poses.

Waymo has lidar_box. A box is upright in the axes of the
vehicle in its frame; it has a place, lengths, a heading about z, and the velocity of the thing,
m/s. Sun et al., CVPR 2020.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg._check import check_choice
from splatseg.core.boundary import boundary
from splatseg.core.json_values import MAX_NUMBER
from splatseg.core.rigid import quaternion_from_rotation
from splatseg.core.scans import MovingBox
from splatseg.errors import MissingFileError
from splatseg.io.captures.kitti360 import SCANS, VELODYNE, Drive, find_drive
from splatseg.io.captures.waymo import (
    BOXES,
    MICROSECOND,
    OLD_SUFFIX,
    SUFFIX,
    TIMESTAMP,
    VEHICLE_POSES,
    find_segments,
    one_segment,
)
from splatseg.io.foreign import derived_from, expect, is_file, is_folder, malformed
from splatseg.io.json_files import read_json, write_json
from splatseg.io.moving.views import CLOCKS, Clock
from splatseg.io.parquet import Row, integer_of, number_of, read_rows
from splatseg.io.schema import structured
from splatseg.io.text_numbers import frame_time, read_times, time_at
from splatseg.io.xml_files import StoredObject, stored_objects

FOLDER = "data_3d_bboxes"
_SPLITS = ("train_full", "train")
_SUFFIX = ".xml"
_STANDS = -1
_LONGEST_NAME = 80

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
    if path.suffix in (SUFFIX, OLD_SUFFIX) or (
        path.is_dir() and any(segment.has(BOXES) for segment in find_segments(path))
    ):
        return _read_waymo(path, clock)
    # The path of a window is no folder.
    window = path.suffix == "" and is_folder(path.parent) and not is_file(path)
    if path.suffix == _SUFFIX or is_folder(path) or window:
        return _read_kitti360(path, clock)
    return _read_json(path)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Box:
    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    rotation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    start: float | None = None
    end: float | None = None
    time: float | None = None
    name: str = ""


_KEYS = tuple(field.name for field in fields(_Box))


def _read_json(path: Path) -> tuple[MovingBox, ...]:
    rows: object = read_json(path).get("boxes")
    if not isinstance(rows, list):
        raise malformed(path, "a list of boxes of moving things", rows)
    found: list[MovingBox] = []
    for i, row in enumerate(structured(rows, list[dict[str, Any]], where=f"{path}: boxes")):
        where = f"{path}: boxes[{i}]"
        strange = sorted(set(row) - set(_KEYS))
        expect(not strange, where, f"keys of {', '.join(_KEYS)}", "".join(strange[:1]))
        box = structured(row, _Box, where=where)
        twice = box.time is not None and not box.start is box.end is None
        expect(not twice, where, "a time, or a start and an end, got both")
        start = box.time if box.start is None else box.start
        end = box.time if box.end is None else box.end
        with derived_from(where):
            found.append(
                MovingBox(
                    centre=torch.tensor(box.centre, dtype=torch.float64),
                    size=box.size,
                    rotation=torch.tensor(box.rotation, dtype=torch.float64),
                    start=-math.inf if start is None else start,
                    end=math.inf if end is None else end,
                    name=box.name,
                )
            )
    return tuple(found)


@boundary
def write_moving(boxes: Sequence[MovingBox], path: Path) -> None:
    """Write boxes to a file that `read_moving` reads; atomic.

    Raises:
        OutputError: If it cannot be written.
    """
    rows: list[dict[str, Any]] = []
    for box in boxes:
        row: dict[str, Any] = {"centre": box.centre.tolist(), "size": list(box.size)}
        row["rotation"] = box.rotation.tolist()
        row |= {k: t for k, t in (("start", box.start), ("end", box.end)) if math.isfinite(t)}
        rows.append(row | ({"name": box.name} if box.name else {}))
    write_json({"boxes": rows}, path)


def _read_kitti360(path: Path, clock: Clock) -> tuple[MovingBox, ...]:
    """Boxes of what moves in the frames that are meant.

    A box is there from half-way after the frame before to half-way before the next, so that rows
    of points that are measured between frames find the nearest one.
    """
    file, drive = _kitti360_file(path)
    recorded = clock == "recorded"
    times = read_times(drive.of(SCANS, VELODYNE, "timestamps.txt")) if recorded else None
    found: list[MovingBox] = []
    for stored in stored_objects(file):
        if not stored.has("transform"):
            continue
        frame = stored.whole("timestamp")
        what = f"a frame, or {_STANDS} of what stands, got {frame}"
        expect(frame >= _STANDS, f"{stored.where}: timestamp", what)
        if frame != _STANDS and drive.has(frame):
            found.append(_kitti360_box(stored, frame, times))
    return tuple(found)


def _kitti360_file(path: Path) -> tuple[Path, Drive]:
    """The file of boxes that a path names, and its drive."""
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


def _kitti360_box(stored: StoredObject, frame: int, times: NDArray[np.float64] | None) -> MovingBox:
    """The smallest box along the axes of an object's transform that holds its vertices."""
    transform, vertices = stored.matrix("transform"), stored.matrix("vertices")
    fits = transform.shape == (4, 4) and vertices.shape[1] == 3
    what = "a transform of 4 x 4 and vertices of 3 numbers"
    expect(fits, stored.where, f"{what}, got {transform.shape} and {vertices.shape}")
    axes = _axes(transform[:3, :3], stored.where)
    along = (vertices @ transform[:3, :3].T) @ axes
    low, high = along.min(axis=0), along.max(axis=0)
    start, end = _span(times, frame)
    name = f"{stored.text('label') or 'thing'} {stored.text('instanceId')}"
    with derived_from(stored.where):
        return MovingBox(
            centre=torch.from_numpy(transform[:3, 3] + axes @ ((low + high) / 2)),
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
    if math.isnan(time_at(times, frame)):
        return now, now
    before, after = (
        now if math.isnan(moment := time_at(times, f)) else moment for f in (frame - 1, frame + 1)
    )
    return (now + min(before, now)) / 2, (now + max(after, now)) / 2


def _axes(matrix: NDArray[np.float64], where: str) -> NDArray[np.float64]:
    """The rotation nearest to the directions of a matrix's columns; boxes may be mirrored."""
    lengths = np.linalg.norm(matrix, axis=0)
    sound = (lengths > 0).all() and math.isfinite(float(lengths.max()))
    expect(sound, f"{where}: transform", "the axes of a box, got none")
    left, _, right = np.linalg.svd(matrix / lengths)
    axes: NDArray[np.float64] = left @ right
    if np.linalg.det(axes) < 0:
        axes[:, 2] = -axes[:, 2]
    return axes


def _read_waymo(path: Path, clock: Clock) -> tuple[MovingBox, ...]:
    """Boxes of what moves, in the world of the capture; frames are counted in microseconds."""
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
        posed = time in world_from_vehicle
        expect(posed, where, f"the pose of this frame in {VEHICLE_POSES}")
        at = time * MICROSECOND if clock == "recorded" else float(time)
        kind = _TYPES.get(integer_of(row, _TYPE, where=where), "thing")
        found.append(_waymo_box(row, world_from_vehicle[time], at, f"{kind} {id}", where))
    return tuple(found)


def _waymo_box(
    row: Row, pose: NDArray[np.float64], time: float, name: str, where: str
) -> MovingBox:
    columns = (*_PLACE, *_SIZE, _HEADING)
    values = [number_of(row, column, where=where) for column in columns]
    for column, value in zip(columns, values, strict=True):
        expect(abs(value) <= MAX_NUMBER, where, f"numbers up to {MAX_NUMBER:g} in {column}", value)
    x, y, z, heading = values[3:]
    cos, sin = math.cos(heading), math.sin(heading)
    turned = pose[:3, :3] @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])
    with derived_from(where):
        return MovingBox(
            centre=torch.from_numpy(pose[:3, :3] @ np.array(values[:3]) + pose[:3, 3]),
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
        raise malformed(where, f"a name in {_ID}", value)
    return value
