"""PlayCanvas's SOG, versions 1 and 2: attributes as WebP pictures beside a ``meta.json``.

A Gaussian is the pixel of the same number in row-major order. Positions have 16 bits an axis
over two pictures (low and high bytes), on a scale ``sign(x) log(1 + |x|)``; quaternions are
the smallest three in red, green and blue, with 252 plus the index of the largest component
(w, x, y, z) in alpha. Scales and colours are bytes: between bounds in version 1, into a codebook
of 256 numbers in version 2. Harmonics are a palette of vectors and 16-bit labels into it.
Bundled files (``.sog``) are a zip of the same. See docs/formats/splats.md.
"""

import io
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from splatseg.core import Gaussians
from splatseg.core.gaussians import sigmoid
from splatseg.core.sh import MAX_DEGREE
from splatseg.errors import FileFormatError, MissingFileError, quoted
from splatseg.io.arrays import open_archive, open_member
from splatseg.io.foreign import is_file, read_bytes, reading
from splatseg.io.splats._json import Json
from splatseg.io.splats._quantisation import assemble
from splatseg.io.splats._rows import Array, Filter, Rows, blocks, check_file, check_size, finish

_PALETTE_WIDTH = 64
"""Entries of the palette of harmonics in a row of its picture."""

_MAX_META = 1 << 24

_TAG = 252
"""Alpha of a quaternion whose largest component is w; x, y and z follow."""

Pixels = NDArray[np.uint8]
Load = Callable[[str, int], bytes]


def read_sog(path: Path, *, strict: bool = False) -> Gaussians:
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
        beside = [file for file in path.parent.glob("*.webp") if file.is_file()]
        return _read(
            path,
            lambda name, limit: _load_beside(path, name, limit),
            path.name,
            packed=sum(file.stat().st_size for file in (path, *beside)),
            strict=strict,
        )
    with open_archive(path, where=path, expected="a zip file of SOG") as archive:
        metas = [n for n in archive.namelist() if n.rsplit("/", 1)[-1] == "meta.json"]
        if len(metas) != 1:
            raise FileFormatError(
                f"{path}: expected a zip file with one meta.json, got {len(metas)}."
            )
        folder = metas[0].removesuffix("meta.json")
        return _read(
            path,
            lambda name, limit: _load_member(path, archive, folder + name, limit),
            "meta.json",
            packed=path.stat().st_size,
            strict=strict,
        )


def _load_beside(path: Path, name: str, limit: int) -> bytes:
    """A file in the folder of `path`; a name that points elsewhere is refused."""
    if Path(name).name != name:
        raise FileFormatError(f"{path}: expected the name of a file beside it, got {quoted(name)}.")
    member = path.parent / name
    if not is_file(member):
        raise MissingFileError(
            f"{path.parent}: no such file as {quoted(name)}, which {path.name} names."
        )
    if member.stat().st_size > limit:
        raise FileFormatError(f"{member}: expected at most {limit} bytes.")
    return read_bytes(member, "a picture of SOG")


def _load_member(path: Path, archive: zipfile.ZipFile, name: str, limit: int) -> bytes:
    """A member of a zip file, unpacked only if it is as small as it should be."""
    with open_member(archive, name, where=path, expected="a zip file of SOG") as (member, _):
        data = member.read(limit + 1)
    if len(data) > limit:
        raise FileFormatError(
            f"{path}: expected at most {limit} bytes in {quoted(name)}, got more."
        )
    return data


def _read(path: Path, load: Load, meta_name: str, *, packed: int, strict: bool) -> Gaussians:
    """Read by a function that loads a file of the bundle by name."""
    meta = Json.parse(path, load(meta_name, _MAX_META))
    version = meta["version"].integer() if "version" in meta else 1
    if version not in (1, 2):
        raise FileFormatError(f"{path}: expected SOG version 1 or 2, got {version}.")
    count = (meta["count"] if version == 2 else meta["means"]["shape"].element(0)).integer()
    check_size(path, count, MAX_DEGREE if "shN" in meta else 0, packed=packed)

    def images(entry: Json, number: int) -> list[Pixels]:
        names = [item.text() for item in entry["files"].items()]
        if len(names) != number:
            raise entry["files"].error(f"{number} names of files")
        return [_image(path, load, name, count) for name in names]

    rest = _sh(path, load, meta["shN"], version) if "shN" in meta else None
    rows = Rows.empty(count, 1 + (rest[1].shape[1] if rest else 0))
    _positions(rows, meta["means"], images(meta["means"], 2))
    (quats,) = images(meta["quats"], 1)
    _rotations(path, rows, quats)
    for name, target, width in (("scales", rows.scales, 3), ("sh0", rows.sh[:, 0], 4)):
        (pixels,) = images(meta[name], 1)
        _bytes(rows, meta[name], pixels, target, width=width, version=version)
    if rest is not None:
        labels_name, palette = rest
        _apply_palette(path, rows, _image(path, load, labels_name, count), palette)
    with np.errstate(over="ignore"):
        np.exp(rows.scales, out=rows.scales)
    antialiased = "antialias" in meta and meta["antialias"].value is True
    antialiased |= "model" in meta and meta["model"].value == "antialiased"
    return finish(path, rows, strict=strict, drawn=Filter(antialiased=antialiased))


def _image(path: Path, load: Load, name: str, min_pixels: int) -> Pixels:
    """The pixels (n, 4) of a picture that has at least `min_pixels` of them."""
    with _opened(path, name, load(name, 8 * min_pixels + (1 << 20))) as image:
        if image.width * image.height < min_pixels:
            raise FileFormatError(
                f"{path}: expected at least {min_pixels} pixels in {quoted(name)}, got "
                f"{image.width} x {image.height}."
            )
        if image.width * image.height > 2 * min_pixels + (1 << 22):
            raise FileFormatError(
                f"{path}: expected about {min_pixels} pixels in {quoted(name)}, got "
                f"{image.width} x {image.height}."
            )
        return _pixels(path, name, image).reshape(-1, 4)[:min_pixels]


def _opened(path: Path, name: str, data: bytes) -> Image.Image:
    """A picture whose size is known but whose pixels are not decoded yet."""
    try:
        with reading(path, f"a WebP picture in {quoted(name)}"):
            return Image.open(io.BytesIO(data), formats=["WEBP"])
    except Image.DecompressionBombError as error:
        raise FileFormatError(
            f"{path}: expected a smaller WebP picture in {quoted(name)}."
        ) from error


def _pixels(path: Path, name: str, image: Image.Image) -> Pixels:
    """All pixels (height, width, 4); alpha is 255 where the picture has none."""
    with reading(path, f"a WebP picture in {quoted(name)}"):
        return np.asarray(image.convert("RGBA"))


def _positions(rows: Rows, entry: Json, images: list[Pixels]) -> None:
    """Positions: 16 bits between bounds, then the inverse of sign(x) log(1 + |x|)."""
    low, high = (np.array(entry[name].numbers(min_count=3)) for name in ("mins", "maxs"))
    for part in blocks(len(rows.means)):
        low_bytes, high_bytes = (image[part, :3].astype(np.float64) for image in images)
        logs = low + (high - low) * ((low_bytes + 256 * high_bytes) / 65535)
        with np.errstate(over="ignore"):
            rows.means[part] = np.sign(logs) * np.expm1(np.abs(logs))


def _rotations(path: Path, rows: Rows, pixels: Pixels) -> None:
    """Quaternions: three components as (byte / 255 - 0.5) sqrt 2, the largest by alpha."""
    wrong = pixels[:, 3] < _TAG
    if wrong.any():
        raise FileFormatError(
            f"{path}: {int(wrong.sum())} of {len(wrong)} Gaussians have a rotation whose alpha "
            f"is not {_TAG} to 255; the first is row {int(wrong.argmax())}."
        )
    for part in blocks(len(pixels)):
        others = (pixels[part, :3] / 255 - 0.5) * 2**0.5
        rows.rotations[part] = assemble(pixels[part, 3] - np.uint8(_TAG), others)


def _bytes(
    rows: Rows, entry: Json, pixels: Pixels, target: Array, *, width: int, version: int
) -> None:
    """Log scales, or colours with the opacity in alpha, from bytes."""
    if version == 1:
        low, high = (np.array(entry[name].numbers(min_count=width)) for name in ("mins", "maxs"))
        tables = low[:, None] + (high - low)[:, None] * (np.arange(256) / 255)
    else:
        tables = np.full((width, 256), np.nan)  # a byte beyond a short codebook is refused
        codebook = entry["codebook"].numbers(min_count=1, max_count=256)
        tables[:, : len(codebook)] = codebook
    for part in blocks(len(pixels)):
        for i in range(3):
            target[part, i] = tables[i, pixels[part, i]]
    if width < 4:
        return
    alpha = pixels[:, 3]
    if version == 1:  # a logit between bounds
        rows.opacities[:] = sigmoid(tables[3])[alpha]
    else:
        rows.opacities[:] = alpha / np.float32(255)


def _sh(path: Path, load: Load, entry: Json, version: int) -> tuple[str, Array]:
    """The name of the labels' picture and the palette (entries, coefficients, 3)."""
    names = [item.text() for item in entry["files"].items()]
    if len(names) != 2:
        raise entry["files"].error("2 names of files")
    with _opened(path, names[0], load(names[0], 1 << 24)) as image:
        coefficients = image.width // _PALETTE_WIDTH
        if image.width % _PALETTE_WIDTH or coefficients not in (3, 8, 15) or image.height > 1024:
            raise FileFormatError(
                f"{path}: expected a palette of 192, 512 or 960 pixels a row and at most 1024 "
                f"rows in {quoted(names[0])}, got {image.width} x {image.height}."
            )
        pixels = _pixels(path, names[0], image)[..., :3]
    pixels = pixels.reshape(-1, coefficients, 3)
    if version == 1:
        low, high = entry["mins"].number(), entry["maxs"].number()
        return names[1], (low + (high - low) * (pixels / 255)).astype(np.float32)
    bands, count = entry["bands"].integer(), entry["count"].integer()
    if (bands + 1) ** 2 - 1 != coefficients:
        raise entry["bands"].error(f"the degree of {coefficients} coefficients")
    if count > len(pixels):
        raise entry["count"].error(f"at most the {len(pixels)} entries of the palette")
    codebook = np.full(256, np.nan, np.float32)
    numbers = entry["codebook"].numbers(min_count=1, max_count=256)
    codebook[: len(numbers)] = numbers
    return names[1], codebook[pixels[:count]]


def _apply_palette(path: Path, rows: Rows, pixels: Pixels, palette: Array) -> None:
    """Give each Gaussian the harmonics that its label (red + 256 green) points to."""
    labels = pixels[:, 0].astype(np.int64) + 256 * pixels[:, 1].astype(np.int64)
    wrong = labels >= len(palette)
    if wrong.any():
        raise FileFormatError(
            f"{path}: {int(wrong.sum())} of {len(labels)} Gaussians have a label beyond the "
            f"palette of {len(palette)} harmonics; the first is row {int(wrong.argmax())}."
        )
    for part in blocks(len(labels)):
        rows.sh[part, 1:] = palette[labels[part]]
