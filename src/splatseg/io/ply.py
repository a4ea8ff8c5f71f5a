"""PLY files: a header, and tables whose columns are numbers or lists of numbers.

ply                                  rows of an element follow each other in the order of the
format binary_little_endian 1.0      header, big or little endian, or one a line in ASCII
element vertex 3
property float x
...
element face 1
property list uchar int vertex_indices
end_header
"""

from collections.abc import Collection, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg.errors import FileFormatError, quoted, reason
from splatseg.io.foreign import expect, reading
from splatseg.io.text_numbers import number_table

MAX_HEADER = 1 << 20
"""Bytes in which the header must end; real ones have two or three thousand."""

_TEXT_ROWS = 1 << 14
"""Rows of an ASCII file that are parsed together."""

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_WRITTEN = {_TYPES[name]: name for name in ("char", "uchar", "short", "ushort", "int", "uint")} | {
    "f4": "float",
    "f8": "double",
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
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

    @property
    def names(self) -> tuple[str, ...]:
        """Columns of numbers."""
        return tuple(one.name for one in self.properties if one.count_code is None)

    @property
    def lists(self) -> tuple[str, ...]:
        """Columns of lists."""
        return tuple(one.name for one in self.properties if one.count_code is not None)

    def dtype(self, order: str = "=") -> np.dtype[np.void]:
        """A row of an element without lists, in a byte order."""
        return np.dtype([(one.name, (order or "=") + one.code) for one in self.properties])


@dataclass(frozen=True, slots=True, kw_only=True)
class PlyHeader:
    """What a PLY file holds."""

    order: str
    """NumPy's sign of the byte order; nothing for ASCII."""

    elements: tuple[PlyElement, ...]
    offset: int
    """Byte at which the rows of the first element start."""

    comments: tuple[str, ...] = ()

    def element(self, name: str) -> PlyElement | None:
        """An element by its name, None where there is none."""
        return next((one for one in self.elements if one.name == name), None)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlyLists:
    """A column of lists: row i has ``values[starts[i]:starts[i + 1]]``."""

    starts: NDArray[np.int64]
    values: NDArray[Any]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlyTable:
    """The rows of one element."""

    count: int
    numbers: Mapping[str, NDArray[Any]]
    """Columns of numbers by name, of binary files views of the file; real ones of text may be
    float64, others have the type that the header says."""

    lists: Mapping[str, PlyLists] = field(default_factory=dict[str, PlyLists])


def read_ply_header(path: Path) -> PlyHeader:
    """The elements and columns of a PLY file.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no PLY file, or its header says what PLY has no word for.
    """
    with reading(path, _KIND), path.open("rb") as file:
        head = file.read(MAX_HEADER)
    expect(head.startswith((b"ply\n", b"ply\r\n")), path, "a PLY file, which starts with 'ply'")
    lines, offset = _header_lines(path, head)
    orders: list[str] = []
    comments: list[str] = []
    elements: dict[str, tuple[int, dict[str, PlyProperty]]] = {}
    last: dict[str, PlyProperty] | None = None
    for line in lines[1:]:
        match line.split():
            case [] | ["obj_info", *_]:
                pass
            case ["comment", *_]:
                comments.append(line.strip()[8:])
            case ["format", word, _] if word in _ORDERS:
                orders.append(_ORDERS[word])
            case ["element", name, count] if count.isdecimal() and len(count) < 16:
                if name in elements:
                    raise FileFormatError(f"{path}: the PLY element {quoted(name)} stands twice.")
                elements[name] = int(count), (last := {})
            case ["property", *words] if last is not None:
                added = _property(path, words, line)
                if added.name in last:
                    raise FileFormatError(
                        f"{path}: the PLY property {quoted(added.name)} stands twice."
                    )
                last[added.name] = added
            case _:
                raise FileFormatError(f"{path}: cannot read the PLY header line {quoted(line)}.")
    expect(len(orders) == 1, path, f"one PLY line of the format, got {len(orders)}")
    return PlyHeader(
        order=orders[0],
        elements=tuple(
            PlyElement(name=name, count=count, properties=tuple(properties.values()))
            for name, (count, properties) in elements.items()
        ),
        offset=offset,
        comments=tuple(comments),
    )


def _header_lines(path: Path, head: bytes) -> tuple[list[str], int]:
    """The header's lines without the last, and its length in bytes."""
    lines: list[str] = []
    at = 0
    while (end := head.find(b"\n", at)) >= 0:
        line = head[at:end].decode("latin-1").strip()
        at = end + 1
        if line == "end_header":
            return lines, at
        lines.append(line)
    raise FileFormatError(f"{path}: expected a PLY header that ends with 'end_header', got none.")


def _property(path: Path, words: list[str], line: str) -> PlyProperty:
    match words:
        case [kind, name] if kind in _TYPES:
            return PlyProperty(name=name, code=_TYPES[kind])
        case ["list", length, kind, name] if (
            kind in _TYPES and length in _TYPES and _TYPES[length][0] != "f"
        ):
            return PlyProperty(name=name, code=_TYPES[kind], count_code=_TYPES[length])
        case _:
            raise FileFormatError(f"{path}: cannot read the PLY header line {quoted(line)}.")


def ply_header(
    tables: Sequence[tuple[str, int, Sequence[tuple[str, str]]]], comments: Sequence[str] = ()
) -> bytes:
    """The header of a little-endian file: name, rows, and columns (name, NumPy's code) of each."""
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {one}" for one in comments)]
    for name, count, columns in tables:
        lines.append(f"element {name} {count}")
        lines += [f"property {_WRITTEN[code[-2:]]} {column}" for column, code in columns]
    return "\n".join([*lines, "end_header\n"]).encode("ascii")


def ply_columns(path: Path) -> tuple[str, ...]:
    """Names of the columns of all elements of a PLY file, from its header alone.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If its header is not one of a PLY file.
    """
    elements = read_ply_header(path).elements
    return tuple(one.name for element in elements for one in element.properties)


def read_ply_tables(
    path: Path, header: PlyHeader, names: Collection[str], *, whole: bool = False
) -> dict[str, PlyTable]:
    """The tables of these elements, those that the file has.

    Args:
        path: The file.
        header: What `read_ply_header` gives.
        names: The elements.
        whole: Go through what is behind them too, up to an element that has lists: the file must
            be as long as its header says. Numbers of text have the types of the header then.

    Raises:
        FileFormatError: If the file ends early, or a row is not what the header says.
    """
    found: dict[str, PlyTable] = {}
    wanted = [element.name for element in header.elements if element.name in names]
    reader = _BinaryRows(path, header) if header.order else _TextRows(path, header, declared=whole)
    for element in header.elements:
        if len(found) == len(wanted) and (element.lists or not whole):
            return found
        table = reader.next(element) if element.properties else PlyTable(count=0, numbers={})
        if element.name in names:
            found[element.name] = table
    left = reader.left()
    expect(not left, path, f"the end of the file after its elements, got {left} more")
    return found


def read_ply_vertices(path: Path) -> Mapping[str, NDArray[Any]]:
    """Columns of numbers of the element ``vertex``, by name; x, y and z are among them.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no PLY whose first element is ``vertex`` with x, y and z, or it
            ends early.
    """
    header = read_ply_header(path)
    vertex = [one.names for one in header.elements[:1] if one.name == "vertex"]
    names = vertex[0] if vertex else ()
    what = "a PLY whose first element is vertex with x, y and z"
    expect({"x", "y", "z"} <= set(names), path, what, ", ".join(names) or None)
    return read_ply_tables(path, header, ["vertex"])["vertex"].numbers


def vertex_positions(path: Path, columns: Mapping[str, NDArray[Any]]) -> NDArray[np.float64]:
    """Positions (n, 3) of what `read_ply_vertices` gives.

    Raises:
        FileFormatError: If one is NaN or infinite.
    """
    points = np.stack([columns[axis] for axis in "xyz"], axis=1).astype(np.float64)
    if not np.isfinite(points).all():
        bad = int((~np.isfinite(points)).any(axis=1).sum())
        raise FileFormatError(f"{path}: {bad} of {len(points)} points are not finite.")
    return points


@contextmanager
def _parsing(path: Path, expected: str, element: PlyElement) -> Generator[None]:
    """Name the element in what text that is no numbers raises."""
    try:
        yield
    except (ValueError, OverflowError) as error:
        raise FileFormatError(
            f"{path}: expected {expected} for the element {quoted(element.name)} ({reason(error)})."
        ) from error


class _BinaryRows:
    """Goes through the elements of a binary file."""

    def __init__(self, path: Path, header: PlyHeader) -> None:
        self._path = path
        self._order = header.order
        self.at = header.offset
        with reading(path, _KIND):
            self._data = np.asarray(np.memmap(path, np.uint8, "r"))

    def left(self) -> str:
        """What was not gone through."""
        more = len(self._data) - self.at
        return f"{more} bytes" if more else ""

    def next(self, element: PlyElement) -> PlyTable:
        """The table of the next element."""
        # Most files have lists of one length: that of the first row is tried for all.
        lengths = dict.fromkeys(element.lists, 0)
        if element.count and lengths:
            first, _ = self._row(element, self.at)
            lengths = {name: len(first[name]) for name in lengths}
        fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
        for one in element.properties:
            if one.count_code is None:
                fields.append((one.name, self._order + one.code))
            else:
                fields.append((f"n {one.name}", self._order + one.count_code))
                fields.append((one.name, self._order + one.code, (lengths[one.name],)))
        dtype = np.dtype(fields)
        have, needed = len(self._data) - self.at, dtype.itemsize * element.count
        if needed <= have:
            rows = self._data[self.at : self.at + needed].view(dtype)
            if all((rows[f"n {name}"] == length).all() for name, length in lengths.items()):
                self.at += needed
                starts = np.arange(element.count + 1, dtype=np.int64)
                return PlyTable(
                    count=element.count,
                    numbers={name: rows[name] for name in element.names},
                    lists={
                        name: PlyLists(starts=starts * length, values=rows[name].flatten())
                        for name, length in lengths.items()
                    },
                )
        what = f"{element.count} rows of {element.name} of {dtype.itemsize} bytes, got {have} bytes"
        expect(lengths, self._path, f"{what}: the file ends early")
        columns = _Columns(element)
        for _ in range(element.count):
            row, self.at = self._row(element, self.at)
            for i, one in enumerate(element.properties):
                columns.add(i, row[one.name].tolist())
        return columns.table()

    def _row(self, element: PlyElement, at: int) -> tuple[dict[str, NDArray[Any]], int]:
        """The numbers of each column in the row at a byte, and the byte at which it ends."""
        row: dict[str, NDArray[Any]] = {}
        for one in element.properties:
            count = 1
            if one.count_code is not None:
                (count,), at = self._values(at, one.count_code, 1)
            row[one.name], at = self._values(at, one.code, int(count))
        return row, at

    def _values(self, at: int, code: str, count: int) -> tuple[NDArray[Any], int]:
        end = at + np.dtype(code).itemsize * count
        fits = count >= 0 and end <= len(self._data)
        expect(fits, self._path, f"a list that fits the file, got one of {count} numbers")
        return np.frombuffer(self._data, self._order + code, count, offset=at), end


class _TextRows:
    """Goes through the elements of an ASCII file, one row a line, some thousands at once."""

    def __init__(self, path: Path, header: PlyHeader, *, declared: bool) -> None:
        self._path, self._declared = path, declared
        with reading(path, _KIND):
            self._bytes = path.stat().st_size - header.offset
        self._lines = _text_lines(path, header.offset)

    def left(self) -> str:
        """What was not gone through."""
        more = sum(1 for _ in self._lines)
        return f"{more} lines" if more else ""

    def next(self, element: PlyElement) -> PlyTable:
        """The table of the next element."""
        count, columns = element.count, len(element.properties)
        # A value takes a digit and what parts it from the next: memory is taken for what can be.
        have = self._bytes
        fits = have >= 2 * count * columns - 1
        expect(fits, self._path, f"{count} rows of {quoted(element.name)}, got {have} bytes")
        with _parsing(self._path, f"{count} rows of {columns} numbers", element):
            if element.lists:
                return _with_lists(element, self._rows(element, 0, count))
            types = [np.float64 if one.code[0] == "f" else one.code for one in element.properties]
            numbers = {
                name: np.empty(count, kind) for name, kind in zip(element.names, types, strict=True)
            }
            for start in range(0, count, _TEXT_ROWS):
                stop = min(start + _TEXT_ROWS, count)
                table = number_table(self._rows(element, start, stop), columns)
                with np.errstate(over="ignore"):  # beyond float32: infinite, which readers refuse
                    for one, values in zip(element.properties, table.T, strict=True):
                        numbers[one.name][start:stop] = _typed(values, one)
            return PlyTable(count=count, numbers=numbers)

    def _widens(self, column: PlyProperty) -> bool:
        """Whether it keeps what text has beyond its type, as for coordinates of a whole earth."""
        return column.code[0] == "f" and not self._declared

    def _rows(self, element: PlyElement, start: int, stop: int) -> list[bytes]:
        lines = list(islice(self._lines, stop - start))
        what = f"{element.count} rows of {quoted(element.name)}, got {start + len(lines)}"
        expect(len(lines) == stop - start, self._path, what)
        return lines


def _text_lines(path: Path, offset: int) -> Iterator[bytes]:
    with path.open("rb") as file:
        file.seek(offset)
        yield from (line for line in file if not line.isspace())


def _with_lists(element: PlyElement, lines: Sequence[bytes]) -> PlyTable:
    rows = _Columns(element)
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
            rows.add(i, words[at : at + count])
            at += count
        if at != len(words):
            raise ValueError("a row is missing or has the wrong number of values")
    return rows.table()


class _Columns:
    """Columns of an element with lists, gathered row by row."""

    def __init__(self, element: PlyElement) -> None:
        self._element = element
        self._values: list[list[float]] = [[] for _ in element.properties]
        self._starts = [[0] for _ in element.properties]

    def add(self, column: int, values: Sequence[float]) -> None:
        """The number, or the list, of the next row."""
        self._values[column] += values
        self._starts[column].append(len(self._values[column]))

    def table(self) -> PlyTable:
        """All rows."""
        numbers: dict[str, NDArray[Any]] = {}
        lists: dict[str, PlyLists] = {}
        parts = zip(self._element.properties, self._values, self._starts, strict=True)
        for one, column, starts in parts:
            values = _typed(np.array(column, np.float64), one)
            if one.count_code is None:
                numbers[one.name] = values
            else:
                lists[one.name] = PlyLists(starts=np.array(starts, np.int64), values=values)
        return PlyTable(count=self._element.count, numbers=numbers, lists=lists)


def _typed(values: NDArray[np.float64], column: PlyProperty) -> NDArray[Any]:
    """Numbers of text in the type of their column; real ones stay float64."""
    if column.code[0] == "f":
        return values
    kind = np.iinfo(np.dtype(column.code))
    if not ((values >= kind.min) & (values <= kind.max) & (values == np.floor(values))).all():
        raise ValueError(f"{quoted(column.name)} has a value that its type has not")
    return values.astype(column.code)
