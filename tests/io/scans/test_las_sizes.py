"""Sizes and counts of LAS and LAZ that are no longer those of the file, each by one number."""

import struct
from pathlib import Path

import numpy as np
import pytest

from splatseg.errors import FileFormatError
from splatseg.io.scans import read_scans
from splatseg.io.scans._las_sizes import check_las_sizes
from support.fuzz.targets.lasers import COUNT, write

RECORDS, DATA, FORMAT, POINT_BYTES = 100, 96, 104, 105
EXTENDED, POINTS = 243, 247
VERSIONS = {"las": ("1.4", 6), "laz": ("1.4", 7), "old.laz": ("1.2", 3)}


@pytest.fixture
def file(tmp_path):
    """A sound file of a kind."""

    def make(kind: str) -> Path:
        path = tmp_path / f"a.{kind}"
        version, point_format = VERSIONS[kind]
        write(path, version=version, point_format=point_format)
        return path

    return make


def change(path: Path, at: int, layout: str, value: int) -> None:
    content = bytearray(path.read_bytes())
    struct.pack_into(f"<{layout}", content, at, value)
    path.write_bytes(content)


def number(path: Path, at: int, layout: str) -> int:
    return struct.unpack_from(f"<{layout}", path.read_bytes(), at)[0]


def laszip(path: Path) -> int:
    """Where the content of LASzip's record begins."""
    return path.read_bytes().index(b"laszip encoded") - 2 + 54


@pytest.mark.parametrize("kind", VERSIONS)
def test_sound_files_pass(file, kind) -> None:
    path = file(kind)
    check_las_sizes(path)
    assert len(read_scans(path).scan("a" if kind != "old.laz" else "a.old").points) == COUNT


@pytest.mark.parametrize(
    ("at", "layout", "value", "words"),
    [
        (RECORDS, "I", 2**32 - 1, "expected a header, 4294967295 records and points"),
        (POINTS, "Q", COUNT + 1, "expected 41 points, but the file ends early"),
        (POINTS, "Q", 2**40, "--max-unpacked"),
        (DATA, "I", 2**31, "one after the other"),
        (94, "H", 9, "Incoherent header size"),
        (POINT_BYTES, "H", 29, "Incoherent point size"),
        (FORMAT, "B", 11, "11"),
    ],
)
def test_what_does_not_fit_the_file(file, at, layout, value, words) -> None:
    path = file("las")
    change(path, at, layout, value)
    with pytest.raises(FileFormatError, match=words):
        read_scans(path)


def test_records_behind_the_points_are_not_read(file) -> None:
    path = file("las")
    change(path, 235, "Q", path.stat().st_size)
    change(path, EXTENDED, "I", 2**32 - 1)
    assert len(read_scans(path).scan("a").points) == COUNT


@pytest.mark.parametrize(
    ("place", "layout", "value", "words"),
    [
        (0, "H", 1, "in chunks, got parts of 40 in compression 1"),
        (0, "H", 2, "parts that fit compression 2"),
        (12, "I", 2**32 - 2, "chunks of 4294967294 points, which is"),
        (32, "H", 60_000, "expected 60000 parts of a point"),
        (36, "H", 31, "in compression 3"),
    ],
)
def test_what_laszip_says_of_points(file, place, layout, value, words) -> None:
    path = file("laz")
    change(path, laszip(path) + place, layout, value)
    with pytest.raises(FileFormatError, match=words):
        read_scans(path)


def test_chunks_and_their_layers(file) -> None:
    path = file("laz")
    sound, data = path.read_bytes(), number(path, DATA, "I")
    table, layer = number(path, data, "q"), number(path, data + 8 + 40 + 4, "I")
    for at, layout, value, words in (
        (data, "q", 2**40, "expected a table of chunks in the file"),
        (table + 4, "I", 2**31 - 1, "at most a chunk a point, got 2147483647"),
        (table + 4, "I", 0, "at most a chunk a point, got 0"),
        (data + 8 + 40 + 4, "I", 2**32 - 1, "layers of points within their chunks"),
        (data + 8 + 40 + 4, "I", layer + 1, "layers of points within their chunks"),
        (POINTS, "Q", 50_001, "got chunks that hold 50000"),
    ):
        path.write_bytes(sound)
        change(path, at, layout, value)
        with pytest.raises(FileFormatError, match=words):
            read_scans(path)


def test_chunks_end_before_their_table(file) -> None:
    path = file("laz")
    content, data = path.read_bytes(), number(path, DATA, "I")
    table = number(path, data, "q")
    path.write_bytes(content[: table - 5] + content[table:])
    change(path, data, "q", table - 5)
    with pytest.raises(FileFormatError, match=f"that end before byte {table - 5}"):
        check_las_sizes(path)


def test_layers_of_every_chunk_are_looked_at(tmp_path) -> None:
    """A chunk holds 50000 points: of one more there are two chunks."""
    import laspy
    import lazrs

    path, count = tmp_path / "two.laz", 50_001
    cloud = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
    cloud.x = np.arange(count) * 0.01
    cloud.y = cloud.z = np.zeros(count)
    cloud.write(path)
    check_las_sizes(path)
    data, record = number(path, DATA, "I"), path.read_bytes()[laszip(path) :][:46]
    with path.open("rb") as stream:
        stream.seek(data)
        (_, first), _ = lazrs.read_chunk_table(stream, lazrs.LazVlr(record))
    change(path, data + 8 + first + 30 + 4, "I", 2**31)
    with pytest.raises(FileFormatError, match="layers of points within their chunks"):
        check_las_sizes(path)
