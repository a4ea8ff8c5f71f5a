"""The PLY layout of the original 3DGS code (Kerbl et al. 2023), with any further columns.

One row a Gaussian: ``x y z nx ny nz f_dc_0..2 f_rest_0.. opacity scale_0..2 rot_0..3``.
Scales are natural logs, opacities logits, quaternions (w, x, y, z). ``f_rest`` holds the
harmonics from degree 1 on, channel by channel: all of red, then green, then blue. Normals mean
nothing and are zero; other columns are kept as `Gaussians.extra`. See docs/formats/splats.md.
"""

import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import Gaussians
from splatseg.core.sh import MAX_DEGREE, SH_C0
from splatseg.errors import FileFormatError, InputError
from splatseg.io.splats._ply_columns import (
    DC,
    MEANS,
    REST,
    ROTATIONS,
    SCALES,
    Columns,
    find_columns,
)
from splatseg.io.splats._ply_header import PlyHeader, read_ply_header, read_rows
from splatseg.io.splats._rows import (
    BLOCK,
    Filter,
    Rows,
    blocks,
    finish,
    logits,
    logs,
    rendered_degree,
    to_rows,
    warn,
)

_NORMALS = ("nx", "ny", "nz")

_FLAT = 1e-3
"""Thickness of a surfel over its smaller scale. Seen from its edge it stays below a pixel until it
is a thousand pixels wide, as thin as 2DGS means it; its variance is 1e-6 of the smaller, above
float32's rounding (6e-8), so that the covariance keeps its rank and its normal."""

_JUDGED = 32
"""Gaussians from which on a file's values tell whether they are logs: of fewer all may be so by
chance."""

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


def read_ply(
    path: Path,
    *,
    strict: bool = False,
    linear: Collection[str] = (),
    own: bool = False,
) -> Gaussians:
    """Read Gaussians and their extra columns from a PLY file, binary or ASCII.

    Columns beyond those of Gaussians come back under their own name and type in
    `Gaussians.extra`; normals only if any of them is not zero.

    Args:
        path: The file.
        strict: Refuse rows that cannot be rendered instead of leaving them out.
        linear: Which of scales and opacities the file has as they are, not as logs and logits.
        own: Whether splatseg wrote it: nothing in it is doubted, and no column is a filter.

    Raises:
        FileFormatError: If the file is no PLY file, is longer or shorter than its header says,
            lacks a column of Gaussians, or holds a row that cannot be rendered.
        MissingFileError: If there is no such file.
    """
    header = read_ply_header(path)
    columns = find_columns(path, header, own=own)
    vertex = header.elements["vertex"]
    rendered_degree(path, MAX_DEGREE + 1 if columns.beyond else 0, strict=strict)
    others = [name for name in vertex.row.names or () if name not in columns.used]
    rows = Rows.empty(vertex.count, 1 + len(columns.rest) // 3)
    filters = np.zeros(vertex.count, np.float32)
    extra = {name: np.empty(vertex.count, vertex.row[name].newbyteorder("=")) for name in others}
    for part, block in read_rows(path, header, vertex, BLOCK // 4):
        _unpack(block, rows, part, columns)
        if columns.filter_3d is not None:
            filters[part] = block[columns.filter_3d]
        for name, column in extra.items():
            column[part] = block[name]
    if columns.coloured and bool((rows.sh[:, 0] > 0.5 / SH_C0 + 1e-3).any()):
        raise FileFormatError(
            f"{path}: expected real colours {' '.join(columns.dc)} in [0, 1], got larger ones."
        )
    bytes_of_alpha = vertex.row[columns.opacity[0]].kind == "u"
    asked = {*linear, *(["opacities"] if bytes_of_alpha else [])}
    if not own:
        _tell(path, rows, columns, asked)
    rows.exponentiate(scales="scales" not in asked, opacities="opacities" not in asked)
    if columns.filter_3d is not None:
        _smooth(rows, filters, axes=len(columns.scales))
    if len(columns.scales) == 2:
        rows.scales[:, 2] = _FLAT * rows.scales[:, :2].min(axis=1)
    drawn = Filter.from_comments(path, header.comments)
    return finish(path, rows, _restore(header, extra), strict=strict, drawn=drawn)


def _smooth(rows: Rows, filters: Float[np.ndarray, "rows"], *, axes: int) -> None:
    """Apply the 3D smoothing filter of Mip-Splatting (Yu et al. 2024, eq. 9) to values, in place.

    With scales s and the filter's width f, sqrt(s^2 + f^2) and the opacity times
    sqrt(prod s^2 / prod (s^2 + f^2)), the square root of the quotient of the determinants of the
    covariances before and after.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        before = rows.scales[:, :axes].astype(np.float64)
        after = np.hypot(before, filters.astype(np.float64)[:, None])
        share = np.divide(before, after, out=np.zeros_like(before), where=after != 0)
        rows.opacities[:] = rows.opacities * share.prod(axis=1)
        rows.scales[:, :axes] = after
        # A scale of minus infinity is no number: its row is found as any other.
        rows.scales[:, :axes][np.isneginf(before)] = -np.inf


def _tell(path: Path, rows: Rows, columns: Columns, linear: Collection[str]) -> None:
    """Warn of what was read otherwise than 3DGS would, and of what may be no log or logit."""
    said: list[str] = []
    if columns.renamed:
        said.append(f"read {', '.join(columns.renamed)}")
    if len(columns.scales) == 2:
        said.append(
            "surfels of 2DGS, which have two scales: made Gaussians that are flat along the third "
            f"axis, {_FLAT:g} times as thick as their smaller scale"
        )
    if columns.unordered:
        said.append(
            f"{columns.unordered[0]} and others look like harmonics and are kept as columns, as "
            "their names do not tell whether they go by coefficient or by channel"
        )
    if columns.filter_3d is not None:
        said.append(
            f"applied the 3D filter of Mip-Splatting ({columns.filter_3d}) to scales and opacities"
        )
    scales, opacities = rows.scales[:, : len(columns.scales)], rows.opacities
    sound = np.isfinite(opacities) & np.isfinite(scales).all(axis=1)
    if int(sound.sum()) >= _JUDGED:
        doubted: list[str] = []
        if "scales" not in linear and (scales[sound] > 0).all():
            doubted.append("scales")
            said.append("all scales are positive, as if they were never logs")
        low, high = opacities[sound].min(), opacities[sound].max()
        # One opacity for all may be any logit.
        if "opacities" not in linear and 0 <= low < high <= 1:
            doubted.append("opacities")
            said.append("all opacities lie in [0, 1], as if they were never logits")
        if doubted:
            said[-1] += f": `--linear {' '.join(doubted)}` reads them so"
    if said:
        warn(path, "; ".join(said) + ".")


def _unpack(block: np.ndarray, rows: Rows, part: slice, columns: Columns) -> None:
    """Copy the columns of Gaussians of some rows to where they belong."""
    for target, names in (
        (rows.means, columns.means),
        (rows.rotations, columns.rotations),
        (rows.scales, columns.scales),
        (rows.sh[:, 0], columns.dc),
    ):
        for i, name in enumerate(names):
            target[part, i] = _share(block[name])
    if columns.coloured:
        rows.sh[part, 0] = (rows.sh[part, 0] - 0.5) / SH_C0
    if len(columns.scales) == 2:
        rows.scales[part, 2] = 0
    rows.opacities[part] = _share(block[columns.opacity[0]])
    per_channel = len(columns.rest) // 3
    for i, name in enumerate(columns.rest):
        rows.sh[part, 1 + i % per_channel, i // per_channel] = block[name]


def _share(values: np.ndarray) -> np.ndarray:
    """Bytes and other integers of colours in [0, 1]; real numbers as they are."""
    return values if values.dtype.kind == "f" else values / np.iinfo(values.dtype).max


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
    standard = (*MEANS, *_NORMALS, *DC, *rest, "opacity", *SCALES, *ROTATIONS)
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
        (rows.means[part], MEANS),
        (rows.rotations[part], ROTATIONS),
        (logs(rows.scales[part]), SCALES),
        (rows.sh[part, 0], DC),
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
        if (name in standard and name not in allowed) or REST.fullmatch(name):
            raise InputError(f"extra[{name!r}]: PLY uses the name {name!r} for something else.")
