"""The ``.splat`` layout of the first web viewers: 32 bytes a Gaussian and no header.

Three float32 of position, three float32 of scale (linear), four bytes red, green, blue and
opacity (value / 255), four bytes of the quaternion (w, x, y, z) as (byte - 128) / 128.
There are no harmonics beyond the mean colour.
"""

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatseg.core import Gaussians
from splatseg.core.sh import SH_C0
from splatseg.errors import FileFormatError, InputError
from splatseg.io.splats._rows import (
    Array,
    Losses,
    Rows,
    blocks,
    check_file,
    finish,
    read_file,
    to_rows,
    unsigned,
)

_ROW = np.dtype(
    [
        ("mean", "<f4", 3),
        ("scale", "<f4", 3),
        ("colour", "u1", 4),
        ("rotation", "u1", 4),
    ]
)


def read_splat(path: Path, *, strict: bool = False) -> Gaussians:
    """Read a ``.splat`` file.

    Raises:
        FileFormatError: If its length is no multiple of 32 bytes or a row cannot be rendered.
        MissingFileError: If there is no such file.
    """
    size = check_file(path)
    count, left = divmod(size, _ROW.itemsize)
    if left:
        raise FileFormatError(
            f"{path}: expected a multiple of {_ROW.itemsize} bytes, one row a Gaussian, "
            f"got {size} bytes: the file is truncated or no .splat file."
        )
    rows = Rows.empty(count, 1)
    with path.open("rb") as file:
        for part in blocks(count):
            block = np.fromfile(file, _ROW, part.stop - part.start)
            rows.means[part] = block["mean"]
            rows.scales[part] = block["scale"]
            rows.sh[part, 0] = (block["colour"][:, :3] / 255 - 0.5) / SH_C0
            rows.opacities[part] = block["colour"][:, 3] / 255
            rows.rotations[part] = (block["rotation"].astype(np.float32) - 128) / 128
    return finish(path, rows, strict=strict)


def write_splat(gaussians: Gaussians, path: Path, *, losses: Losses) -> None:
    """Write a ``.splat`` file, rows in the order they have.

    Raises:
        InputError: If there are no Gaussians: such a file would be empty.
        RangeError: If a row cannot be rendered.
    """
    if len(gaussians) == 0:
        raise InputError("gaussians: a .splat file cannot hold a scene without Gaussians.")
    rows = to_rows(gaussians)
    if gaussians.sh_degree:
        losses.drop("harmonics above degree 0")
    losses.drop_extra(gaussians)
    losses.drop_antialiased(gaussians)
    losses.drop_low_pass(gaussians)
    with path.open("wb") as file:
        for part in blocks(len(gaussians)):
            block = np.empty(part.stop - part.start, _ROW)
            block["mean"] = rows.means[part]
            block["scale"] = rows.scales[part]
            colours, outside = unsigned((rows.sh[part, 0] * SH_C0 + 0.5) * 255, 255)
            losses.clamp("colours", outside)
            block["colour"][:, :3] = colours
            block["colour"][:, 3] = unsigned(rows.opacities[part] * 255, 255)[0]
            block["rotation"] = unsigned(rows.rotations[part] * 128 + 128, 255)[0]
            file.write(block.tobytes())


# The ``.ksplat`` layout of the viewer GaussianSplats3D: sections of rows of one size.
#
# A header of 4096 bytes, a header of 1024 bytes a section, then the sections. A row is position,
# scale (linear), quaternion (w, x, y, z), four bytes red, green, blue, opacity, and harmonics up to
# degree 2, channel by channel within a degree. Compression level 0 has float32 throughout; levels
# 1 and 2 have float16, positions as 16-bit steps about the centre of a bucket of rows, and level 2
# has harmonics of a byte between two bounds of the file. See docs/formats/splats.md.


_HEADER_BYTES = 4096
_SECTION_BYTES = 1024
_VERSION = (0, 1)

_COUNTS = struct.Struct("<4I")
"""At byte 4 of the file: sections that there is room for, sections, the same of Gaussians."""

_SECTION = struct.Struct("<4IfH2xI4xIIH")
"""Gaussians, room for Gaussians, size and number of buckets, edge of a bucket, bytes of a
bucket, steps to the side of its centre, full buckets, other buckets, degree of harmonics."""

_DEFAULT_BOUNDS = (-1.5, 1.5)
_DEFAULT_STEPS = 32767
_CENTRE_BYTES = 12
_MAX_DEGREE = 2

Row = NDArray[np.void]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Section:
    count: int
    room: int
    bucket_size: int
    buckets: int
    edge: float
    bucket_bytes: int
    steps: int
    full: int
    partial: int
    degree: int

    @property
    def coefficients(self) -> int:
        """Harmonics a channel beyond the mean colour."""
        return (self.degree + 1) ** 2 - 1


def read_ksplat(path: Path, *, strict: bool = False) -> Gaussians:
    """Read a ``.ksplat`` file of version 0.1, of any compression level.

    Raises:
        FileFormatError: If the version or level is another, the file's length is not what its
            headers say, its buckets do not hold its rows, or a row cannot be rendered.
        MissingFileError: If there is no such file.
    """
    data = read_file(path)
    if len(data) < _HEADER_BYTES:
        raise FileFormatError(
            f"{path}: expected a .ksplat header of {_HEADER_BYTES} bytes, got {len(data)}."
        )
    if tuple(data[:2]) != _VERSION:
        raise FileFormatError(
            f"{path}: expected .ksplat version 0.1, got {data[0]}.{data[1]}: another version, or "
            "no .ksplat file."
        )
    (level,) = struct.unpack_from("<H", data, 20)
    if level > 2:
        raise FileFormatError(f"{path}: expected compression level 0, 1 or 2, got {level}.")
    low, high = struct.unpack_from("<2f", data, 36)
    bounds = (low or _DEFAULT_BOUNDS[0], high or _DEFAULT_BOUNDS[1])
    sections = _sections(path, data, level)
    degree = max((section.degree for section in sections), default=0)
    rows = Rows.empty(sum(section.count for section in sections), (degree + 1) ** 2)
    at, start = _HEADER_BYTES + _SECTION_BYTES * _COUNTS.unpack_from(data, 4)[0], 0
    for section in sections:
        table = 4 * section.partial + section.bucket_bytes * section.buckets
        row = _row_type(level, section.degree)
        packed = np.frombuffer(data, row, section.count, at + table)
        _fill(rows, start, packed, section, bounds)
        if level:
            centres = _bucket_centres(path, data, at, section)
            half = section.edge / 2 / section.steps
            part = rows.means[start : start + section.count]
            part[:] = (packed["mean"].astype(np.float64) - section.steps) * half + centres
        at += table + row.itemsize * section.room
        start += section.count
    return finish(path, rows, strict=strict)


def _sections(path: Path, data: bytes, level: int) -> list[_Section]:
    """The headers of the sections, after a check that they describe the file to the byte."""
    most, used, _, count = _COUNTS.unpack_from(data, 4)
    at = _HEADER_BYTES + _SECTION_BYTES * most
    if used > most or at > len(data):
        raise FileFormatError(
            f"{path}: its header promises {used} of {most} sections, which {len(data)} bytes "
            "cannot hold."
        )
    found: list[_Section] = []
    for index in range(most):
        n, room, size, buckets, edge, width, steps, full, partial, degree = _SECTION.unpack_from(
            data, _HEADER_BYTES + _SECTION_BYTES * index
        )
        section = _Section(
            count=n if index < used else 0,
            room=room,
            bucket_size=size,
            buckets=buckets,
            edge=edge,
            bucket_bytes=width,
            steps=steps or _DEFAULT_STEPS,
            full=full,
            partial=partial,
            degree=degree,
        )
        _check_section(path, index, section, level)
        at += 4 * partial + width * buckets + _row_type(level, degree).itemsize * room
        found.append(section)
    if at != len(data):
        raise FileFormatError(
            f"{path}: expected {at} bytes as its headers say, got {len(data)}: the file is "
            f"{'truncated' if at > len(data) else 'too long'}."
        )
    total = sum(section.count for section in found)
    if total != count:
        raise FileFormatError(
            f"{path}: expected {count} Gaussians as its header says, got {total} in its sections."
        )
    return found


def _check_section(path: Path, index: int, section: _Section, level: int) -> None:
    name = f"{path}: section {index}"
    if section.degree > _MAX_DEGREE:
        raise FileFormatError(
            f"{name}: expected harmonics of degree 0 to {_MAX_DEGREE}, got {section.degree}."
        )
    if section.count > section.room:
        raise FileFormatError(
            f"{name}: expected at most {section.room} Gaussians, got {section.count}."
        )
    if level and section.buckets and section.bucket_bytes != _CENTRE_BYTES:
        raise FileFormatError(
            f"{name}: expected buckets of {_CENTRE_BYTES} bytes, got {section.bucket_bytes}."
        )
    if level and section.full + section.partial != section.buckets:
        raise FileFormatError(
            f"{name}: expected {section.buckets} buckets, got {section.full} full ones and "
            f"{section.partial} others."
        )


def _row_type(level: int, degree: int) -> np.dtype[np.void]:
    """One Gaussian as it stands in the file."""
    number = "<f2" if level else "<f4"
    rest = ("<f4", "<f2", "u1")[level]
    return np.dtype(
        [
            ("mean", "<u2" if level else "<f4", 3),
            ("scale", number, 3),
            ("rotation", number, 4),
            ("colour", "u1", 4),
            ("rest", rest, 3 * ((degree + 1) ** 2 - 1)),
        ]
    )


def _fill(
    rows: Rows, start: int, packed: Row, section: _Section, bounds: tuple[float, float]
) -> None:
    """Everything of a section but compressed positions, which need the buckets."""
    for part in blocks(len(packed)):
        block, to = packed[part], slice(start + part.start, start + part.stop)
        rows.means[to] = block["mean"]
        rows.scales[to] = block["scale"]
        rows.rotations[to] = block["rotation"]
        rows.sh[to, 0] = (block["colour"][:, :3] / 255 - 0.5) / SH_C0
        rows.opacities[to] = block["colour"][:, 3] / 255
        rows.sh[to, 1:] = 0
        if section.degree:
            rows.sh[to, 1 : 1 + section.coefficients] = _harmonics(block["rest"], bounds)


def _harmonics(packed: NDArray[np.generic], bounds: tuple[float, float]) -> Array:
    """Harmonics (n, k, 3) from (n, 3 k): of each degree all red, then green, then blue."""
    values: Array = packed.astype(np.float32)
    if packed.dtype == np.uint8:
        low, high = bounds
        values = (values / 255 * (high - low) + low).astype(np.float32)
    degrees: list[Array] = []
    at = 0
    for width in (3, 5):
        if at < values.shape[1]:
            channels = values[:, at : at + 3 * width].reshape(-1, 3, width)
            degrees.append(channels.transpose(0, 2, 1))
            at += 3 * width
    return np.concatenate(degrees, axis=1)


def _bucket_centres(path: Path, data: bytes, at: int, section: _Section) -> NDArray[np.float32]:
    """The centre (n, 3) of the bucket of each row: full buckets first, then the others in order."""
    lengths = np.frombuffer(data, "<u4", section.partial, at).astype(np.int64)
    centres = np.frombuffer(data, "<f4", 3 * section.buckets, at + 4 * section.partial)
    full = min(section.full * section.bucket_size, section.count)
    held = section.full * section.bucket_size + int(lengths.sum())
    if held < section.count:
        raise FileFormatError(
            f"{path}: expected buckets of {section.count} Gaussians, got buckets of {held}."
        )
    buckets = np.empty(section.count, np.int64)
    if full:
        buckets[:full] = np.arange(full) // section.bucket_size
    ends = np.cumsum(lengths)
    rest = np.arange(section.count - full)
    buckets[full:] = section.full + np.searchsorted(ends, rest, side="right")
    return centres.reshape(-1, 3)[buckets]
