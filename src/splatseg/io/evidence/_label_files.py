"""One view's label map as people have it: PNG ids, PNG colours, arrays of ids, soft maps.

Every reader gives the ids as they stand in the file, -1 where it says none, and how sure the file
is of them where it tells.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg.core import ClassTable
from splatseg.errors import FileFormatError, brief
from splatseg.io.arrays import npz_names, read_npy, read_npz
from splatseg.io.evidence._base import MAX_FILE_ID
from splatseg.io.foreign import reading
from splatseg.io.images import open_image
from splatseg.io.limits import check_unpacked

SOFT_NAMES = ("probabilities", "logits")
"""Arrays of an npz that is a soft map."""

LABEL_NAMES = ("ids", *SOFT_NAMES)
"""Arrays of an npz that is a label map."""

_BYTES_OF_PIXEL = 5
"""A byte as it is decoded and an int32."""

_BYTES_OF_TIFF = 24
"""Four bytes as they are decoded, a copy that is checked, an int64 and an int32."""

_BYTES_OF_COLOUR = 32
"""Three bytes as they are decoded, and four integers that find the colour's id."""

_TIFF = (".tif", ".tiff")
_NONE = -1
_BLACK = (0, 0, 0)
_SUM_TOLERANCE = 0.02
"""How far from 1 float16 probabilities of hundreds of classes may sum."""

Ids = NDArray[np.int32]
Scores = NDArray[np.float32]


class Palette:
    """Ids by colour, from a class table."""

    def __init__(self, table: ClassTable) -> None:
        self._names: dict[tuple[int, int, int], list[str]] = {}
        self._ids: dict[tuple[int, int, int], int] = {}
        for row in table.rows:
            if row.colour is not None:
                self._names.setdefault(row.colour, []).append(row.name)
                self._ids.setdefault(row.colour, row.id)
        # What several classes share with nothing is nothing.
        if len(self._names.get(_BLACK, ["", ""])) > 1:
            self._ids[_BLACK], self._names[_BLACK] = _NONE, ["none"]

    def ids(self, path: Path, pixels: NDArray[np.uint8]) -> Ids:
        """Ids (height, width) of colours (height, width, 3); black is none unless it is a class.

        Raises:
            FileFormatError: If a colour is of no class, or of several.
        """
        codes = pixels.astype(np.int64) @ np.array([1 << 16, 1 << 8, 1])
        found, index, counts = np.unique(codes, return_inverse=True, return_counts=True)
        table = np.empty(len(found), np.int32)
        for i, (code, count) in enumerate(zip(found.tolist(), counts.tolist(), strict=True)):
            colour = (code >> 16, code >> 8 & 255, code & 255)
            names = self._names.get(colour, [])
            if len(names) != 1:
                what = brief(" and ".join(names[:3])) if names else "no class of the table"
                raise FileFormatError(
                    f"{path}: expected the colours of the class table, got {colour} in {count} "
                    f"pixels, which is that of {what}."
                )
            table[i] = self._ids[colour]
        return table[index.reshape(codes.shape)]


def is_soft(path: Path) -> bool:
    """Whether a file holds one score a class and pixel rather than ids.

    Raises:
        FileFormatError: If it is damaged.
    """
    if path.suffix == ".npz":
        return not set(SOFT_NAMES).isdisjoint(npz_names(path))
    return path.suffix == ".npy" and read_npy(path, mapped=True).ndim == 3


def read_label_file(
    path: Path, *, palette: Palette | None = None, channels: int | None = None
) -> tuple[Ids, Scores | None]:
    """Ids (height, width) as they stand in a file, -1 where it has none, and their confidence.

    A soft map's ids are its channels, counted from 0.

    Args:
        path: The file.
        palette: Ids by colour, for pictures of three channels.
        channels: How many classes a soft map must have; None takes the shorter of its first and
            last axis for them.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no label map, or an id or score is out of range.
    """
    if path.suffix == ".npy":
        return _from_array(path, read_npy(path), channels)
    if path.suffix == ".npz":
        there = npz_names(path)
        names = [name for name in LABEL_NAMES if name in there]
        if len(names) != 1:
            raise FileFormatError(
                f"{path}: expected one array ids, probabilities or logits, got "
                f"{', '.join(names) or 'none of them'}."
            )
        return _from_array(path, read_npz(path, names)[names[0]], channels)
    return _from_picture(path, palette), None


def read_id_map(path: Path) -> Ids:
    """The ids of a single-channel image as they stand in the file.

    A palette image gives its indices, not its colours.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it has more than one channel, or cannot be decoded.
    """
    return _from_picture(path, None)


def _from_picture(path: Path, palette: Palette | None) -> Ids:
    with open_image(path) as image:
        coloured = palette is not None and image.mode in ("RGB", "RGBA")
        with reading(path, "a label map"):
            pages = int(getattr(image, "n_frames", 1))
        if pages != 1:
            raise FileFormatError(f"{path}: expected one picture of ids, got {pages} pages.")
        single = len(image.getbands()) == 1 and (image.mode != "F" or path.suffix in _TIFF)
        if not coloured and not single:
            raise FileFormatError(
                f"{path}: expected one channel of ids, got {image.mode}; a coloured picture "
                "of labels needs a class table with its colours."
            )
        width, height = image.size
        bytes_of_pixel = _BYTES_OF_TIFF if path.suffix in _TIFF else _BYTES_OF_PIXEL
        bytes_of_pixel = _BYTES_OF_COLOUR if coloured else bytes_of_pixel
        check_unpacked(
            path,
            width * height * bytes_of_pixel,
            packed=path.stat().st_size,
            what=f"a label map of {width}x{height} pixels",
        )
        with reading(path, "a label map"):
            array = np.asarray(image.convert("RGB") if coloured else image)
    if coloured and palette is not None:
        return palette.ids(path, array)
    if path.suffix in _TIFF:  # of 32 bits, whole numbers or floats, as arrays are
        return _from_array(path, array, None)[0]
    return _checked(path, array, least=0)


def _from_array(path: Path, array: NDArray[Any], channels: int | None) -> tuple[Ids, Scores | None]:
    if array.ndim == 3 and array.dtype.kind == "f":
        return _from_scores(path, array, channels)
    if array.ndim == 3 and 1 in (array.shape[0], array.shape[2]):
        array = array[0] if array.shape[0] == 1 else array[..., 0]
    if array.ndim != 2 or array.dtype.kind not in "biuf" or not array.size:
        raise FileFormatError(
            f"{path}: expected ids (height, width) or scores (classes, height, width) or (height, "
            f"width, classes), got {array.dtype} of shape {array.shape}."
        )
    whole = array
    if array.dtype.kind == "f":
        whole = np.where(np.isfinite(array), array, -2)
        if bool((whole != np.round(whole)).any()) or bool((np.abs(whole) > 1e9).any()):
            raise FileFormatError(f"{path}: expected whole numbers as ids, got fractions.")
    elif array.dtype == np.uint64 and int(array.max()) > MAX_FILE_ID:
        whole = np.minimum(array, MAX_FILE_ID + 1)
    return _checked(path, whole.astype(np.int64), least=_NONE), None


def _from_scores(path: Path, array: NDArray[Any], channels: int | None) -> tuple[Ids, Scores]:
    """The channel of the highest score, and its probability; scores that are none are logits."""
    first, last = array.shape[0], array.shape[2]
    wanted = min(first, last) if channels is None else channels
    if first == last or wanted not in (first, last):
        many = "fewer classes than pixels" if channels is None else f"{channels} classes"
        raise FileFormatError(
            f"{path}: expected scores of {many} along the first or last axis, got shape "
            f"{array.shape}."
        )
    scores = array if first == wanted else np.moveaxis(array, 2, 0)
    scores = scores.astype(np.float32)
    if not scores.size or not bool(np.isfinite(scores).all()):
        raise FileFormatError(f"{path}: expected finite scores, got NaN, infinity or none at all.")
    ids = scores.argmax(axis=0).astype(np.int32)
    top = scores.max(axis=0)
    sums = scores.sum(axis=0)
    shares = scores.min() >= 0 and bool((np.abs(sums - 1) <= _SUM_TOLERANCE).all())
    if not shares:  # logits: softmax, of which the highest is 1 over the sum of the others to it
        top = 1 / np.exp(scores - top).sum(axis=0)
    return ids, np.clip(top, 0, 1).astype(np.float32)


def _checked(path: Path, ids: NDArray[Any], *, least: int) -> Ids:
    if ids.size and (ids.min() < least or ids.max() > MAX_FILE_ID):
        raise FileFormatError(
            f"{path}: expected ids in [{least}, {MAX_FILE_ID}], got [{ids.min()}, {ids.max()}]."
        )
    return ids.astype(np.int32)
