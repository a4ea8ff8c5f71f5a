"""Vertices of PLY files of others: the columns of the element ``vertex``, ASCII or binary."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

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


@dataclass(frozen=True, slots=True, kw_only=True)
class _Element:
    name: str
    count: int
    fields: tuple[tuple[str, str], ...]
    """Name and NumPy type code of each scalar property."""


def ply_columns(path: Path) -> tuple[str, ...]:
    """Names of the columns of all elements of a PLY file, from its header alone.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If its header is not one of a PLY file.
    """
    _, elements, _ = _header(path)
    return tuple(name for element in elements for name, _ in element.fields)


def read_ply_vertices(path: Path) -> NDArray[np.void]:
    """Rows of the element ``vertex``, one field a property; x, y and z are among them.

    What follows the vertices, such as faces, is not read.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no PLY whose first element is ``vertex`` with x, y and z, or it
            ends early.
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
    return _rows(path, order, vertex, offset)


def vertex_positions(path: Path, rows: NDArray[np.void]) -> NDArray[np.floating]:
    """Positions (n, 3) of rows of `read_ply_vertices`.

    Raises:
        FileFormatError: If one is NaN or infinite.
    """
    points = np.stack([rows[axis] for axis in "xyz"], axis=1)
    if not np.isfinite(points).all():
        bad = int((~np.isfinite(points)).any(axis=1).sum())
        raise FileFormatError(f"{path}: {bad} of {len(points)} points are not finite.")
    return points


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
