"""Rows of Parquet files, read one at a time; needs pyarrow.

A file says itself what a group of rows unpacks to, which is held against `io.limits` before any of
it is unpacked; so is each row, as values that repeat take next to nothing. What the footer says of
single columns is not asked for: where it is damaged that ends the whole process (pyarrow 26.0: an
exception of C++ that nothing catches).
"""

from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg.errors import MissingFileError, import_package, reason
from splatseg.io.foreign import expect, is_file, malformed, reading
from splatseg.io.limits import check_unpacked

Row = Mapping[str, Any]
"""Values by column: numbers, text, bytes, arrays of one axis for lists, None for nothing."""

_KIND = "a Parquet file"


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
            groups = [file.metadata.row_group(i) for i in range(file.metadata.num_row_groups)]
            counts = [int(group.num_rows) for group in groups]
            sound = min(counts, default=0) >= 0 and sum(counts) < 1 << 62
            expect(sound, path, "groups of 0 rows or more", str(counts[:3]))
            self._ends = np.cumsum(counts, dtype=np.int64)
            self._sizes = [int(group.total_byte_size) for group in groups]
        for name in columns:
            expect(name in known, path, f"the column {name}", ", ".join(known))
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
            self._check(self._sizes[group], "rows of a group")
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
                self._check(batch.nbytes, "one row")
                for i in range(batch.num_rows):
                    yield {name: _value(batch.column(name)[i]) for name in self.columns}

    def _check(self, size: int, what: str) -> None:
        check_unpacked(self.path, size, packed=self.path.stat().st_size, what=what)


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
