"""Sizes and counts of a LAS or LAZ file, held against its bytes before a library believes them.

A header says how many records and points follow, and compressed points how long each chunk and
each layer of it is. laspy reads records that are not there one after the other, four thousand
million of them; lazrs allocates what it is told, and ends the process where that fails. ASPRS, LAS
Specification 1.4 R15; Isenburg, LASzip (2013), and its format's layers.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from splatseg.errors import import_package
from splatseg.io.foreign import expect, reading
from splatseg.io.limits import check_unpacked

_HEADER = 227
_POINT_BYTES = {
    0: 20, 1: 28, 2: 26, 3: 34, 4: 57, 5: 63, 6: 30, 7: 36, 8: 38, 9: 59, 10: 67,
}  # fmt: skip
"""Least bytes of a point by its format."""

_PACKED = 0x80
"""The bit of the format that says that points are compressed."""

_LASZIP = b"laszip encoded", 22204
_ITEMS = {6: 20, 7: 8, 8: 6, 9: 29, 10: 30, 11: 6, 12: 8, 13: 29}
"""Bytes of a part of a point by its type; types 0 and 14 are extra bytes, of any number."""

_EXTRA, _EXTRA_LAYERED = 0, 14
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
"""Layers of a part of a point by its type; of extra bytes each is one."""

_CHUNKED, _LAYERED = 2, 3
_ANY_SIZE = 0xFFFFFFFF


@dataclass(frozen=True, slots=True, kw_only=True)
class _Sizes:
    """What the header says."""

    file: int
    data: int
    """Where points begin."""

    points: int
    point_bytes: int
    is_packed: bool
    end: int
    """Where points end at the latest: the first record behind them, or the end of the file."""


def check_las_sizes(path: Path) -> None:
    """Refuse a file whose sizes and counts do not fit its bytes.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is damaged, or would unpack to more than a file of its size may.
    """
    with reading(path, "a LAS file"), path.open("rb") as file:
        sizes, records = _header(path, file)
        what = f"{sizes.points} points"
        unpacked = sizes.points * sizes.point_bytes
        check_unpacked(path, unpacked, packed=sizes.file, what=what)
        if not sizes.is_packed:
            whole = sizes.data + unpacked <= sizes.end
            expect(whole, path, f"{what}, but the file ends early")
        elif sizes.points:
            _check_packed(path, file, sizes, records)


def _header(path: Path, file: BinaryIO) -> tuple[_Sizes, dict[tuple[bytes, int], bytes]]:
    """What the header says, and the records before the points."""
    size = path.stat().st_size
    head = file.read(375)
    sound = len(head) >= _HEADER and head[:4] == b"LASF"
    expect(sound, path, "a LAS file, but its header is not there")
    length, data, count = struct.unpack_from("<HII", head, 94)
    format_byte, point_bytes, points = struct.unpack_from("<BHI", head, 104)
    later, extended = size, 0
    if head[25] >= 4 and len(head) == 375:
        first, extended, points = struct.unpack_from("<QIQ", head, 235)
        later = min(size, first) if extended else size
    format = format_byte & 0x3F
    what = "points of formats 0 to 10, of at least 20 to 67 bytes"
    known = format in _POINT_BYTES and point_bytes >= _POINT_BYTES[format]
    expect(known, path, f"{what}, got format {format} of {point_bytes} bytes")
    what = f"header, points and records one after the other in {size} bytes"
    ordered = _HEADER <= length <= data <= later
    expect(ordered, path, f"{what}, got them at {length}, {data} and {later}")
    records = _records(path, file, length, data, count, extended=False)
    if extended:
        _records(path, file, later, size, extended, extended=True)
    packed = bool(format_byte & _PACKED)
    sizes = _Sizes(
        file=size, data=data, points=points, point_bytes=point_bytes, is_packed=packed, end=later
    )
    return sizes, records


def _records(
    path: Path, file: BinaryIO, at: int, end: int, count: int, *, extended: bool
) -> dict[tuple[bytes, int], bytes]:
    """Records between two places by their owner and number; those behind points are not read."""
    head, layout = (60, "<Q") if extended else (54, "<H")
    found: dict[tuple[bytes, int], bytes] = {}
    what = f"records of {head} bytes or more, got {count} of them in {end - at} bytes"
    expect(at + count * head <= end, path, what)
    for _ in range(count):
        file.seek(at)
        start = file.read(head)
        (length,) = struct.unpack_from(layout, start, 20)
        at += head + length
        expect(at <= end, path, f"records that end before byte {end}")
        if not extended:
            owner, number = struct.unpack_from("<16sH", start, 2)
            found[owner.rstrip(b"\0"), number] = file.read(length)
    return found


def _check_packed(
    path: Path, file: BinaryIO, sizes: _Sizes, records: dict[tuple[bytes, int], bytes]
) -> None:
    """Chunks, and the layers of each, must lie in the file."""
    record = records.get(_LASZIP, b"")
    expect(len(record) >= 34, path, "LASzip's record, got none")
    packer, chunk, items = struct.unpack("<H10xI16xH", record[:34])
    whole = len(record) >= 34 + 6 * items
    expect(whole, path, f"{items} parts of a point in LASzip's record")
    parts = [struct.unpack_from("<HH", record, 34 + 6 * i) for i in range(items)]
    extra = (_EXTRA, _EXTRA_LAYERED)
    known = all(kind in extra or _ITEMS.get(kind) == size for kind, size in parts)
    total = sum(size for _, size in parts)
    known = known and total == sizes.point_bytes and packer in (_CHUNKED, _LAYERED)
    what = f"points of {sizes.point_bytes} bytes in chunks"
    expect(known, path, f"{what}, got parts of {total} in compression {packer}")
    fits = (packer == _LAYERED) == all(kind >= 10 for kind, _ in parts)
    expect(fits, path, f"parts that fit compression {packer}")
    if chunk != _ANY_SIZE:
        unpacked = chunk * sizes.point_bytes
        check_unpacked(path, unpacked, packed=sizes.file, what=f"chunks of {chunk} points")
    begin, table = sizes.data + 8, _table(path, file, sizes)
    chunks = _chunks(path, file, sizes, record, chunk)
    inside = sum(length for _, length in chunks) <= table - begin
    expect(inside, path, f"chunks of points that end before byte {table}")
    if packer == _LAYERED:
        _check_layers(path, file, begin, [length for _, length in chunks], parts)


def _table(path: Path, file: BinaryIO, sizes: _Sizes) -> int:
    """Where the table of chunks is."""
    file.seek(sizes.data)
    (table,) = struct.unpack("<q", file.read(8))
    if table == -1:  # written at the end where the writer could not go back
        file.seek(sizes.file - 8)
        (table,) = struct.unpack("<q", file.read(8))
    inside = sizes.data + 8 <= table <= sizes.file - 8
    expect(inside, path, f"a table of chunks in the file, got it at {table}")
    file.seek(table)
    version, count = struct.unpack("<II", file.read(8))
    sound = not version and 1 <= count <= min(sizes.points, table - sizes.data)
    got = f"{count} of {sizes.points} points in {table - sizes.data} bytes"
    expect(sound, path, f"at most a chunk a point, got {got}")
    return table


def _chunks(
    path: Path, file: BinaryIO, sizes: _Sizes, record: bytes, chunk: int
) -> list[tuple[int, int]]:
    """Points and bytes of each chunk. The table is compressed, and its length is known by now."""
    lazrs = import_package("lazrs", f"{path}: LASzip", "las")
    file.seek(sizes.data)
    chunks = [(int(n), int(size)) for n, size in lazrs.read_chunk_table(file, lazrs.LazVlr(record))]
    held = chunk * len(chunks) if chunk != _ANY_SIZE else sum(n for n, _ in chunks)
    what = f"{sizes.points} points, got chunks that hold {held}"
    expect(held >= sizes.points, path, what)
    return chunks


def _check_layers(
    path: Path, file: BinaryIO, at: int, chunks: Sequence[int], parts: Sequence[tuple[int, int]]
) -> None:
    """Each chunk has a point, the number of its points, and the bytes of each layer; then these."""
    layers = sum(size if kind == _EXTRA_LAYERED else _LAYERS[kind] for kind, size in parts)
    first = sum(size for _, size in parts)
    for length in chunks:
        file.seek(at + first + 4)
        head = file.read(4 * layers)
        expect(len(head) == 4 * layers, path, "layers of points within their chunks")
        used = first + 4 + len(head) + sum(struct.unpack(f"<{layers}I", head))
        expect(used <= length, path, "layers of points within their chunks")
        at += length
