"""SuperSplat's compressed PLY: 16 bytes a Gaussian, positions relative to chunks of 256.

Element ``chunk`` has, for each 256 Gaussians, the least and greatest position, log of scale
and (in newer files) colour, float32. Element ``vertex`` has four uint32: position and log of
scale as 11 + 10 + 11 bits between those bounds, the quaternion as the index of its largest
component (2 bits) and the other three (10 bits each, times sqrt 2), and red, green, blue and
opacity as bytes. Element ``sh``, where there are harmonics, has a byte for each ``f_rest``
column, which spans [-4, 4]. See docs/formats/splats.md.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg.core import Gaussians
from splatseg.core.sh import MAX_DEGREE, SH_C0
from splatseg.errors import FileFormatError, quoted
from splatseg.io.foreign import expect
from splatseg.io.ply import PlyElement, PlyHeader, ply_header, read_ply_header, read_ply_tables
from splatseg.io.splats._quantisation import pack_smallest_three, unpack_smallest_three
from splatseg.io.splats._rows import (
    Array,
    Losses,
    Rows,
    blocks,
    drawing_comments,
    drawn_as,
    finish,
    logs,
    to_rows,
    unsigned,
)

CHUNK = 256
"""Gaussians that share one set of bounds."""

_BITS = np.array([11, 10, 11])
_SHIFTS = np.array([21, 11, 0], np.uint32)
_BYTE_SHIFTS = np.array([24, 16, 8, 0], np.uint32)

_MIN_MAX = tuple(
    f"{end}_{what}"
    for group in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for end in ("min", "max")
    for what in group
)
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_LOG_SCALE_RANGE = 20.0
"""Logs of scales are clamped to +- this, as SuperSplat does: exp(-20) is invisible."""


def is_compressed(header: PlyHeader) -> bool:
    """Whether a PLY file has the elements and columns of this layout."""
    vertex = header.element("vertex")
    return vertex is not None and "packed_position" in vertex.names


def read_compressed_ply(path: Path, *, strict: bool) -> Gaussians:
    """Read a compressed PLY file.

    Raises:
        FileFormatError: If an element or column is missing or of another type, if the number
            of chunks or harmonics does not fit, or if a row cannot be rendered.
        MissingFileError: If there is no such file.
    """
    header = read_ply_header(path)
    vertex, chunk, sh = _elements(path, header)
    names = sh.names if sh else ()
    rows = Rows.empty(vertex.count, 1 + len(names) // 3)
    tables = read_ply_tables(path, header, ("chunk", "vertex", "sh"), whole=True)
    packed = tables["vertex"].numbers
    for part in blocks(vertex.count, 64 * CHUNK):
        block = {name: packed[name][part] for name in _PACKED}
        chunks = np.arange(part.start, part.stop) // CHUNK
        of_row = {name: ends[chunks] for name, ends in tables["chunk"].numbers.items()}
        position = _fractions(block["packed_position"])
        rows.means[part] = _between(position, of_row, ("x", "y", "z"))
        scale = _fractions(block["packed_scale"])
        rows.scales[part] = _between(scale, of_row, ("scale_x", "scale_y", "scale_z"))
        rows.rotations[part] = unpack_smallest_three(block["packed_rotation"])
        colour = ((block["packed_color"][:, None] >> _BYTE_SHIFTS) & 255) / 255
        rgb = colour[:, :3]
        if "min_r" in chunk.names:
            rgb = _between(rgb, of_row, ("r", "g", "b"))
        rows.sh[part, 0] = (rgb - 0.5) / SH_C0
        rows.opacities[part] = colour[:, 3]
        if sh is not None:
            steps = np.stack([tables["sh"].numbers[name][part] for name in names], axis=1)
            steps = steps.reshape(-1, 3, len(names) // 3)
            rows.sh[part, 1:] = _HARMONIC[steps].transpose(0, 2, 1)
    with np.errstate(over="ignore"):
        np.exp(rows.scales, out=rows.scales)
    return finish(path, rows, strict=strict, **drawn_as(path, header.comments))


def _harmonic_of_byte() -> Array:
    """The coefficient that each byte stands for: the middle of its step, the ends exactly."""
    share = (np.arange(256) + 0.5) / 256
    share[[0, 255]] = 0, 1
    return ((share - 0.5) * 8).astype(np.float32)


_HARMONIC = _harmonic_of_byte()


def _elements(path: Path, header: PlyHeader) -> tuple[PlyElement, PlyElement, PlyElement | None]:
    """The vertex, chunk and sh elements, checked."""
    vertex, chunk, sh = (header.element(name) for name in ("vertex", "chunk", "sh"))
    lists = any(one.lists for one in header.elements)
    what = "a compressed PLY file in binary and without lists, got another"
    expect(header.order and not lists, path, what)
    if vertex is None or chunk is None:
        names = quoted(", ".join(one.name for one in header.elements) or "none")
        raise FileFormatError(
            f"{path}: expected the elements chunk and vertex of a compressed PLY file, got {names}."
        )
    _check_columns(path, vertex, _PACKED, "u4")
    coloured = any(name in chunk.names for name in _MIN_MAX[12:])
    _check_columns(path, chunk, _MIN_MAX if coloured else _MIN_MAX[:12], "f4")
    chunks = -(-vertex.count // CHUNK)
    what = f"{chunks} chunks for {vertex.count} Gaussians, got {chunk.count}"
    expect(chunk.count == chunks, path, what)
    if sh is not None:
        known = [3 * ((degree + 1) ** 2 - 1) for degree in range(1, MAX_DEGREE + 1)]
        what = f"{vertex.count} rows of 9, 24 or 45 harmonics, got {sh.count} rows of "
        what += f"{len(sh.names)}"
        expect(len(sh.names) in known and sh.count == vertex.count, path, what)
        expected = tuple(f"f_rest_{i}" for i in range(len(sh.names)))
        _check_columns(path, sh, expected, "u1")
        expect(sh.names == expected, path, "the harmonics f_rest_0, ... in order")
    return vertex, chunk, sh


def _check_columns(path: Path, element: PlyElement, names: tuple[str, ...], code: str) -> None:
    """Refuse an element that lacks a column or has it in another type."""
    codes = {one.name: one.code for one in element.properties}
    wrong = [name for name in names if codes.get(name) != code]
    listed, got = quoted(", ".join(wrong), 100), quoted(", ".join(codes), 100)
    what = f"the columns {listed} of type {np.dtype(code)} in the element {quoted(element.name)}, "
    what += f"got {got}"
    expect(not wrong, path, what)


def _fractions(packed: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Three numbers in [0, 1] from 11, 10 and 11 bits, first in the top bits."""
    top = (1 << _BITS) - 1
    return ((packed[:, None] >> _SHIFTS) & top.astype(np.uint32)) / top


def _between(
    share: NDArray[np.float64], bounds: Mapping[str, NDArray[Any]], names: tuple[str, ...]
) -> NDArray[np.float64]:
    """Numbers between the bounds of their chunk."""
    low = np.stack([bounds[f"min_{name}"] for name in names], axis=1)
    high = np.stack([bounds[f"max_{name}"] for name in names], axis=1)
    return low * (1 - share) + high * share


def write_compressed_ply(gaussians: Gaussians, path: Path, *, losses: Losses) -> None:
    """Write a compressed PLY file. Gaussians are put in Morton order of their positions.

    The order is what makes chunks small and with them the steps of positions; `Gaussians`
    read back are a permutation of those written.

    Raises:
        RangeError: If a row cannot be rendered.
    """
    rows = to_rows(gaussians)
    count = len(gaussians)
    order = morton_order(rows.means)
    chunks = -(-count // CHUNK)
    bounds = np.empty((chunks, len(_MIN_MAX)), "<f4")
    packed = np.empty((count, len(_PACKED)), "<u4")
    for part in blocks(count, 64 * CHUNK):
        ids = order[part]
        of_chunk = slice(part.start // CHUNK, -(-part.stop // CHUNK))
        colours = rows.sh[ids, 0] * np.float32(SH_C0) + np.float32(0.5)
        scales = np.clip(logs(rows.scales[ids]), -_LOG_SCALE_RANGE, _LOG_SCALE_RANGE)
        top = (1 << _BITS) - 1
        position, bounds[of_chunk, 0:6] = _steps(rows.means[ids], top)
        packed[part, 0] = (position << _SHIFTS).sum(axis=1, dtype=np.uint32)
        packed[part, 1] = pack_smallest_three(rows.rotations[ids])
        scale, bounds[of_chunk, 6:12] = _steps(scales, top)
        packed[part, 2] = (scale << _SHIFTS).sum(axis=1, dtype=np.uint32)
        rgb, bounds[of_chunk, 12:18] = _steps(colours, np.array([255, 255, 255]))
        opacity = unsigned(rows.opacities[ids, None] * 255.0, 255)[0]
        rgba = np.concatenate([rgb, opacity], axis=1) << _BYTE_SHIFTS
        packed[part, 3] = rgba.sum(axis=1, dtype=np.uint32)
    with path.open("wb") as file:
        tables = [
            ("chunk", chunks, [(name, "<f4") for name in _MIN_MAX]),
            ("vertex", count, [(name, "<u4") for name in _PACKED]),
        ]
        rest = [(f"f_rest_{i}", "|u1") for i in range(3 * (rows.sh.shape[1] - 1))]
        tables += [("sh", count, rest)] if rest else []
        file.write(ply_header(tables, drawing_comments(gaussians)))
        file.write(bounds.tobytes())
        file.write(packed.tobytes())
        if rows.sh.shape[1] > 1:
            for part in blocks(count):
                file.write(_harmonic_bytes(rows.sh[order[part], 1:], losses))


def morton_order(means: Array) -> NDArray[np.int64]:
    """Row ids that visit points along a Z-shaped curve, so that neighbours are near.

    Each axis is cut into 1024 equal steps of the widest extent and the three numbers'
    bits interleave to one. Rows of one cell keep their order.
    """
    if len(means) == 0:
        return np.zeros(0, np.int64)
    low = means.min(axis=0).astype(np.float64)
    extent = float((means.max(axis=0) - low).max())
    code = np.zeros(len(means), np.uint32)
    for axis in range(3):
        cell = (means[:, axis] - low[axis]) * (1023 / extent if extent > 0 else 0.0)
        code |= _spread(cell.astype(np.uint32)) << np.uint32(axis)
    return np.argsort(code, kind="stable")


def _spread(numbers: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Move bit i of 10-bit numbers to bit 3 i."""
    result = np.zeros_like(numbers)
    for bit in range(10):
        result |= (numbers & np.uint32(1 << bit)) << np.uint32(2 * bit)
    return result


def _steps(values: Array, top: NDArray[np.int64]) -> tuple[NDArray[np.uint32], Array]:
    """Integers in [0, top] between each chunk's bounds, and the bounds (least, greatest)."""
    starts = np.arange(0, len(values), CHUNK)
    low = np.minimum.reduceat(values, starts, axis=0)
    high = np.maximum.reduceat(values, starts, axis=0)
    of_row = np.arange(len(values)) // CHUNK
    extent = (high.astype(np.float64) - low)[of_row]
    share = (values - low[of_row].astype(np.float64)) / np.where(extent > 0, extent, 1)
    return np.floor(share * top + 0.5).astype(np.uint32), np.concatenate([low, high], axis=1)


def _harmonic_bytes(sh: Array, losses: Losses) -> bytes:
    """Harmonics from degree 1 on as bytes, channel by channel; [-4, 4] is 256 steps."""
    steps = np.floor((sh / 8 + 0.5) * 256)
    losses.clamp("harmonics", (sh < -4) | (sh > 4))
    return np.clip(steps, 0, 255).astype(np.uint8).transpose(0, 2, 1).tobytes()
