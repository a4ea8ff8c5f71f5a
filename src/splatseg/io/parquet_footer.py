"""How many values the columns of a Parquet file hold, from its footer, without unpacking any.

pyarrow tells it too, but where a footer is damaged that call ends the whole process (26.0: an
exception of C++ that nothing catches). The footer is a Thrift struct in the compact protocol; what
the numbers of fields mean is in parquet.thrift of the format's own pages:

    FileMetaData.4 row_groups, RowGroup.1 columns, ColumnChunk.3 meta_data,
    ColumnMetaData.3 path_in_schema, .5 num_values, .6 total_uncompressed_size
"""

import struct
from pathlib import Path
from typing import Any, NamedTuple, cast

from splatseg.errors import FileFormatError
from splatseg.io.foreign import reading

_MAGIC = b"PAR1"
_TAIL = struct.Struct("<I4s")
_DEEPEST = 16
_TRUE, _FALSE, _BYTE = 1, 2, 3


class Chunk(NamedTuple):
    """One column of a group of rows."""

    column: str
    """The column that it belongs to: of a list the column, not what is in it."""

    values: int
    size: int
    """Bytes before they are packed."""


def read_chunks(path: Path) -> tuple[tuple[Chunk, ...], ...]:
    """The chunks of each group of rows.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If its footer is damaged.
    """
    with reading(path, "a Parquet file"), path.open("rb") as stream:
        size = stream.seek(0, 2)
        stream.seek(max(size - _TAIL.size, 0))
        length, magic = _TAIL.unpack(stream.read(_TAIL.size))
        if magic != _MAGIC or length > size - 2 * len(_MAGIC) - 4:
            raise FileFormatError(
                f"{path}: expected a Parquet file, but it cannot be read (its end is no footer)."
            )
        stream.seek(size - _TAIL.size - length)
        footer = _Thrift(stream.read(length)).struct(0)
        return tuple(
            tuple(
                _chunk(cast(dict[int, Any], chunk)[3]) for chunk in cast(dict[int, Any], group)[1]
            )
            for group in footer.get(4, [])
        )


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
            case 11:
                return self._map(depth + 1)
            case 12:
                return self.struct(depth + 1)
            case _:
                raise ValueError(f"a value of kind {kind}")

    def _list(self, depth: int) -> list[Any]:
        if depth > _DEEPEST:
            raise ValueError("lists in lists without an end")
        head = self._byte()
        count, kind = head >> 4, head & 15
        count = self._unsigned() if count == 15 else count
        self._bounded(count)
        # A truth value in a list takes a byte, as a field it stands in the field's kind.
        kind = _BYTE if kind in (_TRUE, _FALSE) else kind
        return [self._value(kind, depth) for _ in range(count)]

    def _map(self, depth: int) -> None:
        count = self._unsigned()
        self._bounded(count)
        if count:
            kinds = self._byte()
            for _ in range(count):
                self._value(kinds >> 4, depth)
                self._value(kinds & 15, depth)

    def _bounded(self, count: int) -> None:
        """Every value takes a byte at least."""
        if count > len(self._content) - self._at:
            raise ValueError("more values than bytes")

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
