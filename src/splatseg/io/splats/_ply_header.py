"""The header of a PLY file: its elements, their columns and where the data start."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatseg.errors import FileFormatError, quoted
from splatseg.io.splats._common import check_file

MAX_HEADER = 1 << 20
"""Bytes in which the header must end; real ones have two or three thousand."""

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class PlyElement:
    """One table of a PLY file."""

    name: str
    count: int
    """Rows."""

    row: np.dtype[np.void]
    """The layout of a row, one field a property."""

    offset: int
    """Byte in the file at which its rows start."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlyHeader:
    """What a PLY file holds."""

    comments: tuple[str, ...]
    elements: dict[str, PlyElement]


def read_ply_header(path: Path) -> PlyHeader:
    """Parse the header and check that the file is as long as it promises.

    Raises:
        FileFormatError: If it is no binary PLY file, if a list property makes its length
            unknown, or if the file is longer or shorter than its header says.
        MissingFileError: If there is no such file.
    """
    size = check_file(path)
    with path.open("rb") as file:
        head = file.read(MAX_HEADER)
    if not head.startswith((b"ply\n", b"ply\r\n")):
        raise FileFormatError(f"{path}: expected a PLY file, but it does not start with 'ply'.")
    lines, start = _lines(path, head)
    order = _byte_order(path, lines)
    comments = tuple(line[8:] for line in lines if line.startswith("comment "))
    elements: dict[str, PlyElement] = {}
    for name, count, fields in _tables(path, lines, order):
        row: np.dtype[np.void] = np.dtype(fields)
        elements[name] = PlyElement(name=name, count=count, row=row, offset=start)
        start += count * row.itemsize
    if size != start:
        raise FileFormatError(
            f"{path}: expected {start} bytes as its header promises, got {size}: the file is "
            f"{'truncated' if size < start else 'longer than its counts'}."
        )
    return PlyHeader(comments=comments, elements=elements)


def _lines(path: Path, head: bytes) -> tuple[list[str], int]:
    """The header's lines and the length of the header in bytes."""
    lines: list[str] = []
    at = 0
    while (end := head.find(b"\n", at)) >= 0:
        line = head[at:end].decode("latin-1").strip()
        at = end + 1
        if line == "end_header":
            return lines, at
        lines.append(line)
    raise FileFormatError(f"{path}: expected a PLY header that ends with 'end_header', got none.")


def _byte_order(path: Path, lines: list[str]) -> str:
    """The NumPy sign of the file's byte order."""
    formats = [line.split()[1:] for line in lines if line.startswith("format ")]
    match formats:
        case [["binary_little_endian", _]]:
            return "<"
        case [["binary_big_endian", _]]:
            return ">"
        case [["ascii", _]]:
            raise FileFormatError(
                f"{path}: expected a binary PLY file, got an ASCII one; convert it first."
            )
        case _:
            raise FileFormatError(
                f"{path}: expected one PLY line 'format binary_little_endian 1.0', "
                f"got {len(formats)} format lines that say {quoted(formats)}."
            )


def _tables(
    path: Path, lines: list[str], order: str
) -> list[tuple[str, int, list[tuple[str, str]]]]:
    """Name, count and fields of each element, in file order."""
    tables: list[tuple[str, int, list[tuple[str, str]]]] = []
    elements: set[str] = set()
    properties: set[str] = set()
    for line in lines:
        match line.split():
            case ["element", name, count] if count.isdecimal() and len(count) < 16:
                if name in elements:
                    raise FileFormatError(f"{path}: the PLY element {quoted(name)} stands twice.")
                elements.add(name)
                properties = set()
                tables.append((name, int(count), []))
            case ["property", "list", *_] if tables:
                raise FileFormatError(
                    f"{path}: expected Gaussians, got a PLY file with the list property "
                    f"{quoted(line.split()[-1])} in its element {quoted(tables[-1][0])}: a mesh."
                )
            case ["property", kind, name] if tables and kind in _TYPES:
                if name in properties:
                    raise FileFormatError(f"{path}: the PLY property {quoted(name)} stands twice.")
                properties.add(name)
                tables[-1][2].append((name, order + _TYPES[kind]))
            case ["element" | "property", *_]:
                raise FileFormatError(f"{path}: cannot read the PLY header line {quoted(line)}.")
            case _:
                pass  # comments, obj_info, format
    return tables
