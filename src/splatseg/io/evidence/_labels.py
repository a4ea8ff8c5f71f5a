"""Label maps: PNG ids as we write them (0 for none), PNG colours, arrays of ids, soft maps.

Every reader gives the ids as they stand in the file, -1 where it says none, and how sure the file
is of them where it tells; `IdRule` makes ids in memory of them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from typing_extensions import override

from splatseg.core import UNLABELLED, ClassTable, LabelMap, MaskSet, Rle, View
from splatseg.core.scene import camera_of_map
from splatseg.errors import brief
from splatseg.io.arrays import npz_names, read_npy, read_npz
from splatseg.io.evidence._base import (
    CONFIDENCE_FOLDER,
    HEADER_FILE,
    MAX_FILE_ID,
    PICTURE_SUFFIXES,
    EvidenceKind,
    FileEvidence,
)
from splatseg.io.foreign import expect, malformed, reading
from splatseg.io.images import left_out_pixels, open_image
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
                got = f"{colour} in {count} pixels, which is that of {what}"
                raise malformed(path, f"the colours of the class table, got {got}")
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
        got = ", ".join(names) or "none of them"
        expect(len(names) == 1, path, f"one array ids, probabilities or logits, got {got}")
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
        expect(pages == 1, path, f"one picture of ids, got {pages} pages")
        single = len(image.getbands()) == 1 and (image.mode != "F" or path.suffix in _TIFF)
        hint = "a coloured picture of labels needs a class table with its colours"
        expect(coloured or single, path, f"one channel of ids, got {image.mode}; {hint}")
        width, height = image.size
        size = _BYTES_OF_TIFF if path.suffix in _TIFF else _BYTES_OF_PIXEL
        size = width * height * (_BYTES_OF_COLOUR if coloured else size)
        what = f"a label map of {width}x{height} pixels"
        check_unpacked(path, size, packed=path.stat().st_size, what=what)
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
    fits = array.ndim == 2 and array.dtype.kind in "biuf" and array.size
    what = "ids (height, width) or scores (classes, height, width) or (height, width, classes)"
    expect(fits, path, f"{what}, got {array.dtype} of shape {array.shape}")
    whole = array
    if array.dtype.kind == "f":
        whole = np.where(np.isfinite(array), array, -2)
        fits = bool((whole == np.round(whole)).all()) and bool((np.abs(whole) <= 1e9).all())
        expect(fits, path, "whole numbers as ids, got fractions")
    elif array.dtype == np.uint64 and int(array.max()) > MAX_FILE_ID:
        whole = np.minimum(array, MAX_FILE_ID + 1)
    return _checked(path, whole.astype(np.int64), least=_NONE), None


def _from_scores(path: Path, array: NDArray[Any], channels: int | None) -> tuple[Ids, Scores]:
    """The channel of the highest score, and its probability; scores that are none are logits."""
    first, last = array.shape[0], array.shape[2]
    wanted = min(first, last) if channels is None else channels
    many = "fewer classes than pixels" if channels is None else f"{channels} classes"
    what = f"scores of {many} along the first or last axis, got shape {array.shape}"
    expect(first != last and wanted in (first, last), path, what)
    scores = array if first == wanted else np.moveaxis(array, 2, 0)
    scores = scores.astype(np.float32)
    finite = scores.size and np.isfinite(scores).all()
    expect(finite, path, "finite scores, got NaN, infinity or none at all")
    ids = scores.argmax(axis=0).astype(np.int32)
    top = scores.max(axis=0)
    sums = scores.sum(axis=0)
    shares = scores.min() >= 0 and bool((np.abs(sums - 1) <= _SUM_TOLERANCE).all())
    if not shares:  # logits: softmax, of which the highest is 1 over the sum of the others to it
        top = 1 / np.exp(scores - top).sum(axis=0)
    return ids, np.clip(top, 0, 1).astype(np.float32)


def _checked(path: Path, ids: NDArray[Any], *, least: int) -> Ids:
    low, high = (int(ids.min()), int(ids.max())) if ids.size else (0, 0)
    within = least <= low and high <= MAX_FILE_ID
    expect(within, path, f"ids in [{least}, {MAX_FILE_ID}], got [{low}, {high}]")
    return ids.astype(np.int32)


CONFIDENCE_STEPS = 65535
"""A confidence of 1 in a file of confidences, 16 bit."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IdRule:
    """How ids in files become ids in memory.

    -1 is none in either. Without a change 0 is void and becomes -1, other ids stay. With
    `zero_is_class` every id grows by 1, so that 0 stays free for void; `void` is then the file's
    id of void, if any.
    """

    zero_is_class: bool = False
    void: int | None = None

    def to_memory(self, ids: NDArray[np.int32]) -> NDArray[np.int32]:
        """Ids as they are in memory."""
        none = (ids < 0) if self.zero_is_class else (ids <= 0)
        if self.void is not None:
            none |= ids == self.void
        shifted = ids + 1 if self.zero_is_class else ids
        return np.where(none, np.int32(UNLABELLED), shifted).astype(np.int32)

    def classes(self, table: ClassTable | None) -> ClassTable | None:
        """A class table of the file's ids as one of the ids in memory."""
        if table is None:
            return None
        if not self.zero_is_class:
            return ClassTable(rows=tuple(row for row in table.rows if row.id != 0))
        rows = (row for row in table.rows if row.id != self.void)
        return ClassTable(rows=tuple(replace(row, id=row.id + 1) for row in rows))

    @property
    def source_ids(self) -> Mapping[int, int] | None:
        """Id in files by id in memory, where they differ."""
        if not self.zero_is_class:
            return None
        return {id + 1: id for id in range(MAX_FILE_ID + 1) if id != self.void}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LabelEvidence(FileEvidence):
    """One label map a view."""

    kind: EvidenceKind = "labels"
    table: ClassTable | None
    """Classes by the ids of the files."""

    rule: IdRule = IdRule()

    palette: Palette | None = None
    """Ids by colour, where the class table has colours."""

    channels: int | None = None
    """How many classes soft maps have; None takes what is there."""

    recorded: Mapping[int, int] | None = None
    """The model's own id by id in the files, as evidence.json has it."""

    remarks: tuple[str, ...] = ()
    """What was found when it was opened, a sentence each."""

    masked: Mapping[str, View] = field(default_factory=dict[str, View])
    """Views by their names, whose masks leave pixels out: these have no id."""

    @property
    @override
    def classes(self) -> ClassTable | None:
        return self.rule.classes(self.table)

    @property
    @override
    def source_ids(self) -> Mapping[int, int] | None:
        return self.rule.source_ids if self.recorded is None else self.recorded

    @property
    @override
    def notes(self) -> tuple[str, ...]:
        return self.remarks

    @override
    def label_map(self, name: str) -> LabelMap:
        path = self.file_of(name)
        read, sure = read_label_file(path, palette=self.palette, channels=self.channels)
        ids = self.rule.to_memory(read)
        self._check_recorded(name, ids)
        confidence = self._confidence(name, ids.shape) if sure is None else torch.from_numpy(sure)
        found = LabelMap(ids=torch.from_numpy(ids), confidence=confidence)
        return _used(found, self.masked[name]) if name in self.masked else found

    @override
    def masks(self, name: str) -> MaskSet:
        return masks_of_ids(self.label_map(name))[0]

    def _check_recorded(self, name: str, ids: NDArray[np.int32]) -> None:
        """Refuse an id of which evidence.json does not tell what it was."""
        if self.recorded is None:
            return
        unknown = {int(id) for id in np.unique(ids)} - {UNLABELLED} - self.recorded.keys()
        if unknown:
            got = f"none of the id {min(unknown)}, which view {name!r} has"
            raise malformed(self.folder / HEADER_FILE, f"source_ids of all ids, got {got}")

    def _confidence(self, name: str, shape: tuple[int, ...]) -> torch.Tensor | None:
        path = self.folder / CONFIDENCE_FOLDER / f"{name}.png"
        if not path.is_file():
            return None
        steps = read_id_map(path)
        what = f"{shape[1]}x{shape[0]} pixels as the label map has"
        expect(steps.shape == shape, path, f"{what}, got {steps.shape[1]}x{steps.shape[0]}")
        return torch.from_numpy((steps / CONFIDENCE_STEPS).astype(np.float32))


def masks_of_ids(label_map: LabelMap) -> tuple[MaskSet, tuple[int, ...]]:
    """A mask of each id of a label map, ascending, and the ids.

    The score of a mask is the mean confidence of its pixels, 1 where there is none.
    """
    present = [int(i) for i in torch.unique(label_map.ids).tolist() if i != UNLABELLED]
    dense = [label_map.ids == id for id in present]
    scores = [
        1.0 if label_map.confidence is None else float(label_map.confidence[mask].mean())
        for mask in dense
    ]
    masks = MaskSet(
        height=label_map.height,
        width=label_map.width,
        masks=tuple(Rle.encode(mask) for mask in dense),
        scores=torch.tensor(scores, dtype=torch.float32),
        levels=torch.zeros(len(present), dtype=torch.int32),
    )
    return masks, tuple(present)


def _used(found: LabelMap, view: View) -> LabelMap:
    """A label map without ids where the mask of its view is 0."""
    left_out = left_out_pixels(view, found.height, found.width)
    if left_out is None:
        return found
    camera_of_map(view, found.height, found.width)
    return replace(found, ids=found.ids.masked_fill(left_out, UNLABELLED))


_TIMES = 4
"""Pixels of a label map for each pixel of its photograph; more are of another picture."""


def check_size(path: Path, view: View) -> None:
    """Refuse a picture of ids that is far larger than its photograph, before it costs memory.

    Raises:
        FileFormatError: If it has more than four times the pixels of its photograph.
    """
    if path.suffix not in PICTURE_SUFFIXES:
        return  # an .npy takes as much on the disk as in memory, `io.limits` holds an .npz
    with open_image(path) as image:
        width, height = image.size
    camera = view.camera
    what = f"a label map of {camera.width}x{camera.height} pixels as the photograph of the view has"
    fits = width * height <= _TIMES * camera.width * camera.height
    expect(fits, path, f"{what}, got {width}x{height}")
