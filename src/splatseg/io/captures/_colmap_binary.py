"""Reads COLMAP's binary files: little-endian, tightly packed, counts as uint64.

    cameras.bin   n, then: camera_id u32, model i32, width u64, height u64, parameters f64 each
    images.bin    n, then: image_id u32, q 4 f64, t 3 f64, camera_id u32, name, 0 byte,
                  m u64, m times (x f64, y f64, point3D_id i64)
    points3D.bin  n, then: id u64, xyz 3 f64, rgb 3 u8, error f64, m u64,
                  m times (image_id u32, point2D_index u32)
    rigs.bin      n, then: rig_id u32, m u32, and if m > 0: reference sensor (type i32, id u32),
                  m - 1 times (type i32, id u32, has_pose u8, if so q 4 f64, t 3 f64)
    frames.bin    n, then: frame_id u32, rig_id u32, q 4 f64, t 3 f64, m u32,
                  m times (type i32, sensor id u32, data id u64)

Every read is checked against the end of the file, so that a file that breaks off is an error
that says where, never a crash or a shorter model.
"""

import struct
from pathlib import Path

import numpy as np

from splatseg.core import PointCloud
from splatseg.errors import FileFormatError, quoted
from splatseg.io.captures._points import point_cloud
from splatseg.io.captures.colmap_model import (
    MODELS,
    ColmapCamera,
    ColmapFrame,
    ColmapImage,
    ColmapRig,
    rigid_matrix,
)
from splatseg.io.foreign import read_bytes

_CAMERA_SENSOR = 0
_MAX_NAME = 4096


class _Cursor:
    """Reads records off a file's bytes and refuses to run past its end."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._data = read_bytes(path, "a file of COLMAP")
        self._offset = 0

    def read(self, layout: struct.Struct) -> tuple[float, ...]:
        """The next record."""
        start = self.skip(layout.size)
        return layout.unpack_from(self._data, start)

    def skip(self, size: int) -> int:
        """Move on by `size` bytes; gives where they start."""
        start = self._offset
        if start + size > len(self._data):
            raise FileFormatError(
                f"{self._path}: expected {size} more bytes at byte {start}, but the file ends "
                f"after {len(self._data)}: it is cut short or corrupt."
            )
        self._offset = start + size
        return start

    def count(self, min_bytes: int) -> int:
        """The number of records that follow, each of at least this many bytes."""
        (number,) = self.read(_U64)
        left = len(self._data) - self._offset
        if number * min_bytes > left:
            raise FileFormatError(
                f"{self._path}: expected {number} records of at least {min_bytes} bytes, but "
                f"{left} bytes are left: it is cut short or corrupt."
            )
        return int(number)

    def text(self) -> str:
        """Characters up to a zero byte."""
        end = self._data.find(b"\0", self._offset, self._offset + _MAX_NAME)
        if end < 0:
            raise FileFormatError(
                f"{self._path}: expected a name that ends with a zero byte at byte "
                f"{self._offset}: the file is cut short or corrupt."
            )
        raw = self._data[self._offset : end]
        self._offset = end + 1
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError as error:
            raise FileFormatError(f"{self._path}: the name {quoted(raw)} is not UTF-8.") from error

    def finish(self) -> None:
        """Refuse bytes after the last record."""
        if self._offset != len(self._data):
            raise FileFormatError(
                f"{self._path}: expected the end of the file at byte {self._offset}, "
                f"got {len(self._data) - self._offset} bytes more: it is corrupt."
            )


_U64 = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT = struct.Struct("<Q3d3BdQ")
_RIG = struct.Struct("<II")
_SENSOR = struct.Struct("<iI")
_FLAG = struct.Struct("<B")
_POSE = struct.Struct("<7d")
_FRAME = struct.Struct("<II7dI")
_DATA = struct.Struct("<iIQ")


def read_cameras(path: Path) -> dict[int, ColmapCamera]:
    """cameras.bin: lenses by id."""
    cursor = _Cursor(path)
    cameras: dict[int, ColmapCamera] = {}
    for _ in range(cursor.count(_CAMERA.size)):
        id, model, width, height = (int(v) for v in cursor.read(_CAMERA))
        if model not in MODELS:
            raise FileFormatError(
                f"{path}: camera {id} has the model number {model}, which is not known "
                f"(0 to {max(MODELS)} are)."
            )
        name, count = MODELS[model]
        parameters = cursor.read(struct.Struct(f"<{count}d"))
        cameras[id] = ColmapCamera(model=name, width=width, height=height, parameters=parameters)
    cursor.finish()
    return cameras


def read_images(path: Path) -> dict[int, ColmapImage]:
    """images.bin: registered photographs by id; their 2D points are passed over."""
    cursor = _Cursor(path)
    images: dict[int, ColmapImage] = {}
    for _ in range(cursor.count(_IMAGE.size + 1 + _U64.size)):
        id, *pose, camera_id = cursor.read(_IMAGE)
        name = cursor.text()
        cursor.skip(24 * cursor.count(24))
        images[int(id)] = ColmapImage(
            name=name,
            camera_id=int(camera_id),
            cam_from_world=rigid_matrix(tuple(pose)),
        )
    cursor.finish()
    return images


def read_points(path: Path) -> PointCloud:
    """points3D.bin: positions and colours; tracks are passed over."""
    cursor = _Cursor(path)
    count = cursor.count(_POINT.size)
    points, colours = np.empty((count, 3)), np.empty((count, 3), np.uint8)
    for row in range(count):
        _, x, y, z, red, green, blue, _, track = cursor.read(_POINT)
        points[row] = (x, y, z)
        colours[row] = (red, green, blue)
        cursor.skip(8 * int(track))
    cursor.finish()
    return point_cloud(points, colours)


def read_rigs(path: Path) -> dict[int, ColmapRig]:
    """rigs.bin: cameras mounted together, by rig id."""
    cursor = _Cursor(path)
    rigs: dict[int, ColmapRig] = {}
    for _ in range(cursor.count(_RIG.size)):
        id, sensors = (int(v) for v in cursor.read(_RIG))
        poses = {}
        for index in range(sensors):
            kind, sensor = (int(v) for v in cursor.read(_SENSOR))
            # The first sensor is the reference: the rig's own axes are its axes.
            pose = np.eye(4) if index == 0 else None
            if index > 0 and cursor.read(_FLAG)[0]:
                pose = rigid_matrix(cursor.read(_POSE))
            if kind == _CAMERA_SENSOR and pose is not None:
                poses[sensor] = pose
        rigs[id] = ColmapRig(cam_from_rig=poses)
    cursor.finish()
    return rigs


def read_frames(path: Path) -> tuple[ColmapFrame, ...]:
    """frames.bin: poses of rigs over time."""
    cursor = _Cursor(path)
    frames: list[ColmapFrame] = []
    for _ in range(cursor.count(_FRAME.size)):
        _, rig_id, *pose, count = cursor.read(_FRAME)
        data = [cursor.read(_DATA) for _ in range(int(count))]
        images = tuple((int(s), int(i)) for kind, s, i in data if kind == _CAMERA_SENSOR)
        frames.append(
            ColmapFrame(
                rig_id=int(rig_id),
                rig_from_world=rigid_matrix(tuple(pose)),
                images=images,
            )
        )
    cursor.finish()
    return tuple(frames)
