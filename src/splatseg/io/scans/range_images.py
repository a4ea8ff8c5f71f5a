"""Laser scans as range images in one archive: a rendered street's ``lidar.npz``.

    range_2mm       u16 (scans, rows, columns), 2 mm a step, 0 for no return; or range, metres
    lidar_to_world  (scans, 4, 4)
    elevation, azimuth   rad, of rows and columns; x = cos e cos a, y = cos e sin a, z = sin e
    semantic, instance, intensity, time   may lack

The scans are written together, so the archive is unpacked once, and held while it is read from.
"""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg.errors import FileFormatError, MissingFileError
from splatseg.io.arrays import npz_names, read_npz
from splatseg.io.captures import read_metadata
from splatseg.io.captures.raw_views import checked_pose
from splatseg.io.scans._source import RawScan, Scans

FILE = "lidar.npz"
_STEP = 0.002
_RANGES = ("range_2mm", "range")
_NEEDED = ("lidar_to_world", "elevation", "azimuth")
_OPTIONAL = ("semantic", "instance", "intensity", "time")


def find_range_images(path: Path) -> Path | None:
    """The archive that a path is, or that lies in the folder; None where there is none."""
    file = path / FILE if path.is_dir() else path
    if file.suffix.lower() != ".npz" or not file.is_file():
        return None
    names = npz_names(file)
    # Without poses or angles it is still one, of which the reader says what is missing.
    ranged = any(name in names for name in _RANGES) and "xyz" not in names
    return file if ranged else None


def read_range_images(path: Path) -> Scans:
    """The scans of an archive; names count them from ``0000``.

    Raises:
        MissingFileError: If there is none.
        FileFormatError: If it is damaged, or its arrays do not belong together.
    """
    file = find_range_images(path)
    if file is None:
        raise MissingFileError(
            f"{path}: expected {FILE} with {' or '.join(_RANGES)}, {', '.join(_NEEDED)}, got none."
        )

    @cache
    def arrays() -> Mapping[str, NDArray[Any]]:
        return _checked(file)

    shape = arrays()["range"].shape
    return Scans(
        path=file,
        format="lidar-npz",
        scan_names=tuple(f"{i:04d}" for i in range(shape[0])),
        read=lambda name: _raw(file, arrays(), int(name)),
        classes=read_metadata(file.parent).classes,
        array_shape=shape,
    )


def _checked(file: Path) -> Mapping[str, NDArray[Any]]:
    arrays = read_npz(file, _NEEDED, optional=(*_RANGES, *_OPTIONAL))
    ranges = arrays["range_2mm"] if "range_2mm" in arrays else arrays["range"]
    steps = _STEP if "range_2mm" in arrays else 1.0
    if ranges.ndim != 3 or ranges.dtype.kind not in "iuf":
        raise FileFormatError(
            f"{file}: expected ranges (scans, rows, columns), got {ranges.dtype} of shape "
            f"{ranges.shape}."
        )
    scans, rows, columns = ranges.shape
    shapes = {"lidar_to_world": (scans, 4, 4), "elevation": (rows,), "azimuth": (columns,)}
    shapes |= {"time": (scans,)}
    for name, array in arrays.items():
        if name in _RANGES:
            continue
        expected = shapes.get(name, ranges.shape)
        if array.shape != expected or array.dtype.kind not in "iuf":
            raise FileFormatError(
                f"{file}: expected {name} of shape {expected} as its ranges ask for, got "
                f"{array.dtype} of shape {array.shape}."
            )
    for name in ("semantic", "instance"):
        if name in arrays and arrays[name].dtype.kind not in "iu":
            raise FileFormatError(f"{file}: expected whole ids in {name}, got others.")
    return {**arrays, "range": ranges, "step": np.array(steps)}


def _raw(file: Path, arrays: Mapping[str, NDArray[Any]], i: int) -> RawScan:
    where = f"{file}: scan {i}"
    pose = checked_pose(arrays["lidar_to_world"][i].astype(np.float64), where=where)
    ranges = arrays["range"][i].astype(np.float64) * float(arrays["step"])
    missing = ranges == 0
    if (ranges < 0).any():
        raise FileFormatError(f"{where}: expected ranges from 0 on, got {ranges.min():g}.")
    e = arrays["elevation"].astype(np.float64)[:, None]
    a = arrays["azimuth"].astype(np.float64)[None, :]
    directions = np.stack(
        (np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.broadcast_to(np.sin(e), ranges.shape)),
        axis=-1,
    )
    return RawScan(
        where=where,
        points=(directions * ranges[..., None]).reshape(-1, 3),
        world_from_sensor=pose,
        missing=missing.reshape(-1),
        intensity=arrays["intensity"][i].reshape(-1) if "intensity" in arrays else None,
        labels={
            name: arrays[name][i].reshape(-1) for name in ("semantic", "instance") if name in arrays
        },
        time=float(arrays["time"][i]) if "time" in arrays else None,
    )
