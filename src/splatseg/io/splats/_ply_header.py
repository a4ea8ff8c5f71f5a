"""The header of a PLY file: its elements, their columns and where the data start."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatseg.errors import FileFormatError, quoted, reason
from splatseg.io.ply import end_of_rows
from splatseg.io.splats._rows import blocks, check_file
from splatseg.io.text_numbers import number_table

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
    """The layout of a row, one field a property that is a number."""

    offset: int
    """Byte in the file at which its rows start; in an ASCII file the row, from its first."""

    lists: tuple[str, ...] = ()
    """Properties that are lists. In a binary file the header ends with the element that has them,
    unless that of the Gaussians is still to come."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlyHeader:
    """What a PLY file holds."""

    comments: tuple[str, ...]
    elements: dict[str, PlyElement]

    start: int
    """Byte at which the header ends."""

    ascii: bool
    """Whether rows are lines of text."""


def read_ply_header(path: Path) -> PlyHeader:
    """Parse the header and check that the file is as long as it promises.

    Raises:
        FileFormatError: If it is no PLY file, or the file is longer or shorter than its header
            says.
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
    at, ascii, lists = start if order else 0, not order, ()
    for name, count, fields, lists in _tables(path, lines, order):
        row: np.dtype[np.void] = np.dtype(fields)
        elements[name] = PlyElement(name=name, count=count, row=row, offset=at, lists=lists)
        if lists and not ascii:
            if "vertex" in elements:
                break
            at, lists = end_of_rows(path, name), ()
            continue
        at += (count if fields or lists else 0) if ascii else count * row.itemsize
    # A value takes a digit and what parts it from the next, a list its length.
    least = sum(
        2 * one.count * len((*(one.row.names or ()), *one.lists)) for one in elements.values()
    )
    if ascii and size - start < least - 1:
        raise FileFormatError(
            f"{path}: expected lines of values of at least {least - 1} bytes, got {size - start}: "
            "the file is truncated."
        )
    if not ascii and (size < at or (size > at and not lists)):
        raise FileFormatError(
            f"{path}: expected {at} bytes as its header promises, got {size}: the file is "
            f"{'truncated' if size < at else 'longer than its counts'}."
        )
    return PlyHeader(comments=comments, elements=elements, start=start, ascii=ascii)


def read_rows(
    path: Path, header: PlyHeader, element: PlyElement, size: int
) -> Iterator[tuple[slice, np.ndarray]]:
    """The rows of an element without lists, at most `size` at once.

    Raises:
        FileFormatError: If lines of an ASCII file are fewer or more than its header says, or one
            is not the numbers of a row.
    """
    if header.ascii:
        yield from _text_rows(path, header, element, size)
        return
    with path.open("rb") as file:
        file.seek(element.offset)
        for part in blocks(element.count, size):
            yield part, np.fromfile(file, element.row, part.stop - part.start)


def _text_rows(
    path: Path, header: PlyHeader, element: PlyElement, size: int
) -> Iterator[tuple[slice, np.ndarray]]:
    names = element.row.names or ()
    total = sum(one.count for one in header.elements.values() if one.row.names or one.lists)
    with path.open("rb") as file:
        file.seek(header.start)
        lines = (line for line in file if not line.isspace())
        before = sum(1 for _ in itertools.islice(lines, element.offset))
        if before < element.offset:
            raise FileFormatError(f"{path}: expected {total} lines of values, got fewer.")
        for part in blocks(element.count, size):
            wanted = part.stop - part.start
            try:
                table = number_table(list(itertools.islice(lines, wanted)), len(names))
            except ValueError as error:
                raise FileFormatError(
                    f"{path}: expected lines of {len(names)} numbers for the element "
                    f"{quoted(element.name)} ({reason(error)})."
                ) from error
            if len(table) < wanted:
                raise FileFormatError(
                    f"{path}: expected {total} lines of values, the file ends at "
                    f"{element.offset + part.start + len(table)}: it is truncated."
                )
            yield part, _typed(path, table, element)
        after = sum(1 for _ in lines)
    if element.offset + element.count + after != total:
        raise FileFormatError(
            f"{path}: expected {total} lines of values, got "
            f"{element.offset + element.count + after}."
        )


def _typed(path: Path, table: NDArray[np.float64], element: PlyElement) -> np.ndarray:
    """Numbers of text in the types that their columns have."""
    rows = np.empty(len(table), element.row)
    for i, name in enumerate(element.row.names or ()):
        kind = element.row[name]
        if kind.kind != "f":
            limits = np.iinfo(kind)
            whole = (table[:, i] >= limits.min) & (table[:, i] <= limits.max)
            if not (whole & (table[:, i] == np.floor(table[:, i]))).all():
                raise FileFormatError(
                    f"{path}: expected {kind} in the PLY column {quoted(name)}, got other numbers."
                )
        with np.errstate(over="ignore"):
            rows[name] = table[:, i]
    return rows


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
    """The NumPy sign of the file's byte order; nothing for ASCII."""
    formats = [line.split()[1:] for line in lines if line.startswith("format ")]
    match formats:
        case [["binary_little_endian", _]]:
            return "<"
        case [["binary_big_endian", _]]:
            return ">"
        case [["ascii", _]]:
            return ""
        case _:
            raise FileFormatError(
                f"{path}: expected one PLY line 'format binary_little_endian 1.0', "
                f"got {len(formats)} format lines that say {quoted(formats)}."
            )


def _tables(
    path: Path, lines: list[str], order: str
) -> list[tuple[str, int, list[tuple[str, str]], tuple[str, ...]]]:
    """Name, count, fields of numbers and names of lists of each element, in file order."""
    tables: list[tuple[str, int, list[tuple[str, str]], tuple[str, ...]]] = []
    elements: set[str] = set()
    properties: set[str] = set()
    for line in lines:
        match line.split():
            case ["element", name, count] if count.isdecimal() and len(count) < 16:
                if name in elements:
                    raise FileFormatError(f"{path}: the PLY element {quoted(name)} stands twice.")
                elements.add(name)
                properties = set()
                tables.append((name, int(count), [], ()))
            case ["property", "list", _, _, name] if tables:
                element, count, fields, lists = tables[-1]
                tables[-1] = (element, count, fields, (*lists, name))
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
