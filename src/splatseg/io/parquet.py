"""Rows of Parquet files, a few at a time; needs pyarrow.

A file says itself how much its columns unpack to and how many values they hold; both are held
against `io.limits` before anything of them is unpacked.
"""

from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg.errors import FileFormatError, MissingFileError, MissingPackageError, quoted, reason
from splatseg.io.foreign import is_file, reading
from splatseg.io.limits import check_unpacked
from splatseg.io.parquet_footer import Chunk, read_chunks

Row = Mapping[str, Any]
"""Values by column: numbers, text, bytes, arrays of one axis for lists, None for nothing."""

_KIND = "a Parquet file"
_WIDEST = 8


def read_rows(path: Path, columns: Sequence[str]) -> list[Row]:
    """All rows of some columns, of a file whose rows are small.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it lacks a column, is damaged, or would unpack to too much.
        MissingPackageError: If pyarrow is not installed.
    """
    rows = RowReader(path, columns)
    return [rows.row(i) for i in range(len(rows))]


class RowReader:
    """Rows by their number, of which one is in memory: quick where they are asked for in order.

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
            known = tuple(str(name) for name in file.schema_arrow.names)
            groups = range(file.metadata.num_row_groups)
            counts = [int(file.metadata.row_group(i).num_rows) for i in groups]
        missing = [name for name in columns if name not in known]
        if missing:
            raise FileFormatError(
                f"{path}: expected the column {missing[0]}, got {quoted(', '.join(known))}."
            )
        self._chunks = read_chunks(path)
        if len(self._chunks) != len(counts):
            raise FileFormatError(f"{path}: expected a Parquet file, got a damaged footer.")
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
        group = int(np.searchsorted(self._ends, index, side="right"))
        if group >= len(self._ends) or index < 0:
            raise FileFormatError(f"{self.path}: expected row {index}, got {len(self)} rows.")
        if group != self._group or index < self._position:
            self._group = group
            self._position = int(self._ends[group - 1]) if group else 0
            _check_size(self.path, self.columns, self._chunks[group])
            self._rows = _group_rows(self.path, self.columns, group)
        for row in self._rows:
            self._position += 1
            if self._position > index:
                return row
        self._group = -1
        raise FileFormatError(f"{self.path}: expected {len(self)} rows, but the file ends early.")


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
        raise FileFormatError(f"{where}: expected numbers in {column}, got {quoted(value)}.")
    if count is not None and len(value) != count:
        raise FileFormatError(
            f"{where}: expected {count} numbers in {column}, got {len(value)} of them."
        )
    return value


def number_of(row: Row, column: str, *, where: object) -> float:
    """The finite number in a row.

    Raises:
        FileFormatError: If there is none.
    """
    value = row[column]
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise FileFormatError(f"{where}: expected a number in {column}, got {quoted(value)}.")
    return float(value)


def integer_of(row: Row, column: str, *, where: object) -> int:
    """The whole number in a row, not negative.

    Raises:
        FileFormatError: If there is none.
    """
    value = row[column]
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise FileFormatError(f"{where}: expected a whole number in {column}, got {quoted(value)}.")
    return value


def bytes_of(row: Row, column: str, *, where: object) -> bytes:
    """The bytes in a row.

    Raises:
        FileFormatError: If there are none.
    """
    value = row[column]
    if not isinstance(value, bytes) or not value:
        raise FileFormatError(f"{where}: expected bytes in {column}, got {quoted(value)}.")
    return value


@contextmanager
def _opened(path: Path) -> Generator[Any]:
    """A file of pyarrow, whose failures are ours."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise MissingPackageError(
            f"{path}: Parquet needs a package that is not installed (pyarrow). "
            "Try: pip install 'splatseg[waymo]'."
        ) from error
    with reading(path, _KIND), path.open("rb") as stream:
        try:
            yield parquet.ParquetFile(stream, pre_buffer=False)
        except pyarrow.ArrowException as error:
            raise FileFormatError(
                f"{path}: expected {_KIND}, but it cannot be read ({reason(error)})."
            ) from error


def _group_rows(path: Path, columns: Sequence[str], group: int) -> Iterator[Row]:
    with _opened(path) as file:
        batches = file.iter_batches(
            batch_size=1, row_groups=[group], columns=list(columns), use_threads=False
        )
        for batch in batches:
            for i in range(batch.num_rows):
                yield {name: _value(batch.column(name)[i]) for name in columns}


def _check_size(path: Path, columns: Sequence[str], chunks: Sequence[Chunk]) -> None:
    """Refuse a group whose wanted columns unpack to more than a file of its size may."""
    size = sum(
        max(chunk.size, _WIDEST * chunk.values) for chunk in chunks if chunk.column in columns
    )
    check_unpacked(path, size, packed=path.stat().st_size, what="rows of a group")


def _value(scalar: Any) -> Any:
    """A value of pyarrow as plain Python or NumPy has it."""
    if not scalar.is_valid:
        return None
    if hasattr(scalar, "values"):  # a list, of fixed or any length
        return np.asarray(scalar.values.to_numpy(zero_copy_only=False))
    return scalar.as_py()
