"""Digests of what a result was made of: what was stopped is gone on with only if they are equal."""

import hashlib
from collections.abc import Iterable
from pathlib import Path

from splatseg.core import Camera

_FILE_HEAD = 65_536
"""Files are told apart by their sizes and so many of their first bytes."""


def digest(values: Iterable[object]) -> str:
    """16 hexadecimal digits of values, by how they print.

    Example:
        >>> digest([1, "a"]) == digest(iter((1, "a"))) != digest(["a", 1])
        True
    """
    found = hashlib.sha256()
    for value in values:
        found.update(repr(value).encode())
        found.update(b"\n")
    return found.hexdigest()[:16]


def camera_numbers(camera: Camera) -> tuple[object, ...]:
    """All numbers of a camera."""
    shape = (camera.width, camera.height, camera.model)
    lens = (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)
    return (*shape, *(float(number) for number in lens), camera.cam_from_world.tolist())


def file_mark(path: Path | None) -> tuple[int, str] | None:
    """Size of a file and a digest of its beginning, wherever it lies; (0, "") of a missing one."""
    if path is None:
        return None
    if not path.is_file():
        return (0, "")
    with path.open("rb") as file:
        head = file.read(_FILE_HEAD)
    return (path.stat().st_size, hashlib.sha256(head).hexdigest())
