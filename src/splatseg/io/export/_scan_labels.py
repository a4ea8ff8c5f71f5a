"""Labels of laser scans in files, in the order in which the scans' files have their points."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_choice, check_shape
from splatseg.core import UNLABELLED, PointLabels, Scan
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.io.atomic import atomic_folder
from splatseg.io.export._folders import check_replaceable
from splatseg.io.export._points import write_scan_points
from splatseg.io.export._tables import MADE_BY
from splatseg.io.json_files import write_json
from splatseg.io.paths import path_inside

ScanLabelForm = Literal["npz", "label", "ply", "las"]
"""npz: arrays ``semantic`` (int32, 0 none) and ``confidence`` (float32), a value for every value of
the scan's file. label: SemanticKITTI's, a uint32 a point. ply, las: points of the world with
columns ``class_id`` and ``confidence``."""

FORMS = get_args(ScanLabelForm)

RECORD = "labels.json"
_VOID = 0
_ARRAY = "labels.npz"
_MAX_LABEL = (1 << 16) - 1
"""The upper half of a number in a ``.label`` file is the instance."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanLabelCounts:
    """How many points have which label."""

    scans: int

    points: int

    unlabelled: int
    """Points about which nothing was said."""

    ids: Mapping[int, int]
    """How many points have each id, by id."""


@boundary
def write_scan_labels(
    found: Iterable[tuple[Scan, PointLabels]],
    folder: Path,
    *,
    form: ScanLabelForm = "npz",
    array_shape: tuple[int, ...] | None = None,
    about: Mapping[str, Any] | None = None,
) -> ScanLabelCounts:
    """Write a folder of labels, one file a scan; it appears whole or not at all.

    ``FOLDER/NAME.npz`` (``.label``, ``.ply``, ``.las``) is of the scan NAME, and
    ``FOLDER/labels.json`` says what the ids mean and how many points have each. Scans of one
    array become one file, ``labels.npz``, with arrays of its shape. A folder of an earlier export
    is replaced as a whole.

    Args:
        found: Scans with labels of their points, taken one at a time.
        folder: What to write.
        form: Of the files.
        array_shape: With npz: shape of the array that holds all scans, one after the other.
        about: Further members of labels.json.

    Returns:
        How many points have which label.

    Raises:
        InputError: If the folder holds something other than an earlier export, or an id has no
            place in a ``.label`` file.
        ShapeError: If there is not one label a point, or not the array's number of values.
        MissingPackageError: If laspy is not installed and LAS is asked for.
    """
    check_choice("form", form, FORMS)
    check_replaceable(folder, RECORD)
    counts: Counter[int] = Counter()
    scans = 0
    classified: dict[str, int] = {}
    whole: list[tuple[Tensor, Tensor]] = []
    with atomic_folder(folder) as temporary:
        for scan, labels in found:
            check_shape("labels", labels.ids, (len(scan),))
            ids, each = torch.unique(labels.ids, return_counts=True)
            counts.update(dict(zip(ids.tolist(), each.tolist(), strict=True)))
            scans += 1
            if form in ("ply", "las"):
                path = path_inside(temporary, f"{scan.name}.{form}")
                known = write_scan_points(scan.points, path, columns=_columns(labels))
                classified |= {str(id): value for id, value in known.items()}
                continue
            semantic = _in_file(scan.recorded_labels(labels.ids))
            if form == "label":
                _write_label(path_inside(temporary, f"{scan.name}.label"), semantic)
                continue
            confidence = _recorded(scan, labels.confidence)
            if array_shape is not None:
                whole.append((semantic, confidence))
                continue
            _write_arrays(path_inside(temporary, f"{scan.name}.npz"), semantic, confidence)
        if array_shape is not None and form == "npz":
            _write_whole(temporary / _ARRAY, whole, array_shape)
        total = ScanLabelCounts(
            scans=scans,
            points=counts.total(),
            unlabelled=counts.pop(UNLABELLED, 0),
            ids=dict(sorted(counts.items())),
        )
        content: dict[str, Any] = {
            "made_by": MADE_BY,
            "form": form,
            "scans": total.scans,
            "points": total.points,
            "unlabelled": total.unlabelled,
            "points_by_id": {str(id): count for id, count in total.ids.items()},
        }
        if classified:
            content["las_classification"] = classified
        write_json(content | dict(about or {}), temporary / RECORD)
    return total


def _columns(labels: PointLabels) -> dict[str, Tensor]:
    return {"class_id": _in_file(labels.ids), "confidence": labels.confidence.float()}


def _in_file(ids: Tensor) -> Tensor:
    return torch.where(ids == UNLABELLED, _VOID, ids).int()


def _recorded(scan: Scan, values: Tensor) -> Tensor:
    """Values in the order of the file, 0 where it has no point."""
    if scan.rows is None:
        return values.float()
    out = torch.zeros(len(scan.recorded_labels(torch.zeros(len(scan), dtype=torch.int32))))
    out[scan.rows] = values.float()
    return out


def _write_label(path: Path, semantic: Tensor) -> None:
    if len(semantic) and int(semantic.max()) > _MAX_LABEL:
        raise InputError(
            f"form: expected ids up to {_MAX_LABEL} for .label files, got {int(semantic.max())}."
        )
    path.write_bytes(semantic.numpy().astype("<u4").tobytes())


def _write_arrays(path: Path, semantic: Tensor, confidence: Tensor) -> None:
    arrays: dict[str, NDArray[Any]] = {
        "semantic": semantic.numpy().astype(np.int32),
        "confidence": confidence.numpy().astype(np.float32),
    }
    np.savez(path, **cast(dict[str, Any], arrays))


def _write_whole(
    path: Path, parts: list[tuple[Tensor, Tensor]], array_shape: tuple[int, ...]
) -> None:
    semantic = torch.cat([ids for ids, _ in parts] or [torch.zeros(0, dtype=torch.int32)])
    confidence = torch.cat([shares for _, shares in parts] or [torch.zeros(0)])
    check_shape("array_shape", semantic, (int(np.prod(array_shape)),))
    _write_arrays(path, semantic.reshape(array_shape), confidence.reshape(array_shape))
