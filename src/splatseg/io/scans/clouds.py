"""Point clouds that are in the world already: PLY, and arrays of NumPy; long ones in pieces.

PLY of binary rows is read piece by piece from the disk; ASCII and compressed archives are read at
once. Labels are the column ``semantic``, ``class_id``, ``label``, ``class`` or ``classification``,
and ``instance`` or ``instance_id``; 0 is void. Other spellings are found as CloudCompare exports
them, ``scalar_`` before the name. Arrays are ``xyz`` or ``points`` (n x 3), ids ``semantic`` and
``instance``; an ``.npy`` is n x 3 or more, of which the first three columns count.
"""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg.errors import FileFormatError, quoted
from splatseg.io.arrays import npz_names, read_npy, read_npz
from splatseg.io.foreign import reading
from splatseg.io.ply import PlyHeader, read_ply_header, read_ply_tables
from splatseg.io.scans._source import RawScan

PIECE = 1_000_000
"""Points that are read at a time."""

_LABELS = {
    "semantic": ("semantic", "class_id", "label", "class", "classification"),
    "instance": ("instance", "instance_id"),
}
_SPELLINGS = ("", "scalar_")
_POSITIONS = ("xyz", "points")
_INTENSITIES = ("intensity", "remission", "reflectance")

Piece = tuple[int, Callable[[int, int], RawScan]]
"""How many points a file has, and what reads those of a range."""


def ply_points(path: Path) -> Piece:
    """Points of a PLY file.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no PLY whose first element is vertex with x, y and z, or it
            ends early.
    """
    count, columns = ply_pieces(path)
    return count, lambda start, end: _raw(path, columns(start, end))


def ply_pieces(path: Path) -> tuple[int, Callable[[int, int], Mapping[str, NDArray[Any]]]]:
    """How many points a PLY file has, and what reads all columns of a range of them.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no PLY whose first element is vertex with x, y and z, or it
            ends early.
    """
    header = read_ply_header(path)
    element = header.elements[0] if header.elements else None
    names = [] if element is None else [one.name for one in element.properties]
    if element is None or element.name != "vertex" or not {"x", "y", "z"} <= set(names):
        raise FileFormatError(
            f"{path}: expected a PLY whose first element is vertex with x, y and z, got "
            f"{quoted(', '.join(names)) if names else 'none'}."
        )
    lists = any(one.count_code is not None for one in element.properties)
    if not header.order or lists:
        columns = read_ply_tables(path, header, ["vertex"])["vertex"].numbers
        return element.count, lambda start, end: {
            name: values[start:end] for name, values in columns.items()
        }
    dtype = np.dtype([(one.name, header.order + one.code) for one in element.properties])
    with reading(path, "a PLY file"):
        have = path.stat().st_size - header.offset
    if have < dtype.itemsize * element.count:
        raise FileFormatError(
            f"{path}: expected {element.count} points of {dtype.itemsize} bytes, got {have} bytes: "
            "the file ends early."
        )
    return element.count, partial(_ply_rows, path, header, dtype)


def array_points(path: Path) -> Piece:
    """Points of an ``.npy`` or ``.npz``.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it holds no points, or is damaged.
    """
    if path.suffix.lower() == ".npy":
        table = read_npy(path, mapped=True)
        if table.ndim != 2 or table.shape[1] < 3 or table.dtype.kind not in "iuf":
            raise FileFormatError(
                f"{path}: expected points of at least 3 columns, got {table.dtype} of shape "
                f"{table.shape}."
            )
        return len(table), lambda start, end: RawScan(
            where=path, points=np.asarray(table[start:end, :3], np.float64)
        )
    name = next((name for name in _POSITIONS if name in npz_names(path)), _POSITIONS[0])
    optional = (*_LABELS, "intensity", "origin")
    arrays = read_npz(path, [name], optional=optional)
    points = arrays.pop(name)
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "iuf":
        raise FileFormatError(
            f"{path}: expected {name} of shape (n, 3), got {points.dtype} of shape {points.shape}."
        )
    for key in optional[:-1]:
        kinds = "iuf" if key == "intensity" else "iu"
        if key in arrays and (arrays[key].ndim != 1 or arrays[key].dtype.kind not in kinds):
            raise FileFormatError(
                f"{path}: expected {key} as a row of numbers, got {arrays[key].dtype} of shape "
                f"{arrays[key].shape}."
            )
        if key in arrays and len(arrays[key]) != len(points):
            raise FileFormatError(
                f"{path}: expected {len(points)} values in {key}, one a point, got "
                f"{len(arrays[key])}."
            )
    return len(points), partial(_array_rows, path, points, arrays)


def _array_rows(
    path: Path, points: NDArray[Any], arrays: Mapping[str, NDArray[Any]], start: int, end: int
) -> RawScan:
    return RawScan(
        where=path,
        points=points[start:end],
        intensity=arrays["intensity"][start:end] if "intensity" in arrays else None,
        labels={name: arrays[name][start:end] for name in _LABELS if name in arrays},
    )


def _ply_rows(
    path: Path, header: PlyHeader, dtype: np.dtype[np.void], start: int, end: int
) -> Mapping[str, NDArray[Any]]:
    with reading(path, "a PLY file"):
        rows = np.fromfile(path, dtype, end - start, offset=header.offset + start * dtype.itemsize)
    if len(rows) != end - start:
        raise FileFormatError(f"{path}: expected {end} points, but the file ends early.")
    return {name: rows[name] for name in dtype.names or ()}


def _raw(path: Path, columns: Mapping[str, NDArray[Any]]) -> RawScan:
    return RawScan(
        where=path,
        points=np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1),
        intensity=_first(columns, _INTENSITIES),
        labels={
            key: whole_ids(path, key, values)
            for key, names in _LABELS.items()
            if (values := _first(columns, names)) is not None
        },
    )


def _first(columns: Mapping[str, NDArray[Any]], names: tuple[str, ...]) -> NDArray[Any] | None:
    lower = {name.lower(): values for name, values in columns.items()}
    spelt = (before + name for name in names for before in _SPELLINGS)
    return next((lower[name] for name in spelt if name in lower), None)


def whole_ids(path: Path, key: str, values: NDArray[Any]) -> NDArray[np.int64]:
    """Ids that a file may have as floating-point numbers.

    Raises:
        FileFormatError: If one is no whole number.
    """
    if values.dtype.kind == "f":
        wrong = ~np.isfinite(values) | (values != np.floor(values)) | (np.abs(values) > 2**53)
        if wrong.any():
            raise FileFormatError(
                f"{path}: expected whole ids ({key}), got {float(values[np.argmax(wrong)]):g}."
            )
    return values.astype(np.int64)
