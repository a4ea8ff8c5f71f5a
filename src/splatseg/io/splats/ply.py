"""The PLY layout of the original 3DGS code (Kerbl et al. 2023), with any further columns.

One row a Gaussian: ``x y z nx ny nz f_dc_0..2 f_rest_0.. opacity scale_0..2 rot_0..3``.
Scales are natural logs, opacities logits, quaternions (w, x, y, z). ``f_rest`` holds the
harmonics from degree 1 on, channel by channel: all of red, then green, then blue. Normals mean
nothing and are zero; other columns are kept as `Gaussians.extra`. See docs/formats/splats.md.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from splatseg.core import Gaussians
from splatseg.core.sh import MAX_DEGREE
from splatseg.errors import FileFormatError, InputError
from splatseg.io.splats._common import (
    BLOCK,
    Filter,
    Rows,
    blocks,
    finish,
    logits,
    logs,
    to_rows,
)
from splatseg.io.splats._ply_header import PlyHeader, read_ply_header

_MEANS = ("x", "y", "z")
_NORMALS = ("nx", "ny", "nz")
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALES = ("scale_0", "scale_1", "scale_2")
_ROTATIONS = ("rot_0", "rot_1", "rot_2", "rot_3")
_REQUIRED = (*_MEANS, *_DC, "opacity", *_SCALES, *_ROTATIONS)
_REST = re.compile(r"f_rest_(0|[1-9]\d*)")

_STORED = {
    torch.float32: "<f4",
    torch.float64: "<f8",
    torch.uint8: "|u1",
    torch.int8: "|i1",
    torch.uint16: "<u2",
    torch.int16: "<i2",
    torch.uint32: "<u4",
    torch.int32: "<i4",
}
"""Types that a PLY column has."""

_CONVERTED = {
    torch.bool: torch.uint8,
    torch.float16: torch.float32,
    torch.bfloat16: torch.float32,
    torch.int64: torch.int32,
}
"""Types that PLY lacks and the type they are stored as; a comment in the header says so."""

_NAMES = {"<f4": "float", "<f8": "double", "|u1": "uchar", "|i1": "char"} | {
    "<u2": "ushort",
    "<i2": "short",
    "<u4": "uint",
    "<i4": "int",
}

_DIGITS = 6
"""Of the components of a column, far more than a header has room for."""

_NOTE = "splatseg column"
"""Comment lines ``splatseg column NAME COMPONENTS TYPE`` restore columns that PLY cannot say:
those of several components (0 stands for a plain column) and those of a type it lacks."""


def read_ply(path: Path) -> Gaussians:
    """Read Gaussians and their extra columns from a binary PLY file.

    Columns beyond the standard ones come back under their own name and type in
    `Gaussians.extra`; normals only if any of them is not zero.

    Raises:
        FileFormatError: If the file is no binary PLY, is longer or shorter than its header
            says, lacks a column of Gaussians, or holds a row that cannot be rendered.
        MissingFileError: If there is no such file.
    """
    header = read_ply_header(path)
    vertex = header.elements.get("vertex")
    names = list(vertex.row.names or ()) if vertex else []
    missing = [name for name in _REQUIRED if name not in names]
    if vertex is None or missing:
        raise FileFormatError(
            f"{path}: expected Gaussians, got a PLY file without {', '.join(missing)}"
            f"{': a point cloud' if set(_MEANS) <= set(names) else ''}."
        )
    rest = _rest_columns(path, names)
    _check_types(path, vertex.row, rest)
    others = [name for name in names if name not in _REQUIRED and name not in rest]
    rows = Rows.empty(vertex.count, 1 + len(rest) // 3)
    extra = {name: np.empty(vertex.count, vertex.row[name].newbyteorder("=")) for name in others}
    with path.open("rb") as file:
        file.seek(vertex.offset)
        for part in blocks(vertex.count, BLOCK // 4):
            block = np.fromfile(file, vertex.row, part.stop - part.start)
            _unpack(block, rows, part, rest)
            for name, column in extra.items():
                column[part] = block[name]
    rows.exponentiate()
    drawn = Filter.from_comments(path, header.comments)
    return finish(path, rows, _restore(header, extra), drawn=drawn)


def _rest_columns(path: Path, names: Sequence[str]) -> list[str]:
    """The names of the harmonics from degree 1 on, in order."""
    count = sum(_REST.fullmatch(name) is not None for name in names)
    rest = [f"f_rest_{i}" for i in range(count)]
    known = [3 * ((degree + 1) ** 2 - 1) for degree in range(MAX_DEGREE + 1)]
    if count not in known or not set(rest) <= set(names):
        raise FileFormatError(
            f"{path}: expected {', '.join(map(str, known[:-1]))} or {known[-1]} columns f_rest_0, "
            f"f_rest_1 and so on, got {count}."
        )
    return rest


def _check_types(path: Path, row: np.dtype[np.void], rest: Sequence[str]) -> None:
    """Refuse integers where Gaussians have real numbers: they would need a scale to read."""
    for name in (*_REQUIRED, *rest):
        if row[name].kind != "f":
            raise FileFormatError(
                f"{path}: expected the PLY column {name} to be float or double, got {row[name]}."
            )


def _unpack(block: np.ndarray, rows: Rows, part: slice, rest: Sequence[str]) -> None:
    """Copy the standard columns of some rows to where they belong."""
    for target, names in (
        (rows.means, _MEANS),
        (rows.rotations, _ROTATIONS),
        (rows.scales, _SCALES),
        (rows.sh[:, 0], _DC),
    ):
        for i, name in enumerate(names):
            target[part, i] = block[name]
    rows.opacities[part] = block["opacity"]
    per_channel = len(rest) // 3
    for i, name in enumerate(rest):
        rows.sh[part, 1 + i % per_channel, i // per_channel] = block[name]


def _restore(header: PlyHeader, columns: Mapping[str, np.ndarray]) -> dict[str, Tensor]:
    """Extra columns as they were in memory, by the notes in the header's comments."""
    left = {name: torch.from_numpy(column) for name, column in columns.items()}
    if all(name in left and not columns[name].any() for name in _NORMALS):
        for name in _NORMALS:
            del left[name]
    types = {str(kind).removeprefix("torch."): kind for kind in (*_STORED, *_CONVERTED)}
    extra: dict[str, Tensor] = {}
    for comment in header.comments:
        words = comment.removeprefix(_NOTE).split()
        if not comment.startswith(_NOTE) or len(words) != 3 or words[2] not in types:
            continue
        name, components, kind = words
        if not components.isdecimal() or len(components) > _DIGITS or int(components) > len(left):
            continue  # more than there are
        parts = [name] if components == "0" else [f"{name}_{i}" for i in range(int(components))]
        if parts and all(part in left for part in parts):  # else an editor dropped some
            values = [left.pop(part).to(types[kind]) for part in parts]
            extra[name] = values[0] if components == "0" else torch.stack(values, dim=1)
    return extra | left


def write_ply(gaussians: Gaussians, path: Path) -> None:
    """Write Gaussians and their extra columns as a binary little-endian PLY file.

    Raises:
        InputError: If an extra column has a name or a type that PLY cannot hold.
        RangeError: If a row cannot be rendered.
    """
    rows = to_rows(gaussians)
    extra, notes = _flatten(gaussians.extra)
    notes = [*Filter.of(gaussians).comments(), *notes]
    coefficients = rows.sh.shape[1] - 1
    rest = [f"f_rest_{i}" for i in range(3 * coefficients)]
    standard = (*_MEANS, *_NORMALS, *_DC, *rest, "opacity", *_SCALES, *_ROTATIONS)
    _check_names(extra, standard)
    normals = all(name in extra for name in _NORMALS)
    fields = [(name, "<f4") for name in standard]
    fields += [
        (name, column.dtype.str)
        for name, column in extra.items()
        if not (normals and name in _NORMALS)
    ]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {note}" for note in notes),
    ]
    header += [f"element vertex {len(gaussians)}"]
    header += [f"property {_NAMES[kind]} {name}" for name, kind in fields]
    with path.open("wb") as file:
        file.write("\n".join([*header, "end_header\n"]).encode("ascii"))
        for part in blocks(len(gaussians), BLOCK // 4):
            block = np.zeros(part.stop - part.start, np.dtype(fields))
            _pack(block, rows, part, coefficients)
            for name, column in extra.items():
                block[name] = column[part]
            file.write(block.tobytes())


def _pack(block: np.ndarray, rows: Rows, part: slice, coefficients: int) -> None:
    """Copy some rows into a block of the file's layout."""
    for source, names in (
        (rows.means[part], _MEANS),
        (rows.rotations[part], _ROTATIONS),
        (logs(rows.scales[part]), _SCALES),
        (rows.sh[part, 0], _DC),
    ):
        for i, name in enumerate(names):
            block[name] = source[:, i]
    block["opacity"] = logits(rows.opacities[part])
    for i in range(3 * coefficients):
        block[f"f_rest_{i}"] = rows.sh[part, 1 + i % coefficients, i // coefficients]


def _flatten(extra: Mapping[str, Tensor]) -> tuple[dict[str, np.ndarray], list[str]]:
    """Plain columns in types that PLY has, and the notes that restore what they were."""
    columns: dict[str, np.ndarray] = {}
    notes: list[str] = []
    for name, tensor in extra.items():
        kind = tensor.dtype
        values = tensor.detach().cpu()
        if kind in _CONVERTED:
            values = values.to(_CONVERTED[kind])
            if kind == torch.int64 and not torch.equal(values.to(kind), tensor.detach().cpu()):
                raise InputError(
                    f"extra[{name!r}]: expected values that fit into 32 bits, as PLY has no "
                    f"longer integers, got {int(tensor.min())} to {int(tensor.max())}."
                )
        elif kind not in _STORED:
            raise InputError(f"extra[{name!r}]: PLY has no columns of type {kind}.")
        array = values.numpy()
        components = 0 if array.ndim == 1 else array.shape[1]
        if array.ndim == 2 and components == 0:
            raise InputError(f"extra[{name!r}]: expected at least one component, got none.")
        if components or kind in _CONVERTED:
            notes.append(f"{_NOTE} {name} {components} {str(kind).removeprefix('torch.')}")
        parts = (
            {name: array}
            if not components
            else {f"{name}_{i}": array[:, i] for i in range(components)}
        )
        for part, column in parts.items():
            if part in columns:
                raise InputError(f"extra[{name!r}]: the column name {part!r} is taken.")
            columns[part] = column
    return columns, notes


def _check_names(extra: Mapping[str, np.ndarray], standard: Sequence[str]) -> None:
    """Refuse names that a reader would take for something else."""
    normals = {name: extra[name].dtype for name in _NORMALS if name in extra}
    allowed = _NORMALS if list(normals.values()) == [np.dtype("f4")] * 3 else ()
    for name in extra:
        if not re.fullmatch(r"[!-~]+", name):
            raise InputError(
                f"extra[{name!r}]: expected a name of printable ASCII without spaces, as PLY needs."
            )
        if (name in standard and name not in allowed) or _REST.fullmatch(name):
            raise InputError(f"extra[{name!r}]: PLY uses the name {name!r} for something else.")
