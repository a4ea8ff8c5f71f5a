"""Start points from PLY files: x y z and, where they are there, colours."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import PointCloud
from splatseg.core.sh import SH_C0
from splatseg.errors import FileFormatError, quoted, reason
from splatseg.io.foreign import read_bytes, reading

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_HEADER_LIMIT = 65536
_COUNT = re.compile("[0-9]{1,15}")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Element:
    name: str
    count: int
    fields: tuple[tuple[str, str], ...]
    """Name and NumPy type code of each scalar property."""


def point_cloud(points: NDArray[np.floating], colours: NDArray[np.uint8] | None) -> PointCloud:
    """A point cloud of NumPy arrays."""
    return PointCloud(
        points=torch.from_numpy(np.ascontiguousarray(points, np.float32)),
        colours=None if colours is None else torch.from_numpy(np.ascontiguousarray(colours)),
    )


def ply_holds_splats(path: Path) -> bool:
    """Whether a PLY file holds Gaussians (a column f_dc_0) and not bare points."""
    _, elements, _ = _header(path)
    return any(name == "f_dc_0" for element in elements for name, _ in element.fields)


def read_ply_points(path: Path) -> PointCloud:
    """Points and colours of the element ``vertex`` of a PLY file, ASCII or binary.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is not a PLY of points, ends early, or holds NaN or infinity.
    """
    order, elements, offset = _header(path)
    if not elements or elements[0].name != "vertex":
        raise FileFormatError(f"{path}: expected a PLY whose first element is vertex.")
    vertex = elements[0]
    names = [name for name, _ in vertex.fields]
    if not {"x", "y", "z"} <= set(names) or len(set(names)) != len(names):
        raise FileFormatError(
            f"{path}: expected vertices with x, y and z, got {quoted(', '.join(names))}."
        )
    rows = _rows(path, order, vertex, offset)
    points = np.stack([rows[axis] for axis in "xyz"], axis=1)
    if not np.isfinite(points).all():
        bad = int((~np.isfinite(points)).any(axis=1).sum())
        raise FileFormatError(f"{path}: {bad} of {len(points)} points are not finite.")
    return point_cloud(points, _colours(rows, names))


def _header(path: Path) -> tuple[str, list[_Element], int]:
    with reading(path, "a PLY file"), path.open("rb") as file:
        head = file.read(_HEADER_LIMIT)
    end = head.find(b"end_header")
    newline = head.find(b"\n", end)
    if not head.startswith(b"ply") or end < 0 or newline < 0:
        raise FileFormatError(f"{path}: expected a PLY file, but its header is not one.")
    order, elements = "", list[_Element]()
    for line in head[:end].decode("ascii", "replace").splitlines()[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) == 3 and words[1] in _ORDERS:
            order = words[1]
        elif (
            words[0] == "element"
            and len(words) == 3
            and words[2].isdecimal()
            and len(words[2]) < 16
        ):
            elements.append(_Element(name=words[1], count=int(words[2]), fields=()))
        elif words[0] == "property" and elements:
            last = elements[-1]
            if len(words) == 3 and words[1] in _TYPES:
                fields = (*last.fields, (words[2], _TYPES[words[1]]))
                elements[-1] = _Element(name=last.name, count=last.count, fields=fields)
            elif last.name == "vertex" or len(words) != 5:
                raise FileFormatError(f"{path}: PLY property {quoted(line)} is not understood.")
        else:
            raise FileFormatError(f"{path}: PLY header line {quoted(line)} is not understood.")
    if not order:
        raise FileFormatError(f"{path}: expected a PLY file that names its format.")
    return order, elements, newline + 1


def _rows(path: Path, order: str, vertex: _Element, offset: int) -> NDArray[np.void]:
    dtype = np.dtype([(name, _ORDERS[order] + code) for name, code in vertex.fields])
    if order == "ascii":
        return _ascii_rows(path, vertex, offset)
    have = path.stat().st_size - offset
    if have < dtype.itemsize * vertex.count:
        raise FileFormatError(
            f"{path}: expected {vertex.count} points of {dtype.itemsize} bytes, "
            f"got {have} bytes: the file ends early."
        )
    with reading(path, "a PLY file"):
        return np.fromfile(path, dtype, vertex.count, offset=offset)


def _ascii_rows(path: Path, vertex: _Element, offset: int) -> NDArray[np.void]:
    dtype = np.dtype([(name, "f8" if code[0] == "f" else code) for name, code in vertex.fields])
    lines = read_bytes(path, "a PLY file")[offset:].split(b"\n")[: vertex.count]
    if len(lines) < vertex.count:
        raise FileFormatError(f"{path}: expected {vertex.count} rows, got {len(lines)}.")
    rows = np.empty(vertex.count, dtype)
    try:
        values = [tuple(float(word) for word in line.split()) for line in lines]
        if len(values) != vertex.count or any(len(row) != len(vertex.fields) for row in values):
            raise ValueError("a row is missing or has the wrong number of values")
        rows[:] = values
    except (ValueError, OverflowError) as error:
        raise FileFormatError(
            f"{path}: expected {vertex.count} rows of {len(vertex.fields)} numbers "
            f"({reason(error)})."
        ) from error
    return rows


def _colours(rows: NDArray[np.void], names: list[str]) -> NDArray[np.uint8] | None:
    for triple in (
        ("red", "green", "blue"),
        ("r", "g", "b"),
        ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ):
        if set(triple) <= set(names):
            values = np.stack([rows[name] for name in triple], axis=1)
            if np.issubdtype(values.dtype, np.floating):
                values = np.clip(np.nan_to_num(values), 0, 1) * 255 + 0.5
            return np.clip(values, 0, 255).astype(np.uint8)
    if {"f_dc_0", "f_dc_1", "f_dc_2"} <= set(names):
        sh = np.stack([rows[f"f_dc_{i}"] for i in range(3)], axis=1)
        return (np.clip(0.5 + SH_C0 * np.nan_to_num(sh), 0, 1) * 255 + 0.5).astype(np.uint8)
    return None
