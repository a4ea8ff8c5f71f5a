"""Rows of Parquet files, read a few at a time and written; needs pyarrow.

A file says itself how much its columns unpack to and how many values they hold; both are held
against `io.limits` before anything of them is unpacked. pyarrow tells them too, but where a footer
is damaged that call ends the whole process (26.0: an exception of C++ that nothing catches), so the
footer is read here. It is a Thrift struct in the compact protocol; what the numbers of fields mean
is in parquet.thrift of the format's own pages:

    FileMetaData.4 row_groups, RowGroup.1 columns, ColumnChunk.3 meta_data,
    ColumnMetaData.3 path_in_schema, .5 num_values, .6 total_uncompressed_size
"""

import struct
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from splatseg.errors import MissingFileError, import_package, reason
from splatseg.io.foreign import expect, is_file, malformed, reading
from splatseg.io.limits import check_unpacked

Row = Mapping[str, Any]
"""Values by column: numbers, text, bytes, arrays of one axis for lists, None for nothing."""

_KIND = "a Parquet file"
_WIDEST = 8
_MAGIC = b"PAR1"
_TAIL = struct.Struct("<I4s")
_DEEPEST = 16
_TRUE, _FALSE, _BYTE = 1, 2, 3


class RowReader:
    """Rows by their number, of which one is in memory: quick where they are read in order.

    Args:
        path: The file. Its footer alone is read here.
        columns: What is read of each row.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no Parquet file, or lacks one of the columns.
        MissingPackageError: If pyarrow is not installed.
    """

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        if not is_file(path):
            raise MissingFileError(f"{path}: there is no such file.")
        self.path = path
        self.columns = tuple(columns)
        with _opened(path) as file:
            known = [str(name) for name in file.schema_arrow.names]
            groups = range(file.metadata.num_row_groups)
            counts = [int(file.metadata.row_group(i).num_rows) for i in groups]
        for name in columns:
            expect(name in known, path, f"the column {name}", ", ".join(known))
        self._chunks = read_chunks(path)
        expect(len(self._chunks) == len(counts), path, f"{_KIND}, got a damaged footer")
        self._ends = np.cumsum(counts, dtype=np.int64)
        self._rows: Iterator[Row] = iter(())
        self._group, self._position = -1, 0

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    def row(self, index: int) -> Row:
        """One row; those before it in its group are passed over.

        Raises:
            FileFormatError: If the file is damaged there, or would unpack to too much.
        """
        expect(0 <= index < len(self), self.path, f"row {index}, got {len(self)} rows")
        group = int(np.searchsorted(self._ends, index, side="right"))
        if group != self._group or index < self._position:
            self._group = group
            self._position = int(self._ends[group - 1]) if group else 0
            wanted = [chunk for chunk in self._chunks[group] if chunk.column in self.columns]
            size = sum(max(chunk.size, _WIDEST * chunk.values) for chunk in wanted)
            packed = self.path.stat().st_size
            check_unpacked(self.path, size, packed=packed, what="rows of a group")
            self._rows = self._group_rows(group)
        for row in self._rows:
            self._position += 1
            if self._position > index:
                return row
        self._group = -1
        raise malformed(self.path, f"{len(self)} rows, but the file ends early")

    def _group_rows(self, group: int) -> Iterator[Row]:
        with _opened(self.path) as file:
            batches = file.iter_batches(
                batch_size=1, row_groups=[group], columns=list(self.columns), use_threads=False
            )
            for batch in batches:
                for i in range(batch.num_rows):
                    yield {name: _value(batch.column(name)[i]) for name in self.columns}


def read_rows(path: Path, columns: Sequence[str]) -> list[Row]:
    """All rows of some columns, of a file whose rows are small; see `RowReader`."""
    rows = RowReader(path, columns)
    return [rows.row(i) for i in range(len(rows))]


def list_of(row: Row, column: str, *, where: object, count: int | None = None) -> NDArray[Any]:
    """The list of numbers in a row.

    Args:
        row: One row.
        column: Its column.
        where: The file and row; starts the message.
        count: How many there must be; None for any number.

    Raises:
        FileFormatError: If there is none, or it has another length.
    """
    value = row[column]
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "iuf":
        raise malformed(where, f"numbers in {column}", value)
    fits = count is None or len(value) == count
    expect(fits, where, f"{count} numbers in {column}, got {len(value)} of them")
    return value


def number_of(row: Row, column: str, *, where: object) -> float:
    """The finite number in a row; `FileFormatError` if there is none."""
    value = row[column]
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise malformed(where, f"a number in {column}", value)
    return float(value)


def integer_of(row: Row, column: str, *, where: object) -> int:
    """The whole number in a row, not negative; `FileFormatError` if there is none."""
    value = row[column]
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise malformed(where, f"a whole number in {column}", value)
    return value


def bytes_of(row: Row, column: str, *, where: object) -> bytes:
    """The bytes in a row; `FileFormatError` if there are none."""
    value = row[column]
    if not isinstance(value, bytes) or not value:
        raise malformed(where, f"bytes in {column}", value)
    return value


@contextmanager
def writing_rows(path: Path, kinds: Mapping[str, str]) -> Generator["RowWriter"]:
    """A file to write rows to, which is whole when the block ends.

    Args:
        path: The file. Its folder must exist.
        kinds: What each column holds: ``int64``, ``double``, ``string``, ``binary``, or a list of
            numbers, such as ``list float``.

    Raises:
        MissingPackageError: If pyarrow is not installed.
    """
    arrow = _arrow(path)

    def kind_of(words: str) -> Any:
        *outer, inner = words.split()
        kind = arrow.type_for_alias(inner)
        return arrow.list_(kind) if outer else kind

    schema = arrow.schema([(name, kind_of(words)) for name, words in kinds.items()])
    with path.open("wb") as stream, arrow.parquet.ParquetWriter(stream, schema) as writer:
        yield RowWriter(arrow, writer, schema)


class RowWriter:
    """Takes rows of a file, a group at each call."""

    def __init__(self, arrow: Any, writer: Any, schema: Any) -> None:
        self._arrow, self._writer, self._schema = arrow, writer, schema

    def write(self, rows: Sequence[Row]) -> None:
        """Write rows; columns that a row lacks hold nothing."""
        filled = [{name: row.get(name) for name in self._schema.names} for row in rows]
        if filled:
            self._writer.write_table(self._arrow.Table.from_pylist(filled, self._schema))


def _arrow(path: Path) -> Any:
    arrow = import_package("pyarrow", f"{path}: Parquet", "waymo")
    import_package("pyarrow.parquet", f"{path}: Parquet", "waymo")
    return arrow


@contextmanager
def _opened(path: Path) -> Generator[Any]:
    """A file of pyarrow, whose failures are ours."""
    arrow = _arrow(path)
    with reading(path, _KIND), path.open("rb") as stream:
        try:
            yield arrow.parquet.ParquetFile(stream, pre_buffer=False)
        except arrow.ArrowException as error:
            raise malformed(path, f"{_KIND}, but it cannot be read ({reason(error)})") from error


def _value(scalar: Any) -> Any:
    """A value of pyarrow as plain Python or NumPy has it."""
    if not scalar.is_valid:
        return None
    if hasattr(scalar, "values"):  # a list, of fixed or any length
        return np.asarray(scalar.values.to_numpy(zero_copy_only=False))
    return scalar.as_py()


class Chunk(NamedTuple):
    """One column of a group of rows."""

    column: str
    """The column that it belongs to: of a list the column, not what is in it."""

    values: int
    size: int
    """Bytes before they are packed."""


def read_chunks(path: Path) -> tuple[tuple[Chunk, ...], ...]:
    """The chunks of each group of rows, from the footer of a file.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If its footer is damaged.
    """
    with reading(path, _KIND), path.open("rb") as stream:
        size = stream.seek(0, 2)
        stream.seek(max(size - _TAIL.size, 0))
        length, magic = _TAIL.unpack(stream.read(_TAIL.size))
        ends = magic == _MAGIC and length <= size - 2 * len(_MAGIC) - 4
        expect(ends, path, f"{_KIND}, but it cannot be read (its end is no footer)")
        stream.seek(size - _TAIL.size - length)
        footer: Any = _Thrift(stream.read(length)).struct(0)
        return tuple(tuple(_chunk(chunk[3]) for chunk in group[1]) for group in footer.get(4, []))


def _chunk(described: dict[int, Any]) -> Chunk:
    column = bytes(described[3][0]).decode()
    return Chunk(column, abs(int(described[5])), abs(int(described[6])))


class _Thrift:
    """Values of the compact protocol, one after another; fields are told by their numbers."""

    def __init__(self, content: bytes) -> None:
        self._content, self._at = content, 0

    def struct(self, depth: int) -> dict[int, Any]:
        """Fields up to the end of a struct."""
        if depth > _DEEPEST:
            raise ValueError("structs in structs without an end")
        fields: dict[int, Any] = {}
        number = 0
        while (head := self._byte()) != 0:
            step, kind = head >> 4, head & 15
            number = number + step if step else self._signed()
            fields[number] = kind == _TRUE if kind in (_TRUE, _FALSE) else self._value(kind, depth)
        return fields

    def _value(self, kind: int, depth: int) -> Any:
        match kind:
            case 3:
                return self._byte()
            case 4 | 5 | 6:  # whole numbers of 16, 32 and 64 bits
                return self._signed()
            case 7:  # float64
                return self._take(8)
            case 8:  # bytes or text
                return self._take(self._unsigned())
            case 9 | 10:  # list or set
                return self._list(depth + 1)
            case 12:
                return self.struct(depth + 1)
            case _:  # the footer has no maps
                raise ValueError(f"a value of kind {kind}")

    def _list(self, depth: int) -> list[Any]:
        if depth > _DEEPEST:
            raise ValueError("lists in lists without an end")
        head = self._byte()
        count, kind = head >> 4, head & 15
        count = self._unsigned() if count == 15 else count
        if count > len(self._content) - self._at:  # every value takes a byte at least
            raise ValueError("more values than bytes")
        # A truth value in a list takes a byte, as a field it stands in the field's kind.
        kind = _BYTE if kind in (_TRUE, _FALSE) else kind
        return [self._value(kind, depth) for _ in range(count)]

    def _byte(self) -> int:
        return self._take(1)[0]

    def _take(self, count: int) -> bytes:
        if count > len(self._content) - self._at:
            raise ValueError("it ends early")
        self._at += count
        return self._content[self._at - count : self._at]

    def _unsigned(self) -> int:
        value = shift = 0
        while shift < 70:
            byte = self._byte()
            value |= (byte & 127) << shift
            if byte < 128:
                return value
            shift += 7
        raise ValueError("a number of more than 64 bits")

    def _signed(self) -> int:
        value = self._unsigned()
        return (value >> 1) ^ -(value & 1)
