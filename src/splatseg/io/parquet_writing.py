"""Parquet files, written some rows at a time; needs pyarrow."""

from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from splatseg.errors import MissingPackageError


class RowWriter:
    """Takes rows of a file, a group at each call."""

    def __init__(self, writer: Any, schema: Any) -> None:
        self._writer, self._schema = writer, schema

    def write(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Write rows; columns that a row lacks hold nothing."""
        import pyarrow

        names = self._schema.names
        filled = [{name: row.get(name) for name in names} for row in rows]
        if filled:
            self._writer.write_table(pyarrow.Table.from_pylist(filled, self._schema))


@contextmanager
def writing_rows(path: Path, kinds: Mapping[str, str]) -> Generator[RowWriter]:
    """A file to write rows to, which is whole when the block ends.

    Args:
        path: The file. Its folder must exist.
        kinds: What each column holds: ``int64``, ``double``, ``string``, ``binary``, or a list of
            numbers, such as ``list float``.

    Raises:
        MissingPackageError: If pyarrow is not installed.
    """
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise MissingPackageError(
            f"{path}: Parquet needs a package that is not installed (pyarrow). "
            "Try: pip install 'splatseg[waymo]'."
        ) from error

    def kind_of(words: str) -> Any:
        *outer, inner = words.split()
        kind = pyarrow.type_for_alias(inner)
        return pyarrow.list_(kind) if outer else kind

    schema = pyarrow.schema([(name, kind_of(words)) for name, words in kinds.items()])
    with path.open("wb") as stream, parquet.ParquetWriter(stream, schema) as writer:
        yield RowWriter(writer, schema)
