"""Masks: COCO run lengths, an npz, or a folder of pictures a view.

The JSON and the folder are what SAM's automatic mask generator writes.
"""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from msgspec import Meta
from numpy.typing import NDArray
from typing_extensions import override

from splatseg.core import MaskSet, Rle
from splatseg.errors import reason
from splatseg.io.arrays import npz_names, read_npy, read_npz
from splatseg.io.evidence._base import EvidenceKind, FileEvidence
from splatseg.io.evidence._labels import read_id_map
from splatseg.io.foreign import derived_from, expect, malformed
from splatseg.io.json_files import read_json_value
from splatseg.io.limits import check_unpacked
from splatseg.io.schema import Side, check_array, structured

MASK_TABLE = "metadata.csv"
"""What SAM's tool writes beside the pictures of masks of one photograph."""

_STACKS = ("masks", "segmentation", "segmentations")
"""Arrays of an npz that are stacks of masks."""

_INT32 = np.iinfo(np.int32)


@dataclass(frozen=True, slots=True)
class RunLengths:
    """A COCO mask: text (compressed) or numbers."""

    size: tuple[Side, Side]
    """Height and width."""

    counts: str | list[Annotated[int, Meta(ge=0, le=2**32 - 1)]]

    def mask(self, height: int, width: int, *, where: str) -> Rle:
        """The mask in a picture of this size.

        Raises:
            FileFormatError: If it is of another, or its runs do not add up to it.
        """
        what = f"run lengths of {width}x{height} pixels, with the size [{height}, {width}]"
        expect(self.size == (height, width), where, what, list(self.size))
        with derived_from(where):
            if isinstance(self.counts, str):
                return Rle.from_coco(self.counts, height=height, width=width)
            return Rle(height=height, width=width, counts=np.array(self.counts, np.uint32))


@dataclass(frozen=True, slots=True)
class _Row:
    segmentation: RunLengths
    score: float | None = None
    predicted_iou: float | None = None
    level: Annotated[int, Meta(ge=-(2**31), le=2**31 - 1)] = 0
    objectness: float | None = None


@dataclass(frozen=True, slots=True)
class _Picture:
    height: Side
    width: Side


@dataclass(frozen=True, slots=True)
class _Own(_Picture):
    masks: list[_Row]


@dataclass(frozen=True, slots=True)
class _Sa1b:
    image: _Picture
    annotations: list[_Row]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MaskEvidence(FileEvidence):
    """Overlapping masks without classes."""

    kind: EvidenceKind = "masks"

    @override
    def masks(self, name: str) -> MaskSet:
        path = self.file_of(name)
        if path.is_dir():
            return _read_images(path)
        return _read_arrays(path) if path.suffix in (".npz", ".npy") else _read_json(path)


def holds_masks(path: Path) -> bool:
    """Whether an npz, or an ``.npy`` of booleans, is a stack of masks."""
    if path.suffix == ".npy":
        array = read_npy(path, mapped=True)
        return array.ndim == 3 and array.dtype.kind == "b"
    return path.suffix == ".npz" and _stack_name(path) is not None


def _stack_name(path: Path) -> str | None:
    """The array of an npz that is a stack of masks; one without a name is where it is alone."""
    names = npz_names(path)
    if tuple(names) == ("arr_0",):
        return "arr_0"
    return next((name for name in _STACKS if name in names), None)


def _read_arrays(path: Path) -> MaskSet:
    """The masks (m, height, width) of an ``.npy``, or of an npz: ``masks`` or another usual name.

    Of an npz ``scores``, or SAM's ``predicted_iou``, and ``levels`` may lack.
    """
    if path.suffix == ".npy":
        arrays = {"masks": read_npy(path)}
    else:
        name = _stack_name(path) or "masks"
        arrays = read_npz(path, [name], optional=["scores", "predicted_iou", "levels"])
        arrays["masks"] = arrays[name]
    masks = check_array(path, "masks", arrays["masks"], ("masks", "height", "width"), "bui")
    sound = 0 not in masks.shape[1:] and not (masks.size and masks.min() < 0)
    expect(sound, path, f"masks in booleans or 0 and 1, got {masks.dtype} of {masks.shape}")
    scores = _of_masks(path, "scores", arrays.get("scores", arrays.get("predicted_iou")), masks, 1)
    levels = _of_masks(path, "levels", arrays.get("levels"), masks, 0)
    whole = (levels == np.trunc(levels)) & (levels >= _INT32.min) & (levels <= _INT32.max)
    what = f"a whole number as level for each of {len(masks)} masks, from {_INT32.min} to "
    expect(whole.all(), path, f"{what}{_INT32.max}, got others")
    rles = [Rle.encode(torch.from_numpy(mask != 0)) for mask in masks]
    return _mask_set(rles, scores.tolist(), levels.tolist(), masks.shape[1:])


def _of_masks(
    path: Path, name: str, values: NDArray[Any] | None, masks: NDArray[Any], default: int
) -> NDArray[Any]:
    """A finite number of each mask."""
    if values is None:
        return np.full(len(masks), default)
    values = check_array(path, name, values, (len(masks),), "biuf")
    expect(np.isfinite(values).all(), path, f"finite {name}, got NaN or infinity")
    return values


def _read_images(folder: Path) -> MaskSet:
    """The masks of a folder of pictures, zero outside a mask, in the order of their numbers.

    Scores are ``predicted_iou`` of the metadata.csv that SAM's tool writes beside them, else 1.
    """
    files = sorted(folder.glob("*.png"), key=lambda p: (len(p.stem), p.stem))
    expect(files, folder, "PNG pictures of masks, got none")
    scores = _image_scores(folder / MASK_TABLE)
    masks: list[Rle] = []
    for path in files:  # one at a time: all together may take far more than their files
        array = read_id_map(path)
        height, width = (masks[0].height, masks[0].width) if masks else array.shape
        what = f"{width}x{height} pixels as {files[0].name} has"
        fits = array.shape == (height, width)
        expect(fits, path, f"{what}, got {array.shape[1]}x{array.shape[0]}")
        masks.append(Rle.encode(torch.from_numpy(array != 0)))
    found = [scores.get(path.stem, 1.0) for path in files]
    return _mask_set(masks, found, [0] * len(files), (masks[0].height, masks[0].width))


def _mask_set(
    masks: Sequence[Rle], scores: Sequence[float], levels: Sequence[int], size: tuple[int, int]
) -> MaskSet:
    return MaskSet(
        height=size[0],
        width=size[1],
        masks=tuple(masks),
        scores=torch.tensor(scores, dtype=torch.float32).clamp(0, 1),
        levels=torch.tensor(levels, dtype=torch.int32),
    )


def mask_folders(folder: Path, *, marked_by: Literal["metadata.csv", "*.png"]) -> dict[str, Path]:
    """Folders of mask pictures by view name: those with SAM's metadata.csv, or any with PNGs."""
    named = {path.parent for path in folder.rglob(marked_by)}
    return {
        path.relative_to(folder).as_posix(): path
        for path in sorted(named - {folder})
        if not any(part.startswith((".", "_")) for part in path.relative_to(folder).parts)
    }


def _image_scores(path: Path) -> Mapping[str, float]:
    if not path.is_file():
        return {}
    try:
        with path.open(encoding="utf-8", newline="") as file:
            scores = {row["id"]: float(row["predicted_iou"]) for row in csv.DictReader(file)}
    except (KeyError, TypeError, ValueError, csv.Error, OSError) as error:
        what = "the columns id and predicted_iou, as SAM's tool writes"
        raise malformed(path, f"{what} ({reason(error)})") from error
    expect(all(map(math.isfinite, scores.values())), path, "finite scores, got others")
    return scores


def holds_mask_rows(content: object) -> bool:
    """Whether a JSON value is the masks of one picture.

    Ours are an object with ``masks``, ``height`` and ``width``; a file of SA-1B has ``annotations``
    and ``image``; what SAM's generator gives is a list of rows, and their first tells the size.
    """
    if isinstance(content, list):
        first: object = content[0] if content else None
        return isinstance(first, dict) and "segmentation" in first
    if not isinstance(content, dict):
        return False
    of_sa1b = isinstance(content.get("image"), dict) and "annotations" in content
    return isinstance(content.get("masks"), list) or of_sa1b


def _read_json(path: Path) -> MaskSet:
    """The masks of one file.

    Scores are ``score``, else ``predicted_iou``, else 1, clamped to [0, 1]; levels are
    ``level``, else 0. Run lengths may be compressed text or a list of numbers.
    """
    content: Any = read_json_value(path)
    if isinstance(content, list):
        first = content[0] if content and isinstance(content[0], dict) else {}
        hint = "masks in run lengths, as SAM's generator gives them with output_mode='coco_rle'"
        expect(isinstance(first.get("segmentation"), dict), path, f"{hint}, got others")
        rows = structured(content, list[_Row], where=path)
        height, width = rows[0].segmentation.size
    elif isinstance(content, dict) and "masks" not in content and "image" in content:
        found = structured(content, _Sa1b, where=path)
        rows, height, width = found.annotations, found.image.height, found.image.width
    else:
        own = structured(content, _Own, where=path)
        rows, height, width = own.masks, own.height, own.width
    what = f"masks of {width}x{height} pixels"
    check_unpacked(path, height * width, packed=path.stat().st_size, what=what)
    masks = [
        row.segmentation.mask(height, width, where=f"{path}: masks[{i}]")
        for i, row in enumerate(rows)
    ]
    scores = [next((s for s in (r.score, r.predicted_iou) if s is not None), 1.0) for r in rows]
    objectness = [row.objectness for row in rows if row.objectness is not None]
    expect(
        len(objectness) in (0, len(rows)), path,
        f"objectness of all {len(rows)} masks or of none, got {len(objectness)}",
    )  # fmt: skip
    found = _mask_set(masks, scores, [row.level for row in rows], (height, width))
    known = torch.tensor(objectness, dtype=torch.float32).clamp(0, 1)
    return replace(found, objectness=known) if objectness else found


def masks_content(masks: MaskSet) -> dict[str, Any]:
    """The JSON object of a set of masks, which is read back as the same."""
    count = len(masks)
    known = [None] * count if masks.objectness is None else masks.objectness.tolist()
    rows_of = zip(masks.masks, masks.scores.tolist(), masks.levels.tolist(), known, strict=True)
    rows = [
        {
            "segmentation": {"size": [masks.height, masks.width], "counts": mask.to_coco()},
            "area": mask.area,
            "bbox": list(mask.bbox),
            "score": score,
            "level": level,
        }
        | ({} if objectness is None else {"objectness": objectness})
        for mask, score, level, objectness in rows_of
    ]
    return {"height": masks.height, "width": masks.width, "masks": rows}
