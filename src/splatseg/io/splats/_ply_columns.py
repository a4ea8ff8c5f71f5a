"""Which columns of a PLY file are those of Gaussians, under the names that other programs use.

The names of the original 3DGS code come first. A group of columns (all scales, all parts of the
quaternion) goes by one row of `_OTHERS` as a whole; a name alone says nothing. Order and meaning
are those of 3DGS unless the names tell another order, as ``qx qy qz qw`` do.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatseg.core.sh import MAX_DEGREE
from splatseg.errors import FileFormatError, brief, quoted
from splatseg.io.splats._ply_header import PlyElement, PlyHeader

MEANS = ("x", "y", "z")
DC = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALES = ("scale_0", "scale_1", "scale_2")
ROTATIONS = ("rot_0", "rot_1", "rot_2", "rot_3")
OPACITY = ("opacity",)
COLOURS = (
    ("red", "green", "blue"),
    ("r", "g", "b"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
)
REST = re.compile(r"f_rest_(0|[1-9]\d*)")

_GROUPS = (MEANS, DC, OPACITY, SCALES, ROTATIONS)
_FILTERS = ("filter_3D", "filter_3d")
_UNORDERED = re.compile(r"(shN|sh_rest|features_rest)_\d+")
"""Harmonics from degree 1 on as gsplat and 3DGS have them in memory, coefficient by coefficient,
which files have channel by channel: the name does not tell which, and one of both is wrong."""

_CLOUDCOMPARE = "scalar_"
"""What CloudCompare puts before the names of columns that are not those of points."""

_SHOWN = 100


def _numbered(*prefixes: str, count: int) -> tuple[tuple[str, ...], ...]:
    return tuple(tuple(f"{prefix}_{i}" for i in range(count)) for prefix in prefixes)


_OTHERS: dict[tuple[str, ...], tuple[tuple[str, ...], ...]] = {
    MEANS: _numbered("means", "mean", "xyz", "positions", "position", count=3),
    DC: _numbered("features_dc", "sh0", "sh_dc", count=3),
    OPACITY: (("opacities",), ("opacities_0",), ("opacity_0",), ("alpha",), ("alphas",)),
    SCALES: (
        *_numbered("scales", "scaling", "scalings", "log_scales", "log_scale", count=3),
        ("scale_x", "scale_y", "scale_z"),
        ("sx", "sy", "sz"),
    ),
    ROTATIONS: (
        *_numbered("rots", "rotation", "rotations", "quats", "quat", "q", count=4),
        ("rot_w", "rot_x", "rot_y", "rot_z"),
        ("rotation_w", "rotation_x", "rotation_y", "rotation_z"),
        ("quat_w", "quat_x", "quat_y", "quat_z"),
        ("qw", "qx", "qy", "qz"),
    ),
}
"""Other names of each group: parameters of 3DGS (``scaling``, ``features_dc``) and of gsplat
(``scales``, ``quats``, ``opacities``, ``sh0``) written as they are called, and letters for axes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Columns:
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
        known = (MEANS, DC, OPACITY, SCALES[: len(self.scales)])
        pairs = zip(
            (self.means, self.dc, self.opacity, self.scales, self.rotations, self.rest[:1]),
            (*known, ROTATIONS, ("f_rest_0",) if self.rest else ()),
            strict=True,
        )
        return tuple(f"{' '.join(a)} as {' '.join(b)}" for a, b in pairs if a != b)


def find_columns(path: Path, header: PlyHeader, *, own: bool) -> Columns:
    """The columns of Gaussians in a file.

    Args:
        path: The file; starts the message.
        header: Its elements.
        own: Whether splatseg wrote it, so that a column ``filter_3D`` is no more than a column.

    Raises:
        FileFormatError: If it holds no Gaussians, or a column of another type than expected; the
            message says what it holds instead and what can be done with that.
    """
    vertex = header.elements.get("vertex")
    if vertex is None or vertex.lists:
        found = quoted(", ".join(header.elements), _SHOWN) if header.elements else "none"
        raise FileFormatError(
            f"{path}: expected Gaussians, got a PLY file without an element vertex that has no "
            f"lists in it (elements {found})."
        )
    names = vertex.row.names or ()
    found = {group: _group(group, names) for group in _GROUPS}
    colours = next((group for group in COLOURS if set(group) <= set(names)), None)
    coloured = found[DC] is None and colours is not None
    if coloured:
        found[DC] = colours
    lacking = [group for group, columns in found.items() if columns is None]
    if lacking:
        raise FileFormatError(f"{path}: {_nothing(path, header, lacking, coloured=coloured)}")
    means, dc, opacity, scales, rotations = (found[group] or () for group in _GROUPS)
    rest, beyond = _rest(path, names)
    filters = [p + name for p in ("", _CLOUDCOMPARE) for name in _FILTERS if p + name in names]
    columns = Columns(
        means=means,
        dc=dc,
        opacity=opacity,
        scales=scales,
        rotations=rotations,
        rest=rest,
        beyond=beyond,
        unordered=() if rest else tuple(name for name in names if _UNORDERED.fullmatch(name)),
        coloured=coloured,
        filter_3d=filters[0] if filters and not own else None,
    )
    _check_types(path, vertex, columns)
    return columns


def _group(group: tuple[str, ...], names: Sequence[str]) -> tuple[str, ...] | None:
    """Which columns stand for those of a group: all of them, or two scales of surfels."""
    others = [tuple(_CLOUDCOMPARE + name for name in group), *_OTHERS[group]]
    whole = [columns for columns in (group, *others) if set(columns) <= set(names)]
    if group == SCALES and not whole:
        return next((c[:2] for c in (group, *others) if set(c[:2]) <= set(names)), None)
    return whole[0] if whole else None


def _rest(path: Path, names: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The names of the harmonics from degree 1 on, in order, and of those of degree 4."""
    own = any(REST.fullmatch(name) for name in names)
    prefix = "f_rest" if own else f"{_CLOUDCOMPARE}f_rest"
    count = sum(re.fullmatch(rf"{prefix}_(0|[1-9]\d*)", name) is not None for name in names)
    rest = tuple(f"{prefix}_{i}" for i in range(count))
    known = [3 * ((degree + 1) ** 2 - 1) for degree in range(MAX_DEGREE + 2)]
    if count not in known or not set(rest) <= set(names):
        raise FileFormatError(
            f"{path}: expected {', '.join(map(str, known[:-2]))} or {known[-2]} columns "
            f"{prefix}_0, {prefix}_1 and so on, got {count}."
        )
    if count < known[-1]:
        return rest, ()
    kept = tuple(name for i, name in enumerate(rest) if i % (count // 3) < known[-2] // 3)
    return kept, tuple(name for name in rest if name not in kept)


def _check_types(path: Path, vertex: PlyElement, columns: Columns) -> None:
    """Refuse integers where Gaussians have real numbers: they would need a scale to read."""
    whole = set(columns.dc if columns.coloured else ())
    whole |= set(columns.opacity) & {"alpha", "alphas"}
    for name in columns.used:
        kind: np.dtype[np.void] = vertex.row[name]
        if kind.kind != "f" and not (name in whole and kind.kind == "u" and kind.itemsize < 4):
            raise FileFormatError(
                f"{path}: expected the PLY column {name} to be float or double, got {kind}."
            )


def _nothing(
    path: Path, header: PlyHeader, lacking: Sequence[tuple[str, ...]], *, coloured: bool
) -> str:
    """What a file holds that has not all columns of Gaussians, and what can be done with it."""
    names = header.elements["vertex"].row.names or ()
    have = f"found {quoted(', '.join(names), _SHOWN)}" if names else "found no columns"
    if {OPACITY, SCALES, ROTATIONS} <= set(lacking) and MEANS not in lacking:
        mesh = any(element.lists for element in header.elements.values())
        what = "a mesh" if mesh else "points"
        what += " with colours" if coloured or DC not in lacking else ""
        file = brief(path.name, _SHOWN)
        return (
            f"expected Gaussians, got {what}, no Gaussians ({have}); `splatseg fit CAPTURE "
            f"--points {file}` fits Gaussians to photographs from such points on."
        )
    wanted = ", ".join(name for group in lacking for name in group)
    return f"expected Gaussians, got a PLY file without {wanted} ({have})."
