"""The layouts of web viewers: ``.splat`` (no header, 32 bytes a Gaussian) and ``.ksplat``.

``.splat``: three float32 of position, three of scale (linear), four bytes red, green, blue and
opacity (value / 255), four bytes of the quaternion (w, x, y, z) as (byte - 128) / 128; no
harmonics beyond the mean colour.

``.ksplat`` of GaussianSplats3D: a header of 4096 bytes, one of 1024 a section, then the sections. A
row is position, scale (linear), quaternion (w, x, y, z), four bytes red, green, blue, opacity, and
harmonics up to degree 2, channel by channel within a degree. Compression level 0 has float32
throughout; levels 1 and 2 have float16, positions as 16-bit steps about the centre of a bucket of
rows, and level 2 has harmonics of a byte between two bounds of the file. See
docs/formats/splats.md.
"""

import struct
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatseg.core import Gaussians
from splatseg.core.sh import SH_C0
from splatseg.errors import InputError
from splatseg.io.foreign import expect
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

_SPLAT = np.dtype(
    [("mean", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 4), ("rotation", "u1", 4)]
)


def read_splat(path: Path, *, strict: bool) -> Gaussians:
    """Read a ``.splat`` file.

    Raises:
        FileFormatError: If its length is no multiple of 32 bytes or a row cannot be rendered.
    """
    size = check_file(path)
    count, left = divmod(size, _SPLAT.itemsize)
    what = f"a multiple of {_SPLAT.itemsize} bytes, one row a Gaussian, got {size} bytes: the file "
    what += "is truncated or no .splat file"
    expect(not left, path, what)
    rows = Rows.empty(count, 1)
    with path.open("rb") as file:
        for part in blocks(count):
            block = np.fromfile(file, _SPLAT, part.stop - part.start)
            _fill(rows, part, block)
            rows.rotations[part] = (block["rotation"].astype(np.float32) - 128) / 128
    return finish(path, rows, strict=strict)


def _fill(rows: Rows, part: slice, block: NDArray[np.void]) -> None:
    """What rows of both layouts have alike."""
    rows.means[part] = block["mean"]
    rows.scales[part] = block["scale"]
    rows.sh[part, 0] = (block["colour"][:, :3] / 255 - 0.5) / SH_C0
    rows.opacities[part] = block["colour"][:, 3] / 255


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
    with path.open("wb") as file:
        for part in blocks(len(gaussians)):
            block = np.empty(part.stop - part.start, _SPLAT)
            block["mean"] = rows.means[part]
            block["scale"] = rows.scales[part]
            colours, outside = unsigned((rows.sh[part, 0] * SH_C0 + 0.5) * 255, 255)
            losses.clamp("colours", outside)
            block["colour"][:, :3] = colours
            block["colour"][:, 3] = unsigned(rows.opacities[part] * 255, 255)[0]
            block["rotation"] = unsigned(rows.rotations[part] * 128 + 128, 255)[0]
            file.write(block.tobytes())


_HEADER_BYTES = 4096
_SECTION_BYTES = 1024
_VERSION = (0, 1)

_COUNTS = struct.Struct("<4I")
"""At byte 4 of the file: sections that there is room for, sections, the same of Gaussians."""

_SECTION = struct.Struct("<4IfH2xI4xIIH")
"""The fields of `_Section` in their order."""

_DEFAULT_BOUNDS = (-1.5, 1.5)
_DEFAULT_STEPS = 32767
_CENTRE_BYTES = 12
_MAX_DEGREE = 2


@dataclass(frozen=True, slots=True)
class _Section:
    count: int
    room: int
    """Gaussians that there is room for."""

    bucket_size: int
    buckets: int
    edge: float
    """Of a bucket, scene units."""

    bucket_bytes: int
    steps: int
    """From the centre of a bucket to its side."""

    full: int
    """Buckets that are."""

    partial: int
    degree: int

    @property
    def coefficients(self) -> int:
        """Harmonics a channel beyond the mean colour."""
        return (self.degree + 1) ** 2 - 1

    @property
    def table_bytes(self) -> int:
        """Bytes of buckets before the rows."""
        return 4 * self.partial + self.bucket_bytes * self.buckets

    def row(self, level: int) -> np.dtype[np.void]:
        """One Gaussian as it stands in the file."""
        number = "<f2" if level else "<f4"
        return np.dtype(
            [
                ("mean", "<u2" if level else "<f4", 3),
                ("scale", number, 3),
                ("rotation", number, 4),
                ("colour", "u1", 4),
                ("rest", ("<f4", "<f2", "u1")[level], 3 * self.coefficients),
            ]
        )


def read_ksplat(path: Path, *, strict: bool) -> Gaussians:
    """Read a ``.ksplat`` file of version 0.1, of any compression level.

    Raises:
        FileFormatError: If the version or level is another, the file's length is not what its
            headers say, its buckets do not hold its rows, or a row cannot be rendered.
    """
    data = read_file(path)
    what = f"a .ksplat header of {_HEADER_BYTES} bytes, got {len(data)}"
    expect(len(data) >= _HEADER_BYTES, path, what)
    what = f".ksplat version 0.1, got {data[0]}.{data[1]}: another version, or no .ksplat file"
    expect(tuple(data[:2]) == _VERSION, path, what)
    (level,) = struct.unpack_from("<H", data, 20)
    expect(level <= 2, path, f"compression level 0, 1 or 2, got {level}")
    low, high = struct.unpack_from("<2f", data, 36)
    bounds = (low or _DEFAULT_BOUNDS[0], high or _DEFAULT_BOUNDS[1])
    at, sections = _sections(path, data, level)
    degree = max((section.degree for section in sections), default=0)
    rows = Rows.empty(sum(section.count for section in sections), (degree + 1) ** 2)
    start = 0
    for section in sections:
        row = section.row(level)
        packed = np.frombuffer(data, row, section.count, at + section.table_bytes)
        for part in blocks(len(packed)):
            block, to = packed[part], slice(start + part.start, start + part.stop)
            _fill(rows, to, block)
            rows.rotations[to] = block["rotation"]
            rows.sh[to, 1:] = 0
            if section.degree:
                rows.sh[to, 1 : 1 + section.coefficients] = _harmonics(block["rest"], bounds)
        if level:
            centres = _bucket_centres(path, data, at, section)
            half = section.edge / 2 / section.steps
            means = rows.means[start : start + section.count]
            means[:] = (packed["mean"].astype(np.float64) - section.steps) * half + centres
        at += section.table_bytes + row.itemsize * section.room
        start += section.count
    return finish(path, rows, strict=strict)


def _sections(path: Path, data: bytes, level: int) -> tuple[int, list[_Section]]:
    """Where sections begin, and their headers, which describe the file to the byte."""
    most, used, _, count = _COUNTS.unpack_from(data, 4)
    first = at = _HEADER_BYTES + _SECTION_BYTES * most
    what = f"a file of {used} of {most} sections as its header says, got {len(data)} bytes"
    expect(used <= most and at <= len(data), path, what)
    found: list[_Section] = []
    for index in range(most):
        fields = _SECTION.unpack_from(data, _HEADER_BYTES + _SECTION_BYTES * index)
        section = _Section(*fields)
        section = replace(
            section,
            count=section.count if index < used else 0,
            steps=section.steps or _DEFAULT_STEPS,
        )
        _check_section(f"{path}: section {index}", section, level)
        at += section.table_bytes + section.row(level).itemsize * section.room
        found.append(section)
    fault = "truncated" if at > len(data) else "too long"
    what = f"{at} bytes as its headers say, got {len(data)}: the file is {fault}"
    expect(at == len(data), path, what)
    total = sum(section.count for section in found)
    what = f"{count} Gaussians as its header says, got {total} in its sections"
    expect(total == count, path, what)
    return first, found


def _check_section(where: str, section: _Section, level: int) -> None:
    degrees = f"harmonics of degree 0 to {_MAX_DEGREE}, got {section.degree}"
    expect(section.degree <= _MAX_DEGREE, where, degrees)
    fits = section.count <= section.room
    expect(fits, where, f"at most {section.room} Gaussians, got {section.count}")
    if not level:
        return
    centres = not section.buckets or section.bucket_bytes == _CENTRE_BYTES
    expect(centres, where, f"buckets of {_CENTRE_BYTES} bytes, got {section.bucket_bytes}")
    what = f"{section.buckets} buckets, got {section.full} full ones and {section.partial} others"
    expect(section.full + section.partial == section.buckets, where, what)


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
    what = f"buckets of {section.count} Gaussians, got buckets of {held}"
    expect(held >= section.count, path, what)
    buckets = np.empty(section.count, np.int64)
    if full:
        buckets[:full] = np.arange(full) // section.bucket_size
    rest = np.arange(section.count - full)
    buckets[full:] = section.full + np.searchsorted(np.cumsum(lengths), rest, side="right")
    return centres.reshape(-1, 3)[buckets]
