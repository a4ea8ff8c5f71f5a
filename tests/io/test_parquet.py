"""Rows of Parquet: in any order, of any groups, and never more than is allowed."""

from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from splatseg.errors import FileFormatError, MissingFileError
from splatseg.io import parquet as module
from splatseg.io.limits import unpacking
from splatseg.io.parquet import (
    RowReader,
    bytes_of,
    integer_of,
    list_of,
    number_of,
    read_rows,
)


@pytest.fixture
def file(tmp_path):
    table = pa.table(
        {
            "a.b": pa.array(range(7), pa.int64()),
            "lists": pa.array([[i] * i for i in range(7)], pa.list_(pa.float32())),
            "fixed": pa.array([[i, i] if i else None for i in range(7)], pa.list_(pa.int32(), 2)),
            "bytes": pa.array([b"x" * i for i in range(7)]),
        }
    )
    pq.write_table(table, tmp_path / "a.parquet", row_group_size=3)
    return tmp_path / "a.parquet"


@pytest.mark.parametrize("order", [range(7), [6, 0, 3, 2, 1, 5, 5, 4, 6], [4]])
def test_rows_in_any_order(file, order) -> None:
    reader = RowReader(file, ("lists", "a.b"))
    assert len(reader) == 7
    for i in order:
        row = reader.row(i)
        assert set(row) == {"lists", "a.b"}
        assert (row["a.b"], row["lists"].tolist()) == (i, [i] * i)


def test_values_of_a_row(file) -> None:
    rows = read_rows(file, ("a.b", "fixed", "bytes", "lists"))
    assert integer_of(rows[2], "a.b", where=file) == 2
    assert number_of(rows[2], "a.b", where=file) == 2.0
    assert list_of(rows[2], "fixed", where=file, count=2).tolist() == [2, 2]
    assert bytes_of(rows[2], "bytes", where=file) == b"xx"
    assert rows[0]["fixed"] is None
    for call, words in (
        (lambda: list_of(rows[0], "fixed", where=file), "expected numbers in fixed, got none"),
        (lambda: list_of(rows[2], "lists", where=file, count=3), "expected 3 numbers in lists"),
        (lambda: bytes_of(rows[0], "bytes", where=file), "expected bytes in bytes"),
        (lambda: number_of(rows[0], "lists", where=file), "expected a number in lists"),
        (lambda: integer_of(rows[0], "bytes", where=file), "expected a whole number in bytes"),
        (lambda: RowReader(file, ("a.b",)).row(7), "expected row 7, got 7 rows"),
    ):
        with pytest.raises(FileFormatError, match=words):
            call()


def test_what_is_no_parquet(tmp_path, file) -> None:
    with pytest.raises(MissingFileError, match="there is no such file"):
        RowReader(tmp_path / "nowhere.parquet", ("a",))
    with pytest.raises(FileFormatError, match=r"expected the column a, got 'a.b, lists"):
        RowReader(file, ("a",))
    (tmp_path / "b.parquet").write_bytes(b"PAR1" * 3)
    with pytest.raises(FileFormatError, match="expected a Parquet file, but it cannot be read"):
        RowReader(tmp_path / "b.parquet", ("a",))


def test_a_small_file_of_many_values(tmp_path) -> None:
    """A million zeros are a few kilobytes."""
    file = tmp_path / "a.parquet"
    table = pa.table({"lists": [np.zeros(1 << 20, np.float32)] * 2})
    pq.write_table(table, file, compression="zstd")
    assert file.stat().st_size < 10_000
    with unpacking(1 << 20), pytest.raises(FileFormatError, match="one row, which is 4"):
        RowReader(file, ("lists",)).row(0)
    assert len(RowReader(file, ("lists",)).row(1)["lists"]) == 1 << 20


@pytest.mark.parametrize("rows", [-3, 1 << 62])
def test_a_footer_with_a_row_count_that_none_can_have(file, monkeypatch, rows) -> None:
    """A damaged bit makes it (fuzz of waymo-lidar_segmentation.parquet, seed 48, case 1940)."""
    group = SimpleNamespace(num_rows=rows, total_byte_size=10)
    metadata = SimpleNamespace(num_row_groups=1, row_group=lambda index: group)
    damaged = SimpleNamespace(schema_arrow=pa.schema([("lists", pa.int8())]), metadata=metadata)
    monkeypatch.setattr(module, "_opened", lambda path: nullcontext(damaged))
    with pytest.raises(FileFormatError, match="expected groups of 0 rows or more, got"):
        RowReader(file, ("lists",))


@pytest.mark.parametrize("cut", [1, 5, 9, 40, 200])
def test_a_footer_that_is_damaged(file, cut) -> None:
    content = file.read_bytes()
    file.write_bytes(content[:-cut])
    with pytest.raises(FileFormatError, match="expected a Parquet file"):
        RowReader(file, ("lists",)).row(6)
    file.write_bytes(content[: -8 - cut] + b"\xff" * cut + content[-8:])
    with pytest.raises(FileFormatError, match="expected a Parquet file"):
        RowReader(file, ("lists",)).row(6)
