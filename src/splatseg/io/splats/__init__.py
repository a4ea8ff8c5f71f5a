"""Splat files of every common tool, to and from `core.Gaussians`.

Which layout a file has is told by its first bytes, and by its name only where those say
nothing (``.splat`` has no header, ``.ksplat`` nothing that is its own). Each format's bytes are
described in docs/formats/splats.md. A new format is a row of `_READERS`, one of `_WRITERS` where it
is written, and its mark in `_format_of_content`.
"""

import zlib
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from splatseg._check import check_choice
from splatseg.core import Gaussians
from splatseg.core.boundary import boundary
from splatseg.core.gaussians import LOW_PASS
from splatseg.errors import FileFormatError, InputError
from splatseg.io.atomic import atomic_file
from splatseg.io.foreign import expect, is_folder
from splatseg.io.json_files import read_json
from splatseg.io.ply import read_ply_header
from splatseg.io.splats._rows import Losses, StrPath, check_file, warn
from splatseg.io.splats._rows import SplatWarning as SplatWarning
from splatseg.io.splats.compressed_ply import (
    is_compressed,
    read_compressed_ply,
    write_compressed_ply,
)
from splatseg.io.splats.gltf import read_gltf
from splatseg.io.splats.ply import read_ply, write_ply
from splatseg.io.splats.sog import read_sog, write_sog
from splatseg.io.splats.splat import read_ksplat, read_splat, write_splat
from splatseg.io.splats.spz import read_spz, write_spz

Values = Literal["scales", "opacities"]
"""What a file may have as it is, where 3DGS has logs and logits."""

SplatFormat = Literal["ply", "compressed.ply", "splat", "ksplat", "spz", "sog", "gltf"]
WritableFormat = Literal["ply", "compressed.ply", "splat", "spz", "spz3", "sog"]


_READERS: Mapping[SplatFormat, Callable[..., Gaussians]] = {
    "compressed.ply": read_compressed_ply,
    "splat": read_splat,
    "ksplat": read_ksplat,
    "spz": read_spz,
    "sog": read_sog,
    "gltf": read_gltf,
}
"""All formats but PLY, whose reader has more to be told."""


@dataclass(frozen=True, slots=True)
class _Writer:
    label: str
    write: Callable[..., None]
    keeps: tuple[Literal["extra", "antialiased", "low_pass"], ...] = ()
    """What it has a place for beside the Gaussians."""


_WRITERS: Mapping[WritableFormat, _Writer] = {
    "compressed.ply": _Writer(
        "a compressed PLY file", write_compressed_ply, ("antialiased", "low_pass")
    ),
    "ply": _Writer("a PLY file", write_ply, ("extra", "antialiased", "low_pass")),
    "splat": _Writer("a .splat file", write_splat),
    "spz": _Writer("an SPZ file", partial(write_spz, version=4), ("antialiased",)),
    "spz3": _Writer("an SPZ file", partial(write_spz, version=3), ("antialiased",)),
    "sog": _Writer("a SOG file", write_sog, ("antialiased",)),
}
"""In the order in which names are looked at."""

_PEEK = 4096


@boundary
def read_splats(
    path: StrPath, *, strict: bool = False, linear: Collection[Values] = ()
) -> Gaussians:
    """Read Gaussians from a splat file of any known format.

    PLY (3DGS and 2DGS, binary or ASCII, any further columns kept), SuperSplat's compressed PLY,
    ``.splat``, ``.ksplat``, SPZ versions 2 to 4, SOG versions 1 and 2 (bundled, or by
    ``meta.json`` or its folder), and glTF with KHR_gaussian_splatting. In memory scales are
    linear, opacities in [0, 1], quaternions wxyz of unit length.

    Args:
        path: The file; for unbundled SOG its ``meta.json`` or the folder of it; of a folder that
            3DGS trained a model in its last iteration.
        strict: Refuse a file with Gaussians that cannot be rendered (NaN, infinite, a log scale
            of minus infinity, zero rotation). Without, they are left out, and
            the extra column ``source_row`` says which row of the file each of the others is.
        linear: Which of ``scales`` and ``opacities`` a PLY file has as they are, where 3DGS has
            logs and logits.

    Returns:
        Float32 Gaussians on the CPU, rows in file order.

    Raises:
        FileFormatError: If the file is none of these, is truncated or damaged, holds no Gaussian
            that can be rendered or, with `strict`, one that cannot; the sentence starts with the
            path and says how many rows and which is the first.
        InputError: If `linear` is asked of a file that is no PLY of 3DGS.
        MissingFileError: If there is no such file.

    Warns:
        SplatWarning: If rows are left out, columns have other names than those of 3DGS, something
            was changed on reading (surfels, filters), values look as if they were never logs or
            logits, or the file says something that Gaussians in memory cannot hold.
    """
    source = Path(path)
    if (trained := trained_splats(source)) is not None:
        where = trained.relative_to(source).as_posix()
        warn(source, f"a model of 3DGS, of which {where} was read.")
        source = trained
    format = splat_format(source)
    if format == "ply":
        return read_ply(source, read_ply_header(source), strict=strict, linear=linear)
    what = f"a PLY file of 3DGS, whose values may be logs or not, got {source}"
    expect(not linear, "linear", what, error=InputError)
    return _READERS[format](source, strict=strict)


@boundary
def trained_splats(folder: StrPath) -> Path | None:
    """The PLY file of the last iteration of a folder that 3DGS trained a model in, or None."""
    files = Path(folder).glob("point_cloud/iteration_*/point_cloud.ply")
    last = max(((_iteration(file), file) for file in files), default=None)
    return None if last is None else last[1]


def _iteration(file: Path) -> int:
    number = file.parent.name.removeprefix("iteration_")
    return int(number) if number.isdecimal() and len(number) < 10 else -1


@boundary
def read_scene_splats(path: StrPath) -> Gaussians:
    """Read the Gaussians of a scene folder: all rows, as layers go by rows, and nothing doubted.

    Raises:
        FileFormatError: If the file is damaged, or holds a Gaussian that cannot be rendered.
        MissingFileError: If there is no such file.
    """
    source = Path(path)
    if splat_format(source) != "ply":
        return read_splats(source, strict=True)
    return read_ply(source, read_ply_header(source), strict=True, own=True)


@boundary
def splat_rows(path: StrPath, *, own: bool = False) -> tuple[Callable[[int, int], Gaussians], int]:
    """What reads some rows of a PLY file, from one to before another, and how many rows there are.

    Args:
        path: The file.
        own: Whether splatseg wrote it: nothing in it is doubted.

    Raises:
        InputError: If it is of another format, or of text.
        FileFormatError: If it is damaged, or holds a Gaussian that cannot be rendered, when that is
            read.
        MissingFileError: If there is no such file.
    """
    source = Path(path)
    format = splat_format(source)
    header = read_ply_header(source) if format == "ply" else None
    vertex = None if header is None else header.element("vertex")
    if header is None or not header.order or vertex is None:
        raise InputError(
            f"{source}: expected a binary PLY file to read some rows of, got another file; "
            "`splatseg import` reads it as a whole."
        )

    def rows(first: int, end: int) -> Gaussians:
        return read_ply(source, header, strict=True, own=own, part=slice(first, end))

    return rows, vertex.count


@boundary
def write_splats(
    gaussians: Gaussians, path: StrPath, *, format: WritableFormat | None = None
) -> None:
    """Write Gaussians to a splat file; the file appears whole or not at all.

    Only PLY keeps everything, extra columns included. The others round values (their steps
    are in docs/formats/splats.md), and compressed PLY also changes the order of rows.

    Args:
        gaussians: What to write; converted to float32 on the CPU.
        path: The file. Its ending gives the format unless `format` does.
        format: ``ply``, ``compressed.ply``, ``splat``, ``spz`` (version 4), ``spz3``
            (version 3, for readers that do not know zstd yet) or ``sog`` (bundled).

    Raises:
        InputError: If no format can be told, or an extra column has a name or type that PLY
            cannot hold.
        RangeError: If a row cannot be rendered, or a position is too far out for SPZ.
        MissingFileError: If the folder of `path` does not exist.

    Warns:
        SplatWarning: If the format has no place for something, or values lay outside its
            range and were clamped.

    Example:
        >>> import tempfile, torch
        >>> g = Gaussians(means=torch.zeros(1, 3), rotations=torch.eye(4)[:1],
        ...               scales=torch.ones(1, 3), opacities=torch.ones(1),
        ...               sh=torch.zeros(1, 1, 3))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_splats(g, Path(folder) / "one.ply")
        ...     read_splats(Path(folder) / "one.ply").opacities
        tensor([1.])
    """
    target = Path(path)
    chosen = _format_of_name(target) if format is None else format
    check_choice("format", chosen, _WRITERS)
    if gaussians.chunks is not None and chosen != "ply":
        raise InputError(
            f"{target}: expected a .ply file for Gaussians in chunks, as other formats need all of "
            f"them at once, got {chosen}."
        )
    writer = _WRITERS[chosen]
    losses = Losses(target, writer.label)
    with atomic_file(target) as temporary:
        writer.write(gaussians, temporary, losses=losses)
    if gaussians.extra and "extra" not in writer.keeps:
        losses.drop("the extra columns " + ", ".join(sorted(gaussians.extra)))
    if gaussians.antialiased and "antialiased" not in writer.keeps:
        losses.drop("a note that they are meant for antialiased rendering")
    if gaussians.low_pass != LOW_PASS and "low_pass" not in writer.keeps:
        losses.drop(f"a note that they are meant for a low-pass of {gaussians.low_pass:g}")
    losses.tell()


def _format_of_name(path: Path) -> WritableFormat:
    """The format that a name's ending stands for."""
    name = path.name.lower()
    for known in _WRITERS:
        if name.endswith(f".{known}") and known != "spz3":
            return known
    raise InputError(
        f"{path}: expected a name that ends in .ply, .compressed.ply, .splat, .spz or .sog, or a "
        "format."
    )


@boundary
def splat_format(path: StrPath) -> SplatFormat:
    """Tell the format of a splat file by its first bytes, or by its name where those say nothing.

    Returns:
        ``ply``, ``compressed.ply``, ``splat``, ``ksplat``, ``spz``, ``sog`` or ``gltf``.

    Raises:
        FileFormatError: If it is none of them, is empty, or is a folder without ``meta.json``.
        MissingFileError: If there is no such file.
    """
    source = Path(path)
    source = trained_splats(source) or source
    if is_folder(source):
        what = "a splat file, got a folder without the meta.json of SOG or the point_cloud of a "
        expect((source / "meta.json").is_file(), source, what + "model of 3DGS")
        return "sog"
    check_file(source)
    with source.open("rb") as file:
        head = file.read(_PEEK)
    found = _format_of_content(source, head)
    if found is not None:
        return found
    for format in ("splat", "ksplat"):
        if source.suffix.lower() == f".{format}":
            return format
    raise FileFormatError(
        f"{source}: expected a splat file (PLY, compressed PLY, .splat, .ksplat, SPZ, SOG or "
        f"glTF with Gaussians), but it starts with {head[:8]!r}."
    )


def _format_of_content(path: Path, head: bytes) -> SplatFormat | None:
    """The format that the first bytes tell, None if they tell nothing."""
    if head.startswith((b"ply\n", b"ply\r\n")):
        return "compressed.ply" if is_compressed(read_ply_header(path)) else "ply"
    if head.startswith(b"NGSP"):
        return "spz"
    if head.startswith(b"\x1f\x8b"):
        return "spz" if _gzip_start(head) == b"NGSP" or path.suffix.lower() == ".spz" else None
    if head.startswith(b"PK\x03\x04"):
        return "sog"
    if head.startswith(b"glTF"):
        return "gltf"
    if head.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{"):
        return _format_of_json(path)
    return None


def _gzip_start(head: bytes) -> bytes:
    """The first four bytes inside gzip data, fewer if they are no gzip data."""
    try:
        return zlib.decompressobj(wbits=31).decompress(head, 4)
    except zlib.error:
        return b""


def _format_of_json(path: Path) -> SplatFormat | None:
    """Which of the formats with JSON a document is."""
    if path.suffix.lower() == ".gltf":
        return "gltf"
    if path.name == "meta.json":
        return "sog"
    try:
        document = read_json(path)
    except FileFormatError:
        return None
    if "means" in document and "quats" in document:
        return "sog"
    return "gltf" if "asset" in document else None
