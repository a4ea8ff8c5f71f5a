"""Sizes and counts of a LAS or LAZ file, held against its bytes before a library believes them.

A header says how many records and points follow, and compressed points how long each chunk and
each layer of it is. laspy reads records that are not there one after the other, four thousand
million of them; lazrs allocates what it is told, and ends the process where that fails. ASPRS, LAS
Specification 1.4 R15; Isenburg, LASzip (2013), and its format's layers.
"""

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

from splatseg.errors import import_package, reason
from splatseg.io.foreign import expect, malformed, reading
from splatseg.io.limits import check_unpacked

_KIND = "a LAS file"
_HEADER = 227
_RECORD = 54

_ITEMS = {6: 20, 7: 8, 8: 6, 9: 29, 10: 30, 11: 6, 12: 8, 13: 29}
"""Bytes of a part of a point by its type; types 0 and 14 are extra bytes, of any number."""

_EXTRA, _EXTRA_LAYERED = 0, 14
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
"""Layers of a part of a point by its type; of extra bytes each is one."""

_CHUNKED, _LAYERED = 2, 3
_ANY_SIZE = 0xFFFFFFFF


def check_las_sizes(path: Path) -> None:
    """Refuse a file whose sizes and counts do not fit its bytes. Records behind points are left.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is damaged, or would unpack to more than a file of its size may.
        MissingPackageError: If laspy is not installed.
    """
    laspy = import_package("laspy", f"{path}: LAS", "las")
    with reading(path, _KIND), path.open("rb") as file:
        size, head = path.stat().st_size, file.read(_HEADER)
        sound = len(head) == _HEADER and head[:4] == b"LASF"
        expect(sound, path, f"{_KIND}, but its header is not there")
        data, count = struct.unpack_from("<II", head, 96)
        ordered = _HEADER + _RECORD * count <= data <= size
        what = f"a header, {count} records and points one after the other in {size} bytes"
        expect(ordered, path, f"{what}, got points at byte {data}")
        file.seek(0)
        try:
            header = laspy.LasHeader.read_from(file)
        except laspy.LaspyException as error:
            raise malformed(path, f"{_KIND}, but it cannot be read ({reason(error)})") from error
        unpacked = header.point_count * header.point_format.size
        what = f"{header.point_count} points"
        check_unpacked(path, unpacked, packed=size, what=what)
        if not header.are_points_compressed:
            expect(data + unpacked <= size, path, f"{what}, but the file ends early")
        elif header.point_count:
            _check_packed(path, file, header, size)


def _check_packed(path: Path, file: BinaryIO, header: Any, size: int) -> None:
    """Chunks, and the layers of each, must lie in the file."""
    point_bytes, data = header.point_format.size, header.offset_to_point_data
    record = b"".join(one.record_data for one in header.vlrs.get("LasZipVlr"))
    expect(len(record) >= 34, path, "LASzip's record, got none")
    packer, chunk, items = struct.unpack("<H10xI16xH", record[:34])
    whole = len(record) >= 34 + 6 * items
    expect(whole, path, f"{items} parts of a point in LASzip's record")
    parts: list[tuple[int, int]] = [
        struct.unpack_from("<HH", record, 34 + 6 * i) for i in range(items)
    ]
    extra = (_EXTRA, _EXTRA_LAYERED)
    known = all(kind in extra or _ITEMS.get(kind) == size for kind, size in parts)
    total = sum(size for _, size in parts)
    known = known and total == point_bytes and packer in (_CHUNKED, _LAYERED)
    what = f"points of {point_bytes} bytes in chunks"
    expect(known, path, f"{what}, got parts of {total} in compression {packer}")
    fits = (packer == _LAYERED) == all(kind >= 10 for kind, _ in parts)
    expect(fits, path, f"parts that fit compression {packer}")
    if chunk != _ANY_SIZE:
        unpacked = chunk * point_bytes
        check_unpacked(path, unpacked, packed=size, what=f"chunks of {chunk} points")
    begin, table = data + 8, _table(path, file, header, size)
    chunks = _chunks(path, file, header, record, chunk)
    inside = sum(length for _, length in chunks) <= table - begin
    expect(inside, path, f"chunks of points that end before byte {table}")
    if packer == _LAYERED:
        _check_layers(path, file, begin, [length for _, length in chunks], parts)


def _table(path: Path, file: BinaryIO, header: Any, size: int) -> int:
    """Where the table of chunks is."""
    data, points = header.offset_to_point_data, header.point_count
    file.seek(data)
    (table,) = struct.unpack("<q", file.read(8))
    if table == -1:  # written at the end where the writer could not go back
        file.seek(size - 8)
        (table,) = struct.unpack("<q", file.read(8))
    inside = data + 8 <= table <= size - 8
    expect(inside, path, f"a table of chunks in the file, got it at {table}")
    file.seek(table)
    version, count = struct.unpack("<II", file.read(8))
    sound = not version and 1 <= count <= min(points, table - data)
    got = f"{count} of {points} points in {table - data} bytes"
    expect(sound, path, f"at most a chunk a point, got {got}")
    return table


def _chunks(
    path: Path, file: BinaryIO, header: Any, record: bytes, chunk: int
) -> list[tuple[int, int]]:
    """Points and bytes of each chunk. The table is compressed, and its length is known by now."""
    lazrs = import_package("lazrs", f"{path}: LASzip", "las")
    file.seek(header.offset_to_point_data)
    chunks = [(int(n), int(size)) for n, size in lazrs.read_chunk_table(file, lazrs.LazVlr(record))]
    held = chunk * len(chunks) if chunk != _ANY_SIZE else sum(n for n, _ in chunks)
    what = f"{header.point_count} points, got chunks that hold {held}"
    expect(held >= header.point_count, path, what)
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
