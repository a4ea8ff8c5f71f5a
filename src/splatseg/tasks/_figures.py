"""What ``splatseg evaluate`` says, by the names that scorers use, and the small files it reads."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatseg.core.json_values import id_of_key, json_number
from splatseg.errors import FileFormatError, quoted
from splatseg.evaluate import (
    BinaryReport,
    Confusion,
    InstanceReport,
    PanopticReport,
    PointReport,
    SemanticReport,
    SemanticScore,
)
from splatseg.evaluate.overlaps import InstanceScore
from splatseg.io.json_files import read_json
from splatseg.io.npz import read_npz


def semantic_figures(report: SemanticReport, name_of: Callable[[int], str]) -> dict[str, Any]:
    """Classes, pooled over views unless they say otherwise; `name_of` names an id."""
    figures = _views(report) | _classes(report.score)
    per_class = figures.pop("per_class")
    return figures | {
        "mIoU_per_image": report.per_image_miou,
        "boundary_mIoU": report.boundary.mean,
        "classes": len(per_class),
        "per_class": per_class,
        "names_per_class": {id: name_of(int(id)) for id in per_class},
        "pixels_per_class": {
            id: int(report.confusion.counts[int(id) + 1].sum()) for id in per_class
        },
        "confusion": _confusion(report.confusion, name_of),
    }


def _confusion(confusion: Confusion, name_of: Callable[[int], str]) -> dict[str, Any]:
    """Pixels by true class (rows) and class of the layer (columns, -1 where it has none)."""
    counts = confusion.counts
    true = [int(i) for i in torch.nonzero(counts.sum(dim=1)).flatten().tolist()]
    predicted = [int(i) for i in torch.nonzero(counts.sum(dim=0)).flatten().tolist()]
    ids = sorted({*true, *predicted})
    return {
        "true": [i - 1 for i in true],
        "predicted": [i - 1 for i in predicted],
        "counts": counts[true][:, predicted].tolist(),
        "names": {str(i - 1): "unlabelled" if i == 0 else name_of(i - 1) for i in ids},
    }


def binary_figures(report: BinaryReport) -> dict[str, Any]:
    """One object as a mask."""
    return _views(report) | {
        "IoU_mean_over_views": report.score.iou_mean,
        "IoU_pooled": report.score.iou_pooled,
        "accuracy": report.score.accuracy,
        "boundary_IoU_mean_over_views": report.boundary_mean,
        "boundary_IoU_pooled": report.boundary_pooled,
    }


def instance_figures(report: InstanceReport) -> dict[str, Any]:
    """Instances matched over the scene; mIoU is the mean over the true ones."""
    return _views(report) | _instances(report.score)


def panoptic_figures(report: PanopticReport) -> dict[str, Any]:
    """Panoptic quality over the scene and of images, AP50 in views, and the classes alone."""
    score = report.score
    return _views(report) | {
        "PQ_scene": score.pq,
        "PQ_things": score.pq_things,
        "PQ_stuff": score.pq_stuff,
        "PQ_images": report.image_score.pq,
        "mAP50": report.precision.mean,
        "mIoU": report.semantic.miou,
        "tp": score.tp,
        "fp": score.fp,
        "fn": score.fn,
        "PQ_per_class": {
            str(id): {
                "PQ": one.pq,
                "SQ": one.sq,
                "RQ": one.rq,
                "tp": one.tp,
                "fp": one.fp,
                "fn": one.fn,
            }
            for id, one in score.per_class.items()
        },
        "AP50_per_class": {str(id): value for id, value in report.precision.per_class.items()},
    }


def point_figures(report: PointReport, *, rule: str | None) -> dict[str, Any]:
    """Labels of points, under names that begin with points_; `rule` is that of Gaussians."""
    scores: dict[str, Any] = {}
    if report.semantic is not None:
        scores |= _classes(report.semantic)
    if report.instances is not None:
        scores |= _instances(report.instances)
    scores["unlabelled"] = report.unlabelled
    if rule is not None:
        scores["rule"] = rule
    return {"points": report.points} | {f"points_{key}": value for key, value in scores.items()}


def read_points(path: Path, name: str) -> tuple[Tensor, Tensor]:
    """Places and true ids (-1 void) from an npz with xyz and an array `name` of ids.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it lacks one of them, or they do not fit together.
    """
    arrays = read_npz(path, ["xyz", name])
    xyz, ids = arrays["xyz"], arrays[name]
    if xyz.ndim != 2 or xyz.shape[1] != 3 or ids.shape != xyz.shape[:1]:
        raise FileFormatError(
            f"{path}: expected xyz of n x 3 and {name} of n, got {xyz.shape} and {ids.shape}."
        )
    if ids.dtype.kind not in "iu" or xyz.dtype.kind != "f" or not np.isfinite(xyz).all():
        raise FileFormatError(
            f"{path}: expected finite places and whole ids, got {xyz.dtype} and {ids.dtype}."
        )
    whole = torch.from_numpy(ids.astype(np.int64))
    return torch.from_numpy(xyz), torch.where(whole <= 0, -1, whole)


def read_scores(path: Path) -> dict[int, float]:
    """Score by instance id from a JSON object.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If a key is no id or a value no number.
    """
    scores: dict[int, float] = {}
    for key, value in read_json(path).items():
        id = id_of_key(key)
        if id is None:
            raise FileFormatError(f"{path}: expected scores by instance id, got {quoted(key)}.")
        scores[id or -1] = json_number(value, where=f"{path}: score of instance {id}")
    return scores


def _views(
    report: SemanticReport | BinaryReport | InstanceReport | PanopticReport,
) -> dict[str, Any]:
    return {"views": len(report.views), "learned_from": len(report.learned_from)}


def _classes(score: SemanticScore) -> dict[str, Any]:
    return {
        "mIoU": score.miou,
        "fwIoU": score.fwiou,
        "accuracy": score.accuracy,
        "mAcc": score.mean_accuracy,
        "per_class": {str(id): value for id, value in score.per_class.items()},
    }


def _instances(score: InstanceScore) -> dict[str, Any]:
    return {
        "mIoU": score.miou,
        "recall50": score.recall50,
        "precision50": score.precision50,
        "truth_instances": score.truth_instances,
        "predicted_instances": score.predicted_instances,
    }
