"""Masks: a JSON a view with COCO run lengths, as SAM's automatic mask generator writes them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from typing_extensions import override

from splatseg.core import ClassTable, FeatureMap, LabelMap, MaskSet, Rle
from splatseg.errors import FileFormatError, InputError
from splatseg.io._json import read_json
from splatseg.io.evidence._base import Evidence, EvidenceKind, file_of, refuse

_SCORES = ("score", "predicted_iou")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MaskEvidence(Evidence):
    """Overlapping masks without classes."""

    root: Path
    files: Mapping[str, Path]

    @property
    @override
    def folder(self) -> Path:
        return self.root

    @property
    @override
    def kind(self) -> EvidenceKind:
        return "masks"

    @property
    @override
    def view_names(self) -> tuple[str, ...]:
        return tuple(self.files)

    @property
    @override
    def classes(self) -> ClassTable | None:
        return None

    @property
    @override
    def source_ids(self) -> Mapping[int, int] | None:
        return None

    @override
    def label_map(self, name: str) -> LabelMap:
        refuse(self, "label maps")

    @override
    def masks(self, name: str) -> MaskSet:
        return read_masks(file_of(self.files, name, self.root))

    @override
    def features(self, name: str) -> FeatureMap:
        refuse(self, "features")


def read_masks(path: Path) -> MaskSet:
    """The masks of one file.

    Scores are ``score``, else ``predicted_iou``, else 1, clamped to [0, 1]; levels are
    ``level``, else 0. Run lengths may be compressed text or a list of numbers.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it holds anything else.
    """
    content = read_json(path)
    rows = content.get("masks")
    height, width = content.get("height"), content.get("width")
    if not isinstance(rows, list) or not isinstance(height, int) or not isinstance(width, int):
        raise FileFormatError(f"{path}: expected masks with their height and width.")
    masks: list[Rle] = []
    scores: list[float] = []
    levels: list[int] = []
    for i, row in enumerate(cast(list[object], rows)):
        where = f"{path}: masks[{i}]"
        fields = cast(dict[str, Any], row) if isinstance(row, dict) else {}
        masks.append(_rle(fields.get("segmentation"), height, width, where=where))
        score = next((fields[key] for key in _SCORES if key in fields), 1.0)
        level = fields.get("level", 0)
        if (
            not isinstance(score, (int, float))
            or not math.isfinite(score)
            or not isinstance(level, int)
        ):
            raise FileFormatError(f"{where}: expected a score and a level, got {score}, {level}.")
        scores.append(min(1.0, max(0.0, float(score))))
        levels.append(level)
    return MaskSet(
        height=height,
        width=width,
        masks=tuple(masks),
        scores=torch.tensor(scores, dtype=torch.float32),
        levels=torch.tensor(levels, dtype=torch.int32),
    )


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
            f"got size {fields.get('size')}."
        )
    try:
        if isinstance(counts, str):
            return Rle.from_coco(counts, height=height, width=width)
        runs = np.array(cast(list[int], counts), np.uint32)
        return Rle(height=height, width=width, counts=runs)
    except (InputError, ValueError, OverflowError, TypeError) as error:
        raise FileFormatError(f"{where}: {error}") from error
