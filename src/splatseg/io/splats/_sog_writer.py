"""Writing PlayCanvas's SOG, version 2, bundled: see `splatseg.io.splats.sog` and the docs."""

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from splatseg.core import Gaussians
from splatseg.errors import InputError
from splatseg.io.splats._quantisation import scalar_codebook, split, vector_palette
from splatseg.io.splats._rows import Array, Losses, Rows, logs, to_rows, unsigned

_PALETTE_WIDTH = 64
"""Entries of the palette of harmonics in a row of its picture."""

_MIN_PALETTE, _MAX_PALETTE = 1 << 10, 1 << 16
_TAG = 252
"""Alpha of a quaternion whose largest component is w; x, y and z follow."""

_MAX_SIDE = 16383
"""Pixels along a side of a WebP picture."""

_DATE = (1980, 1, 1, 0, 0, 0)

Pixels = NDArray[np.uint8]


def write_sog(gaussians: Gaussians, path: Path, *, losses: Losses) -> None:
    """Write a bundled ``.sog`` file, rows in the order they have.

    Scales, colours and harmonics go by codebooks of 256 numbers; harmonics beyond the mean
    colour by a palette of at most 65 536 vectors besides, fewer in small scenes.

    Raises:
        InputError: If there are no Gaussians, or more than a picture has pixels.
        RangeError: If a row cannot be rendered.
    """
    count = len(gaussians)
    if count == 0:
        raise InputError("gaussians: a .sog file cannot hold a scene without Gaussians.")
    if count > _MAX_SIDE**2:
        raise InputError(
            f"gaussians: a .sog file holds at most {_MAX_SIDE**2} Gaussians, got {count}."
        )
    rows = to_rows(gaussians)
    losses.drop_extra(gaussians)
    losses.drop_low_pass(gaussians)
    pictures: dict[str, Pixels] = {}
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "splatseg"},
        "count": count,
        "antialias": gaussians.antialiased,
    }
    meta["means"] = _positions(rows, pictures)
    meta["scales"] = _scales(rows, pictures)
    meta["quats"] = _rotations(rows, pictures)
    meta["sh0"] = _colours(rows, pictures)
    if gaussians.sh_degree:
        meta["shN"] = _harmonics(rows, pictures, gaussians.sh_degree)
    _bundle(path, meta, pictures)


def _positions(rows: Rows, pictures: dict[str, Pixels]) -> dict[str, Any]:
    """16 bits an axis between bounds, on the scale sign(x) log(1 + |x|)."""
    wide = rows.means.astype(np.float64)
    places = np.sign(wide) * np.log1p(np.abs(wide))
    low, high = places.min(axis=0), places.max(axis=0)
    steps = unsigned((places - low) / np.maximum(high - low, 1e-12) * 65535, 65535)[0]
    for name, part in (("means_l.webp", steps & 255), ("means_u.webp", steps >> 8)):
        pictures[name] = _picture(_opaque(part.astype(np.uint8)))
    return {
        "mins": low.tolist(),
        "maxs": high.tolist(),
        "files": ["means_l.webp", "means_u.webp"],
    }


def _scales(rows: Rows, pictures: dict[str, Pixels]) -> dict[str, Any]:
    book, index = scalar_codebook(logs(rows.scales))
    pictures["scales.webp"] = _picture(_opaque(index))
    return {"codebook": book.tolist(), "files": ["scales.webp"]}


def _rotations(rows: Rows, pictures: dict[str, Pixels]) -> dict[str, Any]:
    """The three lesser components as bytes over [-1 / sqrt 2, 1 / sqrt 2]; alpha says which."""
    largest, others = split(rows.rotations)
    pixels = np.empty((len(largest), 4), np.uint8)
    pixels[:, :3] = unsigned((others * 0.5**0.5 + 0.5) * 255, 255)[0]
    pixels[:, 3] = _TAG + largest
    pictures["quats.webp"] = _picture(pixels)
    return {"files": ["quats.webp"]}


def _colours(rows: Rows, pictures: dict[str, Pixels]) -> dict[str, Any]:
    book, index = scalar_codebook(rows.sh[:, 0])
    alpha = unsigned(rows.opacities * 255, 255)[0].astype(np.uint8)
    pictures["sh0.webp"] = _picture(np.concatenate([index, alpha[:, None]], axis=1))
    return {"codebook": book.tolist(), "files": ["sh0.webp"]}


def _harmonics(rows: Rows, pictures: dict[str, Pixels], degree: int) -> dict[str, Any]:
    """A palette of vectors, and each Gaussian's entry of it as two bytes."""
    count, coefficients = len(rows.sh), rows.sh.shape[1] - 1
    vectors: Array = rows.sh[:, 1:].reshape(count, -1)
    palette, labels = vector_palette(vectors, _palette_size(count))
    book, index = scalar_codebook(palette)
    lines = -(-len(palette) // _PALETTE_WIDTH)
    entries = np.zeros((lines * _PALETTE_WIDTH, coefficients, 4), np.uint8)
    entries[..., 3] = 255
    entries[: len(palette), :, :3] = index.reshape(len(palette), coefficients, 3)
    pictures["shN_centroids.webp"] = entries.reshape(lines, _PALETTE_WIDTH * coefficients, 4)
    pixels = np.zeros((count, 4), np.uint8)
    pixels[:, 0], pixels[:, 1], pixels[:, 3] = labels & 255, labels >> 8, 255
    pictures["shN_labels.webp"] = _picture(pixels)
    return {
        "count": len(palette),
        "bands": degree,
        "codebook": book.tolist(),
        "files": ["shN_centroids.webp", "shN_labels.webp"],
    }


def _palette_size(count: int) -> int:
    """A power of two, about as many entries as Gaussians, between 1024 and 65 536."""
    return min(_MAX_PALETTE, max(_MIN_PALETTE, 1 << (count.bit_length() - 1)))


def _opaque(pixels: Pixels) -> Pixels:
    """Red, green, blue (n, 3) with an alpha of 255."""
    return np.pad(pixels, ((0, 0), (0, 1)), constant_values=255)


def _picture(pixels: Pixels) -> Pixels:
    """Pixels (n, 4) in rows of an almost square picture, filled up with what is read by nobody."""
    count = len(pixels)
    width = -(-int(np.ceil(count**0.5)) // 4) * 4
    height = -(-count // width)
    filled = np.zeros((height * width, 4), np.uint8)
    filled[:count] = pixels
    return filled.reshape(height, width, 4)


def _bundle(path: Path, meta: dict[str, Any], pictures: dict[str, Pixels]) -> None:
    """A zip file of meta.json and lossless pictures, with a fixed date."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        members = {"meta.json": json.dumps(meta, allow_nan=False).encode()}
        for name, data in members.items():
            archive.writestr(zipfile.ZipInfo(name, _DATE), data)
        for name, pixels in pictures.items():
            buffer = io.BytesIO()
            # exact: colours under an alpha of 0 are numbers here, not invisible.
            Image.fromarray(pixels, "RGBA").save(
                buffer, format="WEBP", lossless=True, exact=True, quality=50, method=2
            )
            archive.writestr(zipfile.ZipInfo(name, _DATE), buffer.getvalue())
