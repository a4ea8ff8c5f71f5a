"""PLY files of any kind: a header, and tables whose columns are numbers or lists of numbers.

    ply                                  rows of an element follow each other in the order of the
    format binary_little_endian 1.0      header, big or little endian, or one a line in ASCII
    element vertex 3
    property float x
    ...
    element face 1
    property list uchar int vertex_indices
    end_header

Splat files have a stricter reader of their own, `splatseg.io.splats`.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg.errors import FileFormatError, quoted, reason
from splatseg.io.foreign import read_bytes, reading
from splatseg.io.text_numbers import number_table

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_HEADER_LIMIT = 65536
_KIND = "a PLY file"


@dataclass(frozen=True, slots=True, kw_only=True)
class PlyProperty:
    """One column."""

    name: str
    code: str
    """NumPy's code of its numbers, without the byte order."""

    count_code: str | None = None
    """That of the length before each list; None where a row has one number."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlyElement:
    """One table as the header announces it."""

    name: str
    count: int
    """Rows."""

    properties: tuple[PlyProperty, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class PlyHeader:
    """What a PLY file holds."""

    order: str
    """NumPy's sign of the byte order; nothing for ASCII."""

    elements: tuple[PlyElement, ...]
    offset: int
    """Byte at which the rows of the first element start."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlyLists:
    """A column of lists: row i has ``values[starts[i]:starts[i + 1]]``."""

    starts: NDArray[np.int64]
    values: NDArray[Any]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlyTable:
    """The rows of one element, column by column."""

    count: int
    numbers: Mapping[str, NDArray[Any]]
    """Columns of one number a row, in the file's type; in ASCII files of float as float64."""

    lists: Mapping[str, PlyLists] = field(default_factory=dict[str, PlyLists])


def read_ply_header(path: Path) -> PlyHeader:
    """The elements and columns of a PLY file.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no PLY file, or its header says what PLY has no word for.
    """
    with reading(path, _KIND), path.open("rb") as file:
        head = file.read(_HEADER_LIMIT)
    end = head.find(b"end_header")
    newline = head.find(b"\n", end)
    if not head.startswith(b"ply") or end < 0 or newline < 0:
        raise FileFormatError(f"{path}: expected a PLY file, but its header is not one.")
    order: str | None = None
    elements: list[PlyElement] = []
    for line in head[:end].decode("ascii", "replace").splitlines()[1:]:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", word, _] if word in _ORDERS:
                order = _ORDERS[word]
            case ["element", name, count] if count.isdecimal() and len(count) < 16:
                if any(one.name == name for one in elements):
                    raise FileFormatError(f"{path}: the PLY element {quoted(name)} stands twice.")
                elements.append(PlyElement(name=name, count=int(count)))
            case ["property", *words] if elements:
                elements[-1] = _with_property(path, elements[-1], words, line)
            case _:
                raise FileFormatError(f"{path}: PLY header line {quoted(line)} is not understood.")
    if order is None:
        raise FileFormatError(f"{path}: expected a PLY file that names its format.")
    return PlyHeader(order=order, elements=tuple(elements), offset=newline + 1)


def _with_property(path: Path, element: PlyElement, words: list[str], line: str) -> PlyElement:
    match words:
        case [kind, name] if kind in _TYPES:
            added = PlyProperty(name=name, code=_TYPES[kind])
        case ["list", length, kind, name] if (
            kind in _TYPES and length in _TYPES and _TYPES[length][0] != "f"
        ):
            added = PlyProperty(name=name, code=_TYPES[kind], count_code=_TYPES[length])
        case _:
            raise FileFormatError(f"{path}: PLY property {quoted(line)} is not understood.")
    if any(one.name == added.name for one in element.properties):
        raise FileFormatError(f"{path}: the PLY property {quoted(added.name)} stands twice.")
    return PlyElement(
        name=element.name, count=element.count, properties=(*element.properties, added)
    )


def read_ply_tables(path: Path, header: PlyHeader, names: Collection[str]) -> dict[str, PlyTable]:
    """The tables of these elements, those that the file has.

    Nothing behind the last of them is read.

    Raises:
        FileFormatError: If the file ends early, or a row is not what the header says.
    """
    found: dict[str, PlyTable] = {}
    wanted = [element.name for element in header.elements if element.name in names]
    reader = _TextRows(path, header) if not header.order else _BinaryRows(path, header)
    for element in header.elements:
        if len(found) == len(wanted):
            break
        table = reader.next(element)
        if element.name in names:
            found[element.name] = table
    return found


def end_of_rows(path: Path, name: str) -> int:
    """Byte at which the rows of an element of a binary file end, whose lists must be gone through.

    Raises:
        FileFormatError: If the file ends early, or there is no such element.
    """
    header = read_ply_header(path)
    reader = _BinaryRows(path, header)
    for element in header.elements:
        reader.next(element)
        if element.name == name:
            return reader.at
    raise FileFormatError(f"{path}: expected a PLY element {quoted(name)}, got none.")


class _BinaryRows:
    """Goes through the elements of a binary file."""

    def __init__(self, path: Path, header: PlyHeader) -> None:
        self._path = path
        self._order = header.order
        self.at = header.offset
        with reading(path, _KIND):
            self._size = path.stat().st_size

    def next(self, element: PlyElement) -> PlyTable:
        """The table of the next element."""
        lengths = self._lengths_of_first(element)
        dtype = self._row(element, lengths)
        lists = [one for one in element.properties if one.count_code is not None]
        if lists and dtype.itemsize * element.count > self._size - self.at:
            return self._walked(element)
        rows = self._read(element, dtype)
        for i, one in enumerate(lists):
            if bool((rows[f"n {one.name}"] != lengths[i]).any()):
                return self._walked(element)
        self.at += dtype.itemsize * element.count
        return PlyTable(
            count=element.count,
            numbers={p.name: rows[p.name] for p in element.properties if p.count_code is None},
            lists={
                one.name: PlyLists(
                    starts=np.arange(element.count + 1, dtype=np.int64) * lengths[i],
                    values=rows[one.name].reshape(-1),
                )
                for i, one in enumerate(lists)
            },
        )

    def _lengths_of_first(self, element: PlyElement) -> list[int]:
        """Lengths of the lists of the first row; most files have them in all rows."""
        lengths: list[int] = []
        at = self.at
        if not element.count:
            return [0 for one in element.properties if one.count_code is not None]
        for one in element.properties:
            size = np.dtype(one.code).itemsize
            if one.count_code is None:
                at += size
                continue
            width = np.dtype(one.count_code).itemsize
            lengths.append(self._length(at, one.count_code))
            at += width + size * lengths[-1]
        return lengths

    def _length(self, at: int, code: str) -> int:
        width = np.dtype(code).itemsize
        with reading(self._path, _KIND), self._path.open("rb") as file:
            file.seek(at)
            raw = file.read(width)
        if len(raw) < width:
            raise FileFormatError(f"{self._path}: expected rows of lists, the file ends early.")
        length = int(np.frombuffer(raw, self._order + code)[0])
        if not 0 <= length <= self._size - at:
            raise FileFormatError(
                f"{self._path}: expected a list that fits the file, got one of {length} numbers."
            )
        return length

    def _row(self, element: PlyElement, lengths: list[int]) -> np.dtype[np.void]:
        fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
        left = iter(lengths)
        for one in element.properties:
            if one.count_code is None:
                fields.append((one.name, self._order + one.code))
            else:
                fields.append((f"n {one.name}", self._order + one.count_code))
                fields.append((one.name, self._order + one.code, (next(left),)))
        return np.dtype(fields)

    def _read(self, element: PlyElement, dtype: np.dtype[np.void]) -> NDArray[np.void]:
        have = self._size - self.at
        if have < dtype.itemsize * element.count:
            raise FileFormatError(
                f"{self._path}: expected {element.count} rows of {element.name} of "
                f"{dtype.itemsize} bytes, got {have} bytes: the file ends early."
            )
        with reading(self._path, _KIND):
            return np.fromfile(self._path, dtype, element.count, offset=self.at)

    def _walked(self, element: PlyElement) -> PlyTable:
        """The table where lists differ in length: row by row."""
        rest = read_bytes(self._path, _KIND)[self.at :]
        at = 0
        numbers: dict[str, list[float]] = {}
        lists: dict[str, tuple[list[int], list[NDArray[Any]]]] = {}
        for one in element.properties:
            if one.count_code is None:
                numbers[one.name] = []
            else:
                lists[one.name] = ([0], [])
        for _ in range(element.count):
            for one in element.properties:
                count = 1
                if one.count_code is not None:
                    (count,), at = self._values(rest, at, one.count_code, 1)
                values, at = self._values(rest, at, one.code, int(count))
                if one.count_code is None:
                    numbers[one.name].append(values[0])
                else:
                    starts, parts = lists[one.name]
                    starts.append(starts[-1] + int(count))
                    parts.append(values)
        self.at += at
        codes = {one.name: one.code for one in element.properties}
        return PlyTable(
            count=element.count,
            numbers={name: np.array(one, codes[name]) for name, one in numbers.items()},
            lists={
                name: PlyLists(
                    starts=np.array(starts, np.int64),
                    values=np.concatenate([np.zeros(0, codes[name]), *parts]).astype(codes[name]),
                )
                for name, (starts, parts) in lists.items()
            },
        )

    def _values(self, rest: bytes, at: int, code: str, count: int) -> tuple[NDArray[Any], int]:
        end = at + np.dtype(code).itemsize * count
        if count < 0 or end > len(rest):
            raise FileFormatError(f"{self._path}: expected lists that fit the file, got others.")
        return np.frombuffer(rest, self._order + code, count, offset=at), end


class _TextRows:
    """Goes through the elements of an ASCII file, one row a line."""

    def __init__(self, path: Path, header: PlyHeader) -> None:
        self._path = path
        lines = read_bytes(path, _KIND)[header.offset :].split(b"\n")
        self._lines = [line for line in lines if line and not line.isspace()]
        self._at = 0

    def next(self, element: PlyElement) -> PlyTable:
        """The table of the next element."""
        lines = self._lines[self._at : self._at + element.count]
        if len(lines) < element.count:
            raise FileFormatError(f"{self._path}: expected {element.count} rows, got {len(lines)}.")
        self._at += element.count
        try:
            return _parsed(element, lines)
        except (ValueError, OverflowError) as error:
            raise FileFormatError(
                f"{self._path}: expected {element.count} rows of {len(element.properties)} numbers "
                f"({reason(error)})."
            ) from error


def _parsed(element: PlyElement, lines: list[bytes]) -> PlyTable:
    if all(one.count_code is None for one in element.properties):
        table = number_table(lines, len(element.properties))
        numbers: dict[str, NDArray[Any]] = {}
        for one, values in zip(element.properties, table.T, strict=True):
            numbers[one.name] = values.copy() if one.code[0] == "f" else _whole(values, one)
        return PlyTable(count=element.count, numbers=numbers)
    return _parsed_lists(element, lines)


def _parsed_lists(element: PlyElement, lines: list[bytes]) -> PlyTable:
    columns: list[list[float]] = [[] for _ in element.properties]
    starts = [[0] for _ in element.properties]
    for line in lines:
        words = [float(word) for word in line.split()]
        at = 0
        for i, one in enumerate(element.properties):
            count = 1
            if one.count_code is not None:
                count = int(words[at]) if at < len(words) else -1
                at += 1
            if not 0 <= count <= len(words) - at:
                raise ValueError("a row is missing or has the wrong number of values")
            columns[i] += words[at : at + count]
            starts[i].append(len(columns[i]))
            at += count
        if at != len(words):
            raise ValueError("a row is missing or has the wrong number of values")
    numbers: dict[str, NDArray[Any]] = {}
    lists: dict[str, PlyLists] = {}
    for one, column, ends in zip(element.properties, columns, starts, strict=True):
        values = np.array(column, np.float64)
        if one.code[0] != "f":
            values = _whole(values, one)
        if one.count_code is None:
            numbers[one.name] = values
        else:
            lists[one.name] = PlyLists(starts=np.array(ends, np.int64), values=values)
    return PlyTable(count=element.count, numbers=numbers, lists=lists)


def _whole(values: NDArray[np.float64], column: PlyProperty) -> NDArray[Any]:
    kind = np.iinfo(np.dtype(column.code))
    if not ((values >= kind.min) & (values <= kind.max) & (values == np.floor(values))).all():
        raise ValueError(f"{quoted(column.name)} has a value that its type has not")
    return values.astype(column.code)
