"""The PLY layout of the original 3DGS code (Kerbl et al. 2023), with any further columns.

One row a Gaussian: ``x y z nx ny nz f_dc_0..2 f_rest_0.. opacity scale_0..2 rot_0..3``.
Scales are natural logs, opacities logits, quaternions (w, x, y, z). ``f_rest`` holds the
harmonics from degree 1 on, channel by channel: all of red, then green, then blue. Normals mean
nothing and are zero; other columns are kept as `Gaussians.extra`. Other programs call columns by
other names: a group of columns (all scales, all parts of the quaternion) goes by one row of
`_GROUPS` as a whole. See docs/formats/splats.md.
"""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import Gaussians
from splatseg.core.sh import MAX_DEGREE, SH_C0
from splatseg.errors import FileFormatError, InputError, brief, quoted
from splatseg.io.foreign import expect
from splatseg.io.ply import PlyElement, PlyHeader, ply_header, read_ply_tables
from splatseg.io.splats._rows import (
    BLOCK,
    Losses,
    Rows,
    blocks,
    drawing_comments,
    drawn_as,
    finish,
    logits,
    logs,
    rendered_degree,
    to_rows,
    warn,
)

_FLAT = 1e-3
"""Thickness of a surfel over its smaller scale. Seen from its edge it stays below a pixel until it
is a thousand pixels wide, as thin as 2DGS means it; its variance is 1e-6 of the smaller, above
float32's rounding (6e-8), so that the covariance keeps its rank and its normal."""

_JUDGED = 32
"""Gaussians from which on a file's values tell whether they are logs: of fewer all may be so by
chance."""


def _numbered(*prefixes: str, count: int) -> tuple[tuple[str, ...], ...]:
    return tuple(tuple(f"{prefix}_{i}" for i in range(count)) for prefix in prefixes)


def _lettered(*prefixes: str, letters: str) -> tuple[tuple[str, ...], ...]:
    return tuple(tuple(f"{prefix}{letter}" for letter in letters) for prefix in prefixes)


_GROUPS: dict[str, tuple[tuple[str, ...], ...]] = {
    "means": (
        ("x", "y", "z"),
        *_numbered("means", "mean", "xyz", "positions", "position", count=3),
    ),
    "dc": _numbered("f_dc", "features_dc", "sh0", "sh_dc", count=3),
    "opacity": (
        ("opacity",),
        ("opacities",),
        ("opacities_0",),
        ("opacity_0",),
        ("alpha",),
        ("alphas",),
    ),
    "scales": (
        *_numbered("scale", "scales", "scaling", "scalings", "log_scales", "log_scale", count=3),
        *_lettered("scale_", "s", letters="xyz"),
    ),
    "rotations": (
        *_numbered("rot", "rots", "rotation", "rotations", "quats", "quat", "q", count=4),
        *_lettered("rot_", "rotation_", "quat_", "q", letters="wxyz"),
    ),
}
"""Names of each group: those of 3DGS first, then parameters of 3DGS (``scaling``) and of gsplat
(``scales``, ``quats``, ``sh0``) written as they are called, and letters for axes."""

_OWN = {name: names[0] for name, names in _GROUPS.items()}
_COLOURS = (
    ("red", "green", "blue"),
    ("r", "g", "b"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
)
_NORMALS = ("nx", "ny", "nz")
_FILTERS = ("filter_3D", "filter_3d")
_REST = re.compile(r"f_rest_(0|[1-9]\d*)")
_UNORDERED = re.compile(r"(shN|sh_rest|features_rest)_\d+")
"""Harmonics from degree 1 on as gsplat and 3DGS have them in memory, coefficient by coefficient,
which files have channel by channel: the name does not tell which, and one of both is wrong."""

_CLOUDCOMPARE = "scalar_"
"""What CloudCompare puts before the names of columns that are not those of points."""

_SHOWN = 100
"""Characters of the names of columns in a message."""

# Types that a PLY column has, and types that PLY lacks with the type they are stored as.
_STORED = (
    torch.float32, torch.float64, torch.uint8, torch.int8, torch.uint16, torch.int16, torch.uint32,
    torch.int32,
)  # fmt: skip
_CONVERTED = {
    torch.bool: torch.uint8,
    torch.float16: torch.float32,
    torch.bfloat16: torch.float32,
    torch.int64: torch.int32,
}

_NOTE = "splatseg column"
"""Comment lines ``splatseg column NAME COMPONENTS TYPE`` restore columns that PLY cannot say:
those of several components (0 stands for a plain column) and those of a type it lacks."""

_DIGITS = 6
"""Of the components of a column, far more than a header has room for."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Columns:
    """The columns of a file that Gaussians are made of, in the order of memory."""

    means: tuple[str, ...]
    dc: tuple[str, ...]
    """Harmonics of degree 0, or colours where `coloured`."""

    opacity: tuple[str, ...]
    scales: tuple[str, ...]
    """Two for the surfels of 2DGS, which have no third."""

    rotations: tuple[str, ...]
    rest: tuple[str, ...]
    """Harmonics from degree 1 on, channel by channel."""

    beyond: tuple[str, ...]
    """Harmonics of degree 4, which are not rendered."""

    unordered: tuple[str, ...]
    """Columns that look like harmonics and are not read, see `_UNORDERED`."""

    coloured: bool
    """Whether the file has red, green and blue instead of harmonics of degree 0."""

    filter_3d: str | None
    """Width of the 3D smoothing filter of Mip-Splatting, scene units."""

    @property
    def used(self) -> tuple[str, ...]:
        """All of them."""
        filters = () if self.filter_3d is None else (self.filter_3d,)
        names = (*self.means, *self.dc, *self.opacity, *self.scales, *self.rotations)
        return (*names, *self.rest, *self.beyond, *filters)

    @property
    def renamed(self) -> tuple[str, ...]:
        """Sentences such as ``scales_0 ... as scale_0 ...`` for what has other names."""
        pairs = [(getattr(self, group), _OWN[group]) for group in _GROUPS]
        pairs.append((self.rest[:1], ("f_rest_0",) if self.rest else ()))
        shown = [(found, known[: len(found)]) for found, known in pairs]
        return tuple(f"{' '.join(a)} as {' '.join(b)}" for a, b in shown if a != b)


def read_ply(
    path: Path,
    header: PlyHeader,
    *,
    strict: bool,
    linear: Collection[str] = (),
    own: bool = False,
    part: slice = slice(None),
) -> Gaussians:
    """Read Gaussians and their extra columns from a PLY file, binary or ASCII.

    Columns beyond those of Gaussians come back under their own name and type in
    `Gaussians.extra`; normals only if any of them is not zero.

    Args:
        path: The file.
        header: Its header.
        strict: Refuse rows that cannot be rendered instead of leaving them out.
        linear: Which of scales and opacities the file has as they are, not as logs and logits.
        own: Whether splatseg wrote it: nothing in it is doubted, and no column is a filter.
        part: The rows that are read; of a binary file no others are looked at.
    """
    vertex, columns = _find_columns(path, header, own=own)
    rendered_degree(path, MAX_DEGREE + 1 if columns.beyond else 0, strict=strict)
    kinds = vertex.dtype()
    table = read_ply_tables(path, header, ["vertex"], whole=True)["vertex"].numbers
    table = {name: values[part] for name, values in table.items()}
    count = len(range(*part.indices(vertex.count)))
    rows = Rows.empty(count, 1 + len(columns.rest) // 3)
    filters = np.zeros(count, np.float32)
    extra = {
        name: np.empty(count, kinds[name]) for name in vertex.names if name not in columns.used
    }
    for some in blocks(count, BLOCK // 4):
        block = {name: values[some] for name, values in table.items()}
        with np.errstate(over="ignore"):  # text may have numbers beyond float32
            _unpack(block, rows, some, columns)
            if columns.filter_3d is not None:
                filters[some] = block[columns.filter_3d]
            for name, column in extra.items():
                column[some] = block[name]
    too_large = columns.coloured and bool((rows.sh[:, 0] > 0.5 / SH_C0 + 1e-3).any())
    what = f"real colours {' '.join(columns.dc)} in [0, 1], got larger ones"
    expect(not too_large, path, what)
    bytes_of_alpha = kinds[columns.opacity[0]].kind == "u"
    asked = {*linear, *(["opacities"] if bytes_of_alpha else [])}
    if not own:
        _warn_of_changes(path, rows, columns, asked)
    rows.exponentiate(scales="scales" not in asked, opacities="opacities" not in asked)
    if columns.filter_3d is not None:
        _smooth(rows, filters, axes=len(columns.scales))
    if len(columns.scales) == 2:
        rows.scales[:, 2] = _FLAT * rows.scales[:, :2].min(axis=1)
    drawn = drawn_as(path, header.comments)
    return finish(path, rows, _restore(header, extra), strict=strict, **drawn)


def _find_columns(path: Path, header: PlyHeader, *, own: bool) -> tuple[PlyElement, _Columns]:
    """The element of Gaussians, and its columns.

    Raises:
        FileFormatError: If it holds no Gaussians, or a column of another type than expected; the
            message says what it holds instead and what can be done with that.
    """
    vertex = header.element("vertex")
    if vertex is None or vertex.lists:
        names = quoted(", ".join(one.name for one in header.elements) or "none", _SHOWN)
        raise FileFormatError(
            f"{path}: expected Gaussians, got a PLY file without an element vertex that has no "
            f"lists in it (elements {names})."
        )
    names = vertex.names
    found = {group: _group(group, names) for group in _GROUPS}
    colours = next((group for group in _COLOURS if set(group) <= set(names)), None)
    coloured = found["dc"] is None and colours is not None
    if coloured:
        found["dc"] = colours
    lacking = [group for group, columns in found.items() if columns is None]
    if lacking:
        raise FileFormatError(f"{path}: {_nothing(path, header, lacking, coloured=coloured)}")
    rest, beyond = _rest(path, names)
    filters = [p + name for p in ("", _CLOUDCOMPARE) for name in _FILTERS if p + name in names]
    columns = _Columns(
        **{group: columns or () for group, columns in found.items()},
        rest=rest,
        beyond=beyond,
        unordered=() if rest else tuple(name for name in names if _UNORDERED.fullmatch(name)),
        coloured=coloured,
        filter_3d=filters[0] if filters and not own else None,
    )
    # Integers would need a scale to read.
    whole = {*(columns.dc if coloured else ()), *({"alpha", "alphas"} & set(columns.opacity))}
    kinds = vertex.dtype()
    for name in columns.used:
        kind = kinds[name]
        fits = kind.kind == "f" or (name in whole and kind.kind == "u" and kind.itemsize < 4)
        expect(fits, path, f"the PLY column {name} to be float or double, got {kind}")
    return vertex, columns


def _group(group: str, names: Sequence[str]) -> tuple[str, ...] | None:
    """Which columns stand for those of a group: all of them, or two scales of surfels."""
    own, *others = _GROUPS[group]
    known = [own, tuple(_CLOUDCOMPARE + name for name in own), *others]
    whole = [columns for columns in known if set(columns) <= set(names)]
    if group == "scales" and not whole:
        whole = [columns[:2] for columns in known if set(columns[:2]) <= set(names)]
    return whole[0] if whole else None


def _rest(path: Path, names: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The names of the harmonics from degree 1 on, in order, and of those of degree 4."""
    own = any(_REST.fullmatch(name) for name in names)
    prefix = "f_rest" if own else f"{_CLOUDCOMPARE}f_rest"
    count = sum(re.fullmatch(rf"{prefix}_(0|[1-9]\d*)", name) is not None for name in names)
    rest = tuple(f"{prefix}_{i}" for i in range(count))
    known = [3 * ((degree + 1) ** 2 - 1) for degree in range(MAX_DEGREE + 2)]
    what = f"{', '.join(map(str, known[:-2]))} or {known[-2]} columns {prefix}_0, {prefix}_1 and "
    what += f"so on, got {count}"
    expect(count in known and set(rest) <= set(names), path, what)
    if count < known[-1]:
        return rest, ()
    kept = tuple(name for i, name in enumerate(rest) if i % (count // 3) < known[-2] // 3)
    return kept, tuple(name for name in rest if name not in kept)


def _nothing(path: Path, header: PlyHeader, lacking: Sequence[str], *, coloured: bool) -> str:
    """What a file holds that has not all columns of Gaussians, and what can be done with it."""
    vertex = header.element("vertex")
    names = vertex.names if vertex is not None else ()
    have = f"found {quoted(', '.join(names), _SHOWN)}" if names else "found no columns"
    if {"opacity", "scales", "rotations"} <= set(lacking) and "means" not in lacking:
        what = "a mesh" if any(element.lists for element in header.elements) else "points"
        what += " with colours" if coloured or "dc" not in lacking else ""
        file = brief(path.name, _SHOWN)
        return (
            f"expected Gaussians, got {what}, no Gaussians ({have}); `splatseg fit CAPTURE "
            f"--points {file}` fits Gaussians to photographs from such points on."
        )
    wanted = ", ".join(name for group in lacking for name in _OWN[group])
    return f"expected Gaussians, got a PLY file without {wanted} ({have})."


def _unpack(block: Mapping[str, np.ndarray], rows: Rows, part: slice, columns: _Columns) -> None:
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


def _warn_of_changes(path: Path, rows: Rows, columns: _Columns, linear: Collection[str]) -> None:
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


def write_ply(gaussians: Gaussians, path: Path, *, losses: Losses) -> None:
    """Write Gaussians and their extra columns as a binary little-endian PLY file.

    Raises:
        InputError: If an extra column has a name or a type that PLY cannot hold.
        RangeError: If a row cannot be rendered.
    """
    del losses  # there are none
    held = to_rows(gaussians) if gaussians.chunks is None else None
    extra, notes = _flatten(gaussians.extra)
    count = gaussians.sh.shape[1] - 1
    rest = tuple(f"f_rest_{i}" for i in range(3 * count))
    standard = (
        *_OWN["means"], *_NORMALS, *_OWN["dc"], *rest, "opacity", *_OWN["scales"],
        *_OWN["rotations"],
    )  # fmt: skip
    _check_names(extra, standard)
    fields = [(name, "<f4") for name in standard]
    fields += [(name, column.dtype.str) for name, column in extra.items() if name not in standard]
    comments = [*drawing_comments(gaussians), *notes]
    with path.open("wb") as file:
        file.write(ply_header([("vertex", len(gaussians), fields)], comments))
        for part in blocks(len(gaussians), BLOCK // 4):
            block = np.zeros(part.stop - part.start, np.dtype(fields))
            rows = _part(gaussians, held, part)
            for source, names in (
                (rows.means, _OWN["means"]),
                (rows.rotations, _OWN["rotations"]),
                (logs(rows.scales), _OWN["scales"]),
                (rows.sh[:, 0], _OWN["dc"]),
                (logits(rows.opacities)[:, None], ("opacity",)),
                (rows.sh[:, 1:].transpose(0, 2, 1).reshape(len(block), -1), rest),
            ):
                for i, name in enumerate(names):
                    block[name] = source[:, i]
            for name, column in extra.items():
                block[name] = column[part]
            file.write(block.tobytes())


def _part(gaussians: Gaussians, held: Rows | None, part: slice) -> Rows:
    """Some rows, of those that are held, or read from the disk."""
    if held is not None:
        return held[part]
    if gaussians.chunks is None:
        raise InputError("gaussians: expected some in chunks, got others.")
    return to_rows(gaussians.chunks.read([(part.start, part.stop)]))


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
        parts = {f"{name}_{i}": array[:, i] for i in range(components)} or {name: array}
        for part, column in parts.items():
            if part in columns:
                raise InputError(f"extra[{name!r}]: the column name {part!r} is taken.")
            columns[part] = column
    return columns, notes


def _check_names(extra: Mapping[str, np.ndarray], standard: Sequence[str]) -> None:
    """Refuse names that a reader would take for something else."""
    normals = [extra[name].dtype for name in _NORMALS if name in extra]
    allowed = _NORMALS if normals == [np.dtype("f4")] * 3 else ()
    for name in extra:
        what = "a name of printable ASCII without spaces, as PLY needs"
        expect(re.fullmatch(r"[!-~]+", name), f"extra[{name!r}]", what, error=InputError)
        if (name in standard and name not in allowed) or _REST.fullmatch(name):
            raise InputError(f"extra[{name!r}]: PLY uses the name {name!r} for something else.")
