"""Niantic's SPZ, versions 2, 3 (one gzip stream) and 4 (a zstd stream for each attribute).

All start with the same 16 bytes: magic ``NGSP``, version, number of points (uint32 each),
degree of the harmonics, fractional bits of positions, flags, and a byte that is reserved
before version 4 and the number of streams from then on. The attributes follow in the order
positions, opacities, colours, log scales, rotations, harmonics. SPZ points right, up and back;
memory and PLY files right, down and forward: y and z change sign here.
See docs/formats/splats.md.
"""

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from splatseg.core import Gaussians
from splatseg.core.sh import MAX_DEGREE
from splatseg.errors import FileFormatError, RangeError, reason
from splatseg.io.foreign import expect, malformed
from splatseg.io.splats._quantisation import pack_signed_three, unpack_signed_three
from splatseg.io.splats._rows import (
    Array,
    Losses,
    Rows,
    blocks,
    check_size,
    finish,
    logs,
    read_file,
    rendered_degree,
    to_rows,
    unsigned,
)

MAGIC = b"NGSP"
_HEADER = struct.Struct("<4sIIBBBB")
_HEADER_4 = struct.Struct("<I12x")  # offset of the table of streams, reserved
_STREAM = struct.Struct("<QQ")  # compressed, uncompressed bytes
_ANTIALIASED = 1
_EXTENSIONS = 2
_COLOUR_SCALE = 0.15
"""Colours are stored as 0.15 times the coefficient of degree 0, plus one half."""

_FLIP = np.array([1, -1, -1], np.float32)
_FLIP_ROTATION = np.array([1, 1, -1, -1], np.float32)
_FLIP_SH = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)
"""Sign of each basis function of degree 1 to 3 when y and z change sign."""


@dataclass(frozen=True, slots=True)
class _Header:
    """The first 16 bytes after the magic."""

    version: int
    count: int
    degree: int
    fractional_bits: int
    flags: int
    streams: int

    @property
    def sizes(self) -> tuple[int, ...]:
        """Bytes a Gaussian of each attribute, in file order; harmonics only if there are any."""
        rest = 3 * ((self.degree + 1) ** 2 - 1)
        rotation = 3 if self.version < 3 else 4
        return (9, 1, 3, 3, rotation, rest) if rest else (9, 1, 3, 3, rotation)


def read_spz(path: Path, *, strict: bool) -> Gaussians:
    """Read an SPZ file of version 2, 3 or 4, turned to the axes of PLY files.

    Extensions (limits for a viewer's camera, for example) are not kept; the flag of a file made
    for antialiased rendering becomes `Gaussians.antialiased`.

    Raises:
        FileFormatError: If the file is truncated or longer than it says, of another version
            or degree, or unpacks to more than its header promises.
        MissingFileError: If there is no such file.
    """
    data = read_file(path)
    if data[:4] == MAGIC:
        header, streams = _unpack_zstd(path, data)
    else:
        header, streams = _unpack_gzip(path, data)
    positions, opacities, colours, scales, rotations = (
        np.frombuffer(stream, np.uint8).reshape(header.count, size)
        for stream, size in zip(streams[:5], header.sizes[:5], strict=True)
    )
    coefficients = (rendered_degree(path, header.degree, strict=strict) + 1) ** 2
    rows = Rows.empty(header.count, coefficients)
    rest = (
        np.frombuffer(streams[5], np.uint8).reshape(header.count, (header.degree + 1) ** 2 - 1, 3)
        if header.degree
        else None
    )
    for part in blocks(header.count):
        rows.means[part] = _positions(positions[part], header.fractional_bits) * _FLIP
        rows.opacities[part] = opacities[part, 0] / np.float32(255)
        rows.sh[part, 0] = (colours[part] / 255 - 0.5) / _COLOUR_SCALE
        rows.scales[part] = np.exp(scales[part] / 16.0 - 10.0)
        rows.rotations[part] = _rotations(rotations[part], header.version) * _FLIP_ROTATION
        if rest is not None:
            signs = _FLIP_SH[: coefficients - 1, None]
            kept = rest[part, : coefficients - 1].astype(np.float32)
            rows.sh[part, 1:] = (kept - 128) / 128 * signs
    antialiased = bool(header.flags & _ANTIALIASED)
    return finish(path, rows, strict=strict, antialiased=antialiased)


def _header(path: Path, data: bytes) -> _Header:
    """Parse and check the first 16 bytes."""
    what = f"an SPZ header of {_HEADER.size} bytes, got {len(data)}"
    expect(len(data) >= _HEADER.size, path, what)
    magic, *fields = _HEADER.unpack_from(data)
    header = _Header(*fields)
    expect(magic == MAGIC, path, f"the SPZ magic {MAGIC!r}, got {magic!r}")
    expect(header.version in (2, 3, 4), path, f"SPZ version 2, 3 or 4, got {header.version}")
    degrees = f"harmonics of degree 0 to {MAX_DEGREE + 1}, got {header.degree}"
    expect(header.degree <= MAX_DEGREE + 1, path, degrees)
    bits = header.fractional_bits
    expect(bits <= 24, path, f"at most 24 fractional bits, got {bits}")
    return header


def _unpack_gzip(path: Path, data: bytes) -> tuple[_Header, list[memoryview]]:
    """The attributes of versions 2 and 3."""
    stream = zlib.decompressobj(wbits=31)
    try:
        header = _header(path, stream.decompress(data, _HEADER.size))
        version = header.version
        expect(version <= 3, path, f"SPZ version 2 or 3 inside gzip, got {version}")
        check_size(path, header.count, header.degree, packed=len(data))
        body = sum(header.sizes) * header.count
        content = stream.decompress(stream.unconsumed_tail, body) if body else b""
        # Extensions may follow the attributes; anything else after them is a wrong count.
        more = stream.decompress(stream.unconsumed_tail, 1) if not stream.eof else b""
    except zlib.error as error:
        raise malformed(path, f"gzip data of an SPZ file: {reason(error)}") from error
    wanted = f"{body} bytes for {header.count} Gaussians of degree {header.degree}"
    enough = len(content) == body
    expect(enough, path, f"{wanted}, got {len(content)}: the file is truncated")
    expect(not more or header.flags & _EXTENSIONS, path, f"{wanted}, got more")
    expect(more or stream.eof, path, "gzip data with their check sum, got none: truncated")
    view = memoryview(content)
    parts: list[memoryview] = []
    for size in header.sizes:
        parts.append(view[: size * header.count])
        view = view[size * header.count :]
    return header, parts


def _unpack_zstd(path: Path, data: bytes) -> tuple[_Header, list[memoryview]]:
    """The attributes of version 4."""
    import zstandard

    header = _header(path, data)
    expect(header.version == 4, path, f"SPZ version 4 outside gzip, got {header.version}")
    streams = f"{len(header.sizes)} streams for degree {header.degree}, got {header.streams}"
    expect(header.streams == len(header.sizes), path, streams)
    start = _HEADER.size + _HEADER_4.size
    expect(len(data) >= start, path, f"a header of {start} bytes, got {len(data)}: truncated")
    (table,) = _HEADER_4.unpack_from(data, _HEADER.size)
    at = table + _STREAM.size * header.streams
    what = f"a table of streams within the file of {len(data)} bytes, got one at byte {table}"
    expect(start <= table and at <= len(data), path, what)
    check_size(path, header.count, header.degree, packed=len(data))
    entries = [_STREAM.unpack_from(data, table + i * _STREAM.size) for i in range(header.streams)]
    end = at + sum(compressed for compressed, _ in entries)
    fault = "truncated" if end > len(data) else "too long"
    what = f"{end} bytes as its table of streams says, got {len(data)}: the file is {fault}"
    expect(end == len(data), path, what)
    parts: list[memoryview] = []
    for i, ((compressed, unpacked), size) in enumerate(zip(entries, header.sizes, strict=True)):
        wanted = f"{size * header.count} bytes in stream {i} for {header.count} Gaussians"
        expect(unpacked == size * header.count, path, f"{wanted}, got {unpacked}")
        try:
            reader = zstandard.ZstdDecompressor().stream_reader(data[at : at + compressed])
            part = reader.read(unpacked) if unpacked else b""
            more = reader.read(1)
        except zstandard.ZstdError as error:
            raise FileFormatError(
                f"{path}: stream {i} is no zstd data: {reason(error)}."
            ) from error
        at += compressed
        came = "more" if more else len(part)
        expect(len(part) == unpacked and not more, path, f"{wanted}, got {came}")
        parts.append(memoryview(part))
    return header, parts


def _positions(packed: NDArray[np.uint8], fractional_bits: int) -> Array:
    """Positions (n, 3) from 24-bit two's complement fixed point."""
    wide = np.zeros((len(packed), 3, 4), np.uint8)
    wide[:, :, 1:] = packed.reshape(-1, 3, 3)
    fixed = wide.view("<i4")[:, :, 0] >> 8  # the shift carries the sign down
    return (fixed / float(1 << fractional_bits)).astype(np.float32)


def _rotations(packed: NDArray[np.uint8], version: int) -> NDArray[np.float64]:
    """Quaternions wxyz; version 2 has x, y and z in a byte each and w not negative."""
    if version >= 3:
        return unpack_signed_three(np.ascontiguousarray(packed).view("<u4")[:, 0])
    xyz = packed / 127.5 - 1.0
    w = np.sqrt(np.maximum(0.0, 1.0 - np.square(xyz).sum(axis=1)))
    return np.concatenate([w[:, None], xyz], axis=1)


def write_spz(gaussians: Gaussians, path: Path, *, losses: Losses, version: Literal[3, 4]) -> None:
    """Write an SPZ file of version 3 or 4, rows in the order they have.

    Positions get as many fractional bits as the largest coordinate leaves room for, up to
    20; harmonics get all eight bits that the format has.

    Raises:
        RangeError: If a coordinate is beyond 2^23 or a row cannot be rendered.
    """
    rows = to_rows(gaussians)
    bits = _fractional_bits(rows.means)
    streams = _pack(rows, bits, losses)
    header = _HEADER.pack(
        MAGIC,
        version,
        len(gaussians),
        gaussians.sh_degree,
        bits,
        _ANTIALIASED if gaussians.antialiased else 0,
        len(streams) if version == 4 else 0,
    )
    if version == 3:
        gzip = zlib.compressobj(6, wbits=31)
        with path.open("wb") as file:
            for part in (header, *streams):
                file.write(gzip.compress(part))
            file.write(gzip.flush())
        return
    import zstandard

    frames = [zstandard.ZstdCompressor(level=9).compress(stream) for stream in streams]
    with path.open("wb") as file:
        file.write(header + _HEADER_4.pack(_HEADER.size + _HEADER_4.size))
        for frame, stream in zip(frames, streams, strict=True):
            file.write(_STREAM.pack(len(frame), len(stream)))
        for frame in frames:
            file.write(frame)


def _fractional_bits(means: Array) -> int:
    """How many bits after the point fit beside the largest coordinate in 24 bits."""
    largest = float(np.abs(means).max(initial=0.0))
    for bits in range(20, -1, -1):
        if np.floor(largest * 2.0**bits + 0.5) < 1 << 23:
            return bits
    raise RangeError(
        f"means: expected coordinates below {1 << 23} for an SPZ file, got {largest:g}."
    )


def _pack(rows: Rows, bits: int, losses: Losses) -> list[bytes]:
    """The uncompressed streams in file order."""
    count, coefficients = rows.sh.shape[:2]
    positions = np.empty((count, 3, 3), np.uint8)
    opacities = np.empty(count, np.uint8)
    colours = np.empty((count, 3), np.uint8)
    scales = np.empty((count, 3), np.uint8)
    rotations = np.empty(count, "<u4")
    rest = np.empty((count, coefficients - 1, 3), np.uint8)

    def clamped(name: str, values: NDArray[np.floating]) -> NDArray[np.uint32]:
        steps, outside = unsigned(values, 255)
        losses.clamp(name, outside)
        return steps

    signs = _FLIP_SH[: coefficients - 1, None]
    for part in blocks(count):
        fixed = np.floor(rows.means[part] * _FLIP * 2.0**bits + 0.5).astype("<i4")
        positions[part] = fixed[:, :, None].view(np.uint8)[:, :, :3]
        opacities[part] = unsigned(rows.opacities[part] * 255.0, 255)[0]
        colours[part] = clamped("colours", (rows.sh[part, 0] * _COLOUR_SCALE + 0.5) * 255.0)
        scales[part] = clamped("scales", (logs(rows.scales[part]) + 10.0) * 16.0)
        rotations[part] = pack_signed_three(rows.rotations[part] * _FLIP_ROTATION)
        rest[part] = clamped("harmonics", rows.sh[part, 1:] * signs * 128.0 + 128.0)
    arrays = [positions, opacities, colours, scales, rotations, rest]
    return [array.tobytes() for array in (arrays if coefficients > 1 else arrays[:5])]
