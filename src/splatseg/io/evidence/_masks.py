"""Masks: COCO run lengths, an npz, or a folder of pictures a view.

The JSON and the folder are what SAM's automatic mask generator writes.
"""

import csv
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeGuard, cast

import numpy as np
import torch
from numpy.typing import NDArray
from typing_extensions import override

from splatseg.core import FeatureMap, MaskSet, Rle
from splatseg.core.json_values import json_integer, json_number
from splatseg.errors import FileFormatError, InputError, quoted, reason
from splatseg.io.evidence._base import EvidenceKind, IdFreeEvidence, refuse
from splatseg.io.evidence._label_files import read_id_map
from splatseg.io.json_files import read_json_value
from splatseg.io.limits import check_unpacked
from splatseg.io.npy import read_npy
from splatseg.io.npz import npz_names, read_npz

MASK_TABLE = "metadata.csv"
"""What SAM's tool writes beside the pictures of masks of one photograph."""

_STACKS = ("masks", "segmentation", "segmentations")
"""Arrays of an npz that are stacks of masks."""

_SCORES = ("score", "predicted_iou")
_INT32 = np.iinfo(np.int32)
_MAX_SIDE = 1 << 24
_MAX_RUN = int(np.iinfo(np.uint32).max)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MaskEvidence(IdFreeEvidence):
    """Overlapping masks without classes."""

    @property
    @override
    def kind(self) -> EvidenceKind:
        return "masks"

    @override
    def masks(self, name: str) -> MaskSet:
        return read_any_masks(self.file_of(name))

    @override
    def features(self, name: str) -> FeatureMap:
        refuse(self, "features")


def read_any_masks(path: Path) -> MaskSet:
    """The masks of one view: a JSON, an npz or a folder of pictures."""
    if path.is_dir():
        return read_mask_images(path)
    return read_mask_arrays(path) if path.suffix in (".npz", ".npy") else read_masks(path)


def holds_masks(path: Path) -> bool:
    """Whether an npz, or an ``.npy`` of booleans, is a stack of masks."""
    if path.suffix == ".npy":
        array = read_npy(path, mapped=True)
        return array.ndim == 3 and array.dtype.kind == "b"
    return path.suffix == ".npz" and _stack_name(path) is not None


def read_mask_arrays(path: Path) -> MaskSet:
    """The masks (m, height, width) of an ``.npy``, or of an npz: ``masks`` or another usual name.

    Of an npz ``scores``, or SAM's ``predicted_iou``, and ``levels`` may lack.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it holds anything else.
    """
    if path.suffix == ".npy":
        arrays = {"masks": read_npy(path)}
    else:
        name = _stack_name(path) or "masks"
        arrays = read_npz(path, [name], optional=["scores", "predicted_iou", "levels"])
        arrays["masks"] = arrays[name]
        if "predicted_iou" in arrays:
            arrays.setdefault("scores", arrays["predicted_iou"])
    masks = arrays["masks"]
    if (
        masks.ndim != 3
        or 0 in masks.shape[1:]
        or masks.dtype.kind not in "bui"
        or (masks.size and masks.min() < 0)
    ):
        raise FileFormatError(
            f"{path}: expected masks of shape (masks, height, width) in booleans or 0 and 1, "
            f"got {masks.dtype} of {masks.shape}."
        )
    count = len(masks)
    scores, levels = arrays.get("scores", np.ones(count)), arrays.get("levels", np.zeros(count))
    if scores.shape != (count,) or scores.dtype.kind not in "biuf" or not _is_finite(scores):
        raise FileFormatError(
            f"{path}: expected a finite score for each of {count} masks, "
            f"got {scores.dtype} of {scores.shape}."
        )
    if levels.shape != (count,) or not _are_levels(levels):
        raise FileFormatError(
            f"{path}: expected a whole number as level for each of {count} masks, from "
            f"{_INT32.min} to {_INT32.max}, got {levels.dtype} of {levels.shape}."
        )
    return MaskSet(
        height=int(masks.shape[1]),
        width=int(masks.shape[2]),
        masks=tuple(Rle.encode(torch.from_numpy(mask != 0)) for mask in masks),
        scores=torch.from_numpy(scores.astype(np.float32)).clamp(0, 1),
        levels=torch.from_numpy(levels.astype(np.int32)),
    )


def _stack_name(path: Path) -> str | None:
    """The array of an npz that is a stack of masks; one without a name is where it is alone."""
    names = npz_names(path)
    if tuple(names) == ("arr_0",):
        return "arr_0"
    return next((name for name in _STACKS if name in names), None)


def _is_finite(values: NDArray[Any]) -> bool:
    return bool(np.isfinite(values).all())


def _are_levels(levels: NDArray[Any]) -> bool:
    """Whether values are whole numbers that int32 holds, in whatever type they came."""
    if levels.dtype.kind not in "biuf" or not _is_finite(levels):
        return False
    within = (levels >= _INT32.min) & (levels <= _INT32.max)
    return bool(within.all() and (levels == np.trunc(levels)).all())


def read_mask_images(folder: Path) -> MaskSet:
    """The masks of a folder of pictures, zero outside a mask, in the order of their numbers.

    Scores are ``predicted_iou`` of the metadata.csv that SAM's tool writes beside them, else 1.

    Raises:
        FileFormatError: If they differ in size, have colours, or metadata.csv does not fit.
    """
    files = sorted(folder.glob("*.png"), key=lambda p: (len(p.stem), p.stem))
    if not files:
        raise FileFormatError(f"{folder}: expected PNG pictures of masks, got none.")
    scores = _image_scores(folder / MASK_TABLE)
    masks: list[Rle] = []
    for path in files:  # one at a time: all together may take far more than their files
        array = read_id_map(path)
        first = masks[0] if masks else None
        if first is not None and array.shape != (first.height, first.width):
            raise FileFormatError(
                f"{path}: expected {first.width}x{first.height} pixels as "
                f"{files[0].name} has, got {array.shape[1]}x{array.shape[0]}."
            )
        masks.append(Rle.encode(torch.from_numpy(array != 0)))
    return MaskSet(
        height=masks[0].height,
        width=masks[0].width,
        masks=tuple(masks),
        scores=torch.tensor([scores.get(path.stem, 1.0) for path in files]).clamp(0, 1),
        levels=torch.zeros(len(files), dtype=torch.int32),
    )


def mask_folders(folder: Path, *, marked_by: Literal["metadata.csv", "*.png"]) -> dict[str, Path]:
    """Folders of mask pictures by view name: those with SAM's metadata.csv, or any with PNGs."""
    named = {path.parent for path in folder.rglob(marked_by)}
    return {
        path.relative_to(folder).as_posix(): path
        for path in sorted(named - {folder})
        if not any(part.startswith((".", "_")) for part in path.relative_to(folder).parts)
    }


def _image_scores(path: Path) -> dict[str, float]:
    if not path.is_file():
        return {}
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        scores = {row["id"]: float(row["predicted_iou"]) for row in rows}
    except (KeyError, TypeError, ValueError, csv.Error, OSError) as error:
        raise FileFormatError(
            f"{path}: expected the columns id and predicted_iou, as SAM's tool writes "
            f"({reason(error)})."
        ) from error
    if not all(math.isfinite(score) for score in scores.values()):
        raise FileFormatError(f"{path}: expected finite scores, got others.")
    return scores


def read_masks(path: Path) -> MaskSet:
    """The masks of one file.

    Scores are ``score``, else ``predicted_iou``, else 1, clamped to [0, 1]; levels are
    ``level``, else 0. Run lengths may be compressed text or a list of numbers.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it holds anything else.
    """
    rows, height, width = _mask_rows(read_json_value(path))
    if not isinstance(rows, list) or not _is_side(height) or not _is_side(width):
        raise FileFormatError(
            f"{path}: expected masks with their height and width, in run lengths as SAM's "
            f"generator gives them with output_mode='coco_rle', got {quoted(height)} and "
            f"{quoted(width)}."
        )
    check_unpacked(
        path,
        height * width,
        packed=path.stat().st_size,
        what=f"masks of {width}x{height} pixels",
    )
    masks: list[Rle] = []
    scores: list[float] = []
    levels: list[int] = []
    for i, row in enumerate(cast(list[object], rows)):
        where = f"{path}: masks[{i}]"
        fields = cast(dict[str, Any], row) if isinstance(row, dict) else {}
        masks.append(_rle(fields.get("segmentation"), height, width, where=where))
        score = next((fields[key] for key in _SCORES if key in fields), 1.0)
        level = fields.get("level", 0)
        number = json_number(score, where=f"{where}: score")
        scores.append(min(1.0, max(0.0, number)))
        levels.append(
            json_integer(level, where=f"{where}: level", low=int(_INT32.min), high=int(_INT32.max))
        )
    return MaskSet(
        height=height,
        width=width,
        masks=tuple(masks),
        scores=torch.tensor(scores, dtype=torch.float32),
        levels=torch.tensor(levels, dtype=torch.int32),
    )


def holds_mask_rows(content: object) -> bool:
    """Whether a JSON value is the masks of one picture."""
    return isinstance(_mask_rows(content)[0], list)


def _mask_rows(content: object) -> tuple[object, object, object]:
    """The rows of masks, and the height and width of their picture, None where it has none.

    Ours are an object with ``masks``, ``height`` and ``width``; a file of SA-1B has ``annotations``
    and ``image``; what SAM's generator gives is a list of rows, and their first tells the size.
    """
    if isinstance(content, list):
        rows = cast(list[object], content)
        first = cast(dict[str, Any], rows[0]) if rows and isinstance(rows[0], dict) else {}
        segmentation = first.get("segmentation")
        size = cast(dict[str, Any], segmentation if isinstance(segmentation, dict) else {}).get(
            "size"
        )
        sides = cast(list[object], size) if isinstance(size, list) else []
        height, width = sides if len(sides) == 2 else (None, None)
        return (rows if "segmentation" in first else None), height, width
    fields = cast(dict[str, Any], content) if isinstance(content, dict) else {}
    if "masks" not in fields and isinstance(fields.get("image"), dict):
        image = cast(dict[str, Any], fields["image"])
        return fields.get("annotations"), image.get("height"), image.get("width")
    return fields.get("masks"), fields.get("height"), fields.get("width")


def masks_content(masks: MaskSet) -> dict[str, Any]:
    """The JSON object of a set of masks. Inverse of `read_masks`."""
    rows = [
        {
            "segmentation": {
                "size": [masks.height, masks.width],
                "counts": mask.to_coco(),
            },
            "area": mask.area,
            "bbox": list(mask.bbox),
            "score": score,
            "level": level,
        }
        for mask, score, level in zip(
            masks.masks, masks.scores.tolist(), masks.levels.tolist(), strict=True
        )
    ]
    return {"height": masks.height, "width": masks.width, "masks": rows}


def _rle(segmentation: object, height: int, width: int, *, where: str) -> Rle:
    fields = cast(dict[str, Any], segmentation) if isinstance(segmentation, dict) else {}
    counts = fields.get("counts")
    if fields.get("size") != [height, width] or not isinstance(counts, (str, list)):
        raise FileFormatError(
            f"{where}: expected a run-length mask of {height} x {width}, "
            f"got size {quoted(fields.get('size'))}."
        )
    try:
        if isinstance(counts, str):
            return Rle.from_coco(counts, height=height, width=width)
        runs = cast(list[object], counts)
        wrong = [run for run in runs if type(run) is not int or not 0 <= run <= _MAX_RUN]
        if wrong:
            raise InputError(
                f"counts: expected whole numbers from 0 to {_MAX_RUN}, got {quoted(wrong[0])}."
            )
        return Rle(height=height, width=width, counts=np.array(runs, np.uint32))
    except (InputError, OverflowError) as error:
        raise FileFormatError(f"{where}: {error}") from error


def _is_side(value: object) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool) and 0 < value <= _MAX_SIDE
