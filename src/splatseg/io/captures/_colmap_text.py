"""Reads COLMAP's text files; lines that start with # are comments.

cameras.txt   CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]
images.txt    IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of 2D points that
              may be empty
points3D.txt  POINT3D_ID X Y Z R G B ERROR TRACK[]
rigs.txt      RIG_ID NUM_SENSORS REF_TYPE REF_ID, then TYPE ID HAS_POSE [QW QX QY QZ TX TY TZ]
frames.txt    FRAME_ID RIG_ID QW QX QY QZ TX TY TZ NUM_DATA, then TYPE ID DATA_ID
"""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np

from splatseg.core import PointCloud
from splatseg.errors import FileFormatError, quoted
from splatseg.io.captures._points import point_cloud
from splatseg.io.captures.colmap_model import (
    ColmapCamera,
    ColmapFrame,
    ColmapImage,
    ColmapRig,
    rigid_matrix,
)
from splatseg.io.foreign import reading

_T = TypeVar("_T")


def read_cameras(path: Path) -> dict[int, ColmapCamera]:
    """cameras.txt: lenses by id."""

    def parse(line: str) -> tuple[int, ColmapCamera]:
        id, model, width, height, *parameters = line.split()
        return int(id), ColmapCamera(
            model=model,
            width=int(width),
            height=int(height),
            parameters=tuple(float(p) for p in parameters),
        )

    return dict(_parsed(path, _rows(path), parse, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS"))


def read_images(path: Path) -> dict[int, ColmapImage]:
    """images.txt: registered photographs by id; every second line is passed over."""
    lines = _lines(path)
    rows: list[tuple[int, str]] = []
    number = 0
    while number < len(lines):
        line = lines[number].strip()
        if line and not line.startswith("#"):
            rows.append((number + 1, line))
            # The line of 2D points that follows belongs to this image even when it is empty.
            number += 1
        number += 1

    def parse(line: str) -> tuple[int, ColmapImage]:
        words = line.split(maxsplit=9)
        return int(words[0]), ColmapImage(
            name=words[9],
            camera_id=int(words[8]),
            cam_from_world=rigid_matrix(tuple(float(w) for w in words[1:8])),
        )

    return dict(_parsed(path, rows, parse, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"))


def read_points(path: Path) -> PointCloud:
    """points3D.txt: positions and colours."""

    def parse(line: str) -> tuple[float, ...]:
        words = line.split(maxsplit=8)[1:7]
        red, green, blue = (int(w) for w in words[3:])
        if not all(0 <= c <= 255 for c in (red, green, blue)):
            raise ValueError("a colour is not a byte")
        return (*(float(w) for w in words[:3]), red, green, blue)

    rows = _parsed(path, _rows(path), parse, "POINT3D_ID X Y Z R G B ERROR")
    values = np.array(rows, np.float64).reshape(-1, 6)
    return point_cloud(values[:, :3], values[:, 3:].astype(np.uint8))


def read_rigs(path: Path) -> dict[int, ColmapRig]:
    """rigs.txt: cameras mounted together, by rig id."""

    def parse(line: str) -> tuple[int, ColmapRig]:
        id, count, *words = line.split()
        poses = {}
        for index in range(int(count)):
            kind, sensor = words.pop(0), int(words.pop(0))
            pose = np.eye(4) if index == 0 else None
            if index > 0 and int(words.pop(0)):
                pose = rigid_matrix(tuple(float(words.pop(0)) for _ in range(7)))
            if kind == "CAMERA" and pose is not None:
                poses[sensor] = pose
        return int(id), ColmapRig(cam_from_rig=poses)

    return dict(_parsed(path, _rows(path), parse, "RIG_ID NUM_SENSORS REF_TYPE REF_ID SENSORS"))


def read_frames(path: Path) -> tuple[ColmapFrame, ...]:
    """frames.txt: poses of rigs over time."""

    def parse(line: str) -> ColmapFrame:
        words = line.split()
        pose = rigid_matrix(tuple(float(w) for w in words[2:9]))
        count = int(words[9])
        if not 0 <= 3 * count <= len(words) - 10:
            raise ValueError("NUM_DATA is not the number of entries")
        data = [words[10 + 3 * i : 13 + 3 * i] for i in range(count)]
        images = tuple((int(s), int(i)) for kind, s, i in data if kind == "CAMERA")
        return ColmapFrame(rig_id=int(words[1]), rig_from_world=pose, images=images)

    columns = "FRAME_ID RIG_ID QW QX QY QZ TX TY TZ NUM_DATA DATA"
    return tuple(_parsed(path, _rows(path), parse, columns))


def _lines(path: Path) -> list[str]:
    with reading(path, "a text file in UTF-8"):
        return path.read_text(encoding="utf-8").splitlines()


def _rows(path: Path) -> list[tuple[int, str]]:
    lines = [(number, line.strip()) for number, line in enumerate(_lines(path), start=1)]
    return [(number, line) for number, line in lines if line and not line.startswith("#")]


def _parsed(
    path: Path, rows: list[tuple[int, str]], parse: Callable[[str], _T], columns: str
) -> list[_T]:
    found: list[_T] = []
    for number, line in rows:
        try:
            found.append(parse(line))
        except (ValueError, IndexError, OverflowError) as error:
            raise FileFormatError(
                f"{path}: line {number}: expected {columns}, got {quoted(line)}."
            ) from error
    return found
