"""PlayCanvas's SOG, versions 1 and 2: attributes as WebP pictures beside a ``meta.json``.

A Gaussian is the pixel of the same number in row-major order. Positions have 16 bits an axis
over two pictures (low and high bytes), on a scale ``sign(x) log(1 + |x|)``; quaternions are
the smallest three in red, green and blue, with 252 plus the index of the largest component
(w, x, y, z) in alpha. Scales and colours are bytes: between bounds in version 1, into a codebook
of 256 numbers in version 2. Harmonics are a palette of vectors and 16-bit labels into it.
Bundled files (``.sog``) are a zip of the same. Version 2, bundled, is written. See
docs/formats/splats.md.
"""

import io
import json
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray
from PIL import Image

from splatseg.core import Gaussians
from splatseg.core.gaussians import sigmoid
from splatseg.core.sh import MAX_DEGREE
from splatseg.errors import FileFormatError, InputError, quoted
from splatseg.io.arrays import open_archive, open_member
from splatseg.io.foreign import expect, malformed, read_bytes, reading
from splatseg.io.json_files import parse_object
from splatseg.io.schema import structured
from splatseg.io.splats._quantisation import assemble, scalar_codebook, split, vector_palette
from splatseg.io.splats._rows import (
    Array,
    Losses,
    Rows,
    beside,
    blocks,
    check_file,
    check_size,
    finish,
    logs,
    to_rows,
    unsigned,
)

_PALETTE_WIDTH = 64
"""Entries of the palette of harmonics in a row of its picture."""

_MAX_META = 1 << 24

_TAG = 252
"""Alpha of a quaternion whose largest component is w; x, y and z follow."""

Pixels = NDArray[np.uint8]
_Load = Callable[[str, int], bytes]

# What meta.json must have, by version.
_Count = Annotated[int, Meta(ge=0)]
_Number = Annotated[float, Meta(ge=-1e30, le=1e30)]
_Triple = tuple[_Number, _Number, _Number]
_Codebook = Annotated[list[_Number], Meta(min_length=1, max_length=256)]


@dataclass(frozen=True, slots=True)
class _Means:
    mins: _Triple
    maxs: _Triple
    files: tuple[str, str]
    shape: list[_Count] | None = None


@dataclass(frozen=True, slots=True)
class _Quats:
    files: tuple[str]


@dataclass(frozen=True, slots=True)
class _Bytes:
    """Scales or colours: bounds in version 1, a codebook in version 2."""

    files: tuple[str]
    mins: list[_Number] | None = None
    maxs: list[_Number] | None = None
    codebook: _Codebook | None = None


@dataclass(frozen=True, slots=True)
class _Harmonics:
    files: tuple[str, str]
    mins: _Number | None = None
    maxs: _Number | None = None
    codebook: _Codebook | None = None
    bands: _Count | None = None
    count: _Count | None = None


@dataclass(frozen=True, slots=True)
class _Document:
    means: _Means
    quats: _Quats
    scales: _Bytes
    sh0: _Bytes
    shN: _Harmonics | None = None
    version: _Count = 1
    count: _Count | None = None
    antialias: Any = None
    model: Any = None


def read_sog(path: Path, *, strict: bool) -> Gaussians:
    """Read a bundled ``.sog`` file, or an unbundled one by its ``meta.json`` or its folder.

    Raises:
        FileFormatError: If a member of ``meta.json`` or a picture is missing, damaged or too
            small for the count, a label points beyond its palette, or a row cannot be rendered.
        MissingFileError: If there is no such file.
    """
    if path.is_dir():
        path = path / "meta.json"
    check_file(path)
    with path.open("rb") as file:
        bundled = file.read(2) == b"PK"
    if not bundled:
        pictures = [file for file in path.parent.glob("*.webp") if file.is_file()]
        packed = sum(file.stat().st_size for file in (path, *pictures))
        load = partial(_load_beside, path)
        return _Bundle(path, load, path.name, packed).gaussians(strict=strict)
    with open_archive(path, where=path, expected="a zip file of SOG") as archive:
        metas = [n for n in archive.namelist() if n.rsplit("/", 1)[-1] == "meta.json"]
        expect(len(metas) == 1, path, f"a zip file with one meta.json, got {len(metas)}")
        folder = metas[0].removesuffix("meta.json")
        load = partial(_load_member, path, archive, folder)
        bundle = _Bundle(path, load, "meta.json", path.stat().st_size)
        return bundle.gaussians(strict=strict)


def _load_beside(path: Path, name: str, limit: int) -> bytes:
    """A file in the folder of `path`."""
    member = beside(path, name)
    expect(member.stat().st_size <= limit, member, f"at most {limit} bytes, got more")
    return read_bytes(member, "a picture of SOG")


def _load_member(path: Path, archive: zipfile.ZipFile, folder: str, name: str, limit: int) -> bytes:
    """A member of a zip file, unpacked only if it is as small as it should be."""
    name = folder + name
    with open_member(archive, name, where=path, expected="a zip file of SOG") as (member, _):
        data = member.read(limit + 1)
    expect(len(data) <= limit, path, f"at most {limit} bytes in {quoted(name)}, got more")
    return data


class _Bundle:
    """A file whose parts are loaded by their names."""

    def __init__(self, path: Path, load: _Load, meta_name: str, packed: int) -> None:
        self._path = path
        self._load = load
        meta = parse_object(load(meta_name, _MAX_META), where=str(path))
        self._meta = structured(meta, _Document, where=str(path))
        version = self._meta.version
        expect(version in (1, 2), path, f"SOG version 1 or 2, got {version}")
        shape = self._meta.means.shape or [None]
        count = self._meta.count if version == 2 else shape[0]
        if count is None:
            raise FileFormatError(f"{path}: expected a count of Gaussians, got none.")
        self._count = count
        check_size(path, count, MAX_DEGREE if self._meta.shN else 0, packed=packed)

    def gaussians(self, *, strict: bool) -> Gaussians:
        """All of them."""
        meta, path = self._meta, self._path
        palette = None if meta.shN is None else self._palette(meta.shN)
        rows = Rows.empty(self._count, 1 + (0 if palette is None else palette.shape[1]))
        self._positions(rows)
        self._rotations(rows)
        for target, entry, width in ((rows.scales, meta.scales, 3), (rows.sh[:, 0], meta.sh0, 4)):
            alpha = self._bytes(entry, target, width=width)
            if width == 4:
                rows.opacities[:] = alpha
        if meta.shN is not None and palette is not None:
            self._harmonics(rows, self._pixels_of(meta.shN.files[1]), palette)
        with np.errstate(over="ignore"):
            np.exp(rows.scales, out=rows.scales)
        antialiased = meta.antialias is True or meta.model == "antialiased"
        return finish(path, rows, strict=strict, antialiased=antialiased)

    def _pixels_of(self, name: str) -> Pixels:
        """The pixels (n, 4) of a picture that has about as many of them as Gaussians."""
        count = self._count
        with self._opened(name, 8 * count + (1 << 20)) as image:
            pixels = image.width * image.height
            what = f"at least {count} pixels in {quoted(name)}, and not many more, got "
            what += f"{image.width} x {image.height}"
            expect(count <= pixels <= 2 * count + (1 << 22), self._path, what)
            return self._decoded(name, image).reshape(-1, 4)[:count]

    def _opened(self, name: str, limit: int) -> Image.Image:
        """A picture whose size is known but whose pixels are not decoded yet."""
        data = self._load(name, limit)
        try:
            with reading(self._path, f"a WebP picture in {quoted(name)}"):
                return Image.open(io.BytesIO(data), formats=["WEBP"])
        except Image.DecompressionBombError as error:
            raise malformed(self._path, f"a smaller WebP picture in {quoted(name)}") from error

    def _decoded(self, name: str, image: Image.Image) -> Pixels:
        """All pixels (height, width, 4); alpha is 255 where the picture has none."""
        with reading(self._path, f"a WebP picture in {quoted(name)}"):
            return np.asarray(image.convert("RGBA"))

    def _refuse(self, wrong: NDArray[np.bool_], what: str) -> None:
        """Raise if any row is at fault."""
        if wrong.any():
            raise FileFormatError(
                f"{self._path}: {int(wrong.sum())} of {len(wrong)} Gaussians have {what}; the "
                f"first is row {int(wrong.argmax())}."
            )

    def _positions(self, rows: Rows) -> None:
        """Positions: 16 bits between bounds, then the inverse of sign(x) log(1 + |x|)."""
        entry = self._meta.means
        images = [self._pixels_of(name) for name in entry.files]
        low, high = np.array(entry.mins), np.array(entry.maxs)
        for part in blocks(len(rows.means)):
            low_bytes, high_bytes = (image[part, :3].astype(np.float64) for image in images)
            places = low + (high - low) * ((low_bytes + 256 * high_bytes) / 65535)
            with np.errstate(over="ignore"):
                rows.means[part] = np.sign(places) * np.expm1(np.abs(places))

    def _rotations(self, rows: Rows) -> None:
        """Quaternions: three components as (byte / 255 - 0.5) sqrt 2, the largest by alpha."""
        pixels = self._pixels_of(self._meta.quats.files[0])
        self._refuse(pixels[:, 3] < _TAG, f"a rotation whose alpha is not {_TAG} to 255")
        for part in blocks(len(pixels)):
            others = (pixels[part, :3] / 255 - 0.5) * 2**0.5
            rows.rotations[part] = assemble(pixels[part, 3] - np.uint8(_TAG), others)

    def _bytes(self, entry: _Bytes, target: Array, *, width: int) -> NDArray[np.floating]:
        """Log scales, or colours, from bytes; gives what alpha stands for as an opacity."""
        where = f"{self._path}: {'scales' if width == 3 else 'sh0'}"
        pixels = self._pixels_of(entry.files[0])
        if self._meta.version == 1:
            low, high = (np.array(ends or ()) for ends in (entry.mins, entry.maxs))
            expect(len(low) == len(high) == width, where, f"mins and maxs of {width} numbers")
            tables = low[:, None] + (high - low)[:, None] * (np.arange(256) / 255)
        else:
            tables = np.full((width, 256), np.nan)  # a byte beyond a short codebook is refused
            expect(entry.codebook, where, "a codebook, got none")
            tables[:, : len(entry.codebook or ())] = entry.codebook
        for part in blocks(len(pixels)):
            for i in range(3):
                target[part, i] = tables[i, pixels[part, i]]
        alpha = pixels[:, 3]
        if self._meta.version == 1:  # a logit between bounds
            return sigmoid(tables[-1])[alpha]
        return alpha / np.float32(255)

    def _palette(self, entry: _Harmonics) -> Array:
        """The palette (entries, coefficients, 3)."""
        path, name = self._path, entry.files[0]
        with self._opened(name, 1 << 24) as image:
            coefficients = image.width // _PALETTE_WIDTH
            fits = not image.width % _PALETTE_WIDTH and coefficients in (3, 8, 15)
            what = "a palette of 192, 512 or 960 pixels a row and at most 1024 rows in "
            what += f"{quoted(name)}, got {image.width} x {image.height}"
            expect(fits and image.height <= 1024, path, what)
            pixels = self._decoded(name, image)[..., :3].reshape(-1, coefficients, 3)
        if self._meta.version == 1:
            if entry.mins is None or entry.maxs is None:
                raise FileFormatError(f"{path}: expected mins and maxs of shN, got none.")
            share = pixels / 255
            return (entry.mins + (entry.maxs - entry.mins) * share).astype(np.float32)
        bands, count = entry.bands or 0, entry.count or 0
        fits = (bands + 1) ** 2 - 1 == coefficients
        what = f"the degree of {coefficients} coefficients, got {bands}"
        expect(fits, f"{path}: shN.bands", what)
        most = f"at most the {len(pixels)} entries of the palette, got {count}"
        expect(count <= len(pixels), f"{path}: shN.count", most)
        codebook = np.full(256, np.nan, np.float32)
        numbers = entry.codebook or []
        codebook[: len(numbers)] = numbers
        return codebook[pixels[:count]]

    def _harmonics(self, rows: Rows, pixels: Pixels, palette: Array) -> None:
        """Give each Gaussian the harmonics that its label (red + 256 green) points to."""
        labels = pixels[:, 0].astype(np.int64) + 256 * pixels[:, 1].astype(np.int64)
        beyond = f"a label beyond the palette of {len(palette)} harmonics"
        self._refuse(labels >= len(palette), beyond)
        for part in blocks(len(labels)):
            rows.sh[part, 1:] = palette[labels[part]]


_MIN_PALETTE, _MAX_PALETTE = 1 << 10, 1 << 16
_MAX_SIDE = 16383
"""Pixels along a side of a WebP picture."""

_DATE = (1980, 1, 1, 0, 0, 0)


def write_sog(gaussians: Gaussians, path: Path, *, losses: Losses) -> None:
    """Write a bundled ``.sog`` file of version 2, rows in the order they have.

    Scales, colours and harmonics go by codebooks of 256 numbers; harmonics beyond the mean
    colour by a palette of at most 65 536 vectors besides, fewer in small scenes.

    Raises:
        InputError: If there are no Gaussians, or more than a picture has pixels.
        RangeError: If a row cannot be rendered.
    """
    del losses  # what is beyond the codebooks is rounded, and nothing is clamped
    count = len(gaussians)
    if count == 0:
        raise InputError("gaussians: a .sog file cannot hold a scene without Gaussians.")
    if count > _MAX_SIDE**2:
        raise InputError(
            f"gaussians: a .sog file holds at most {_MAX_SIDE**2} Gaussians, got {count}."
        )
    rows = to_rows(gaussians)
    pictures: dict[str, Pixels] = {}
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "splatseg"},
        "count": count,
        "antialias": gaussians.antialiased,
    }
    # 16 bits an axis between bounds, on the scale sign(x) log(1 + |x|).
    wide = rows.means.astype(np.float64)
    places = np.sign(wide) * np.log1p(np.abs(wide))
    low, high = places.min(axis=0), places.max(axis=0)
    steps = unsigned((places - low) / np.maximum(high - low, 1e-12) * 65535, 65535)[0]
    files = ["means_l.webp", "means_u.webp"]
    for name, part in zip(files, (steps & 255, steps >> 8), strict=True):
        pictures[name] = _picture(part.astype(np.uint8))
    meta["means"] = {"mins": low.tolist(), "maxs": high.tolist(), "files": files}
    book, index = scalar_codebook(logs(rows.scales))
    pictures["scales.webp"] = _picture(index)
    meta["scales"] = {"codebook": book.tolist(), "files": ["scales.webp"]}
    # The three lesser components as bytes over [-1 / sqrt 2, 1 / sqrt 2]; alpha says which.
    largest, others = split(rows.rotations)
    three = unsigned((others * 0.5**0.5 + 0.5) * 255, 255)[0].astype(np.uint8)
    pictures["quats.webp"] = _picture(three, (_TAG + largest).astype(np.uint8))
    meta["quats"] = {"files": ["quats.webp"]}
    book, index = scalar_codebook(rows.sh[:, 0])
    alpha = unsigned(rows.opacities * 255, 255)[0].astype(np.uint8)
    pictures["sh0.webp"] = _picture(index, alpha)
    meta["sh0"] = {"codebook": book.tolist(), "files": ["sh0.webp"]}
    if gaussians.sh_degree:
        meta["shN"] = _write_harmonics(rows, pictures, gaussians.sh_degree)
    _bundle(path, meta, pictures)


def _write_harmonics(rows: Rows, pictures: dict[str, Pixels], degree: int) -> dict[str, Any]:
    """A palette of vectors, and each Gaussian's entry of it as two bytes."""
    count, coefficients = len(rows.sh), rows.sh.shape[1] - 1
    vectors: Array = rows.sh[:, 1:].reshape(count, -1)
    # A power of two, about as many entries as Gaussians.
    size = min(_MAX_PALETTE, max(_MIN_PALETTE, 1 << (count.bit_length() - 1)))
    palette, labels = vector_palette(vectors, size)
    book, index = scalar_codebook(palette)
    lines = -(-len(palette) // _PALETTE_WIDTH)
    entries = np.zeros((lines * _PALETTE_WIDTH, coefficients, 4), np.uint8)
    entries[..., 3] = 255
    entries[: len(palette), :, :3] = index.reshape(len(palette), coefficients, 3)
    pictures["shN_centroids.webp"] = entries.reshape(lines, _PALETTE_WIDTH * coefficients, 4)
    pixels = np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], axis=1)
    pictures["shN_labels.webp"] = _picture(pixels.astype(np.uint8))
    return {
        "count": len(palette),
        "bands": degree,
        "codebook": book.tolist(),
        "files": ["shN_centroids.webp", "shN_labels.webp"],
    }


def _picture(colours: Pixels, alpha: Pixels | None = None) -> Pixels:
    """Pixels (n, 3) in rows of an almost square picture, filled up with what is read by nobody."""
    count = len(colours)
    width = -(-int(np.ceil(count**0.5)) // 4) * 4
    height = -(-count // width)
    filled = np.zeros((height * width, 4), np.uint8)
    filled[:count, :3] = colours
    filled[:count, 3] = 255 if alpha is None else alpha
    return filled.reshape(height, width, 4)


def _bundle(path: Path, meta: dict[str, Any], pictures: dict[str, Pixels]) -> None:
    """A zip file of meta.json and lossless pictures, with a fixed date."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        text = json.dumps(meta, allow_nan=False).encode()
        archive.writestr(zipfile.ZipInfo("meta.json", _DATE), text)
        for name, pixels in pictures.items():
            buffer = io.BytesIO()
            # exact: colours under an alpha of 0 are numbers here, not invisible.
            Image.fromarray(pixels, "RGBA").save(
                buffer, format="WEBP", lossless=True, exact=True, quality=50, method=2
            )
            archive.writestr(zipfile.ZipInfo(name, _DATE), buffer.getvalue())
