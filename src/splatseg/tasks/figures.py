"""What ``splatseg evaluate`` says, by the names that scorers use, and the small files it reads."""

import html
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatseg.errors import FileFormatError, InputError
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
from splatseg.io.arrays import read_npz
from splatseg.io.atomic import atomic_file
from splatseg.io.tables import csv_text


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


def point_figures(report: PointReport) -> dict[str, Any]:
    """Labels of points, under names that begin with points_."""
    scores: dict[str, Any] = {}
    if report.semantic is not None:
        scores |= _classes(report.semantic)
    if report.instances is not None:
        scores |= _instances(report.instances)
    scores["unlabelled"] = report.unlabelled
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


Cell = str | int | float

_LATEX = str.maketrans(
    {c: f"\\{c}" for c in "&%$#_{}"}
    | {"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}"}
    | {"~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\\": r"\textbackslash{}"}
)
_MARKUP = re.compile(r"[\\`|\[\]]")
"""What Markdown makes code, cells, links and pictures of."""

_ENDINGS = (".csv", ".md", ".tex")


def check_table_file(name: str, path: Path | None) -> None:
    """Refuse a file that no table can be written to, before anything is scored.

    Raises:
        InputError: If its ending is none of a table's, or its folder is not there.
    """
    if path is None:
        return
    if path.suffix.lower() not in _ENDINGS:
        raise InputError(f"{name}: expected a file that ends in .csv, .md or .tex, got {path}.")
    if not path.absolute().parent.is_dir():
        raise InputError(f"{name}: expected an existing folder to write {path} in.")


def write_class_table(figures: Mapping[str, Any], path: Path) -> None:
    """Write one row a class (id, name, pixels of the truth, IoU), and the mean.

    Args:
        path: The file; its ending says the format.
        figures: What `evaluate` gave for the metric semantic.

    Raises:
        InputError: If the figures are of another metric, or the ending is none of a table's.
    """
    names, pixels = figures.get("names_per_class"), figures.get("pixels_per_class")
    if names is None or pixels is None:
        raise InputError("table: expected scores of classes (metric semantic), got others.")
    rows: list[list[Cell]] = [
        [int(id), names[id], pixels[id], float(iou)] for id, iou in figures["per_class"].items()
    ]
    rows.append(["", "mean", sum(pixels.values()), float(figures["mIoU"])])
    write_table(rows, path, columns=["id", "class", "pixels", "IoU"])


def write_confusion(figures: Mapping[str, Any], path: Path) -> None:
    """Write the confusion matrix: pixels, one row a true class, one column a class of the layer.

    Raises:
        InputError: If the figures are of another metric, or the ending is none of a table's.
    """
    matrix = figures.get("confusion")
    if matrix is None:
        raise InputError("confusion: expected scores of classes (metric semantic), got others.")
    names = [matrix["names"][str(id)] for id in matrix["predicted"]]
    rows: list[list[Cell]] = [
        [matrix["names"][str(id)], *counts]
        for id, counts in zip(matrix["true"], matrix["counts"], strict=True)
    ]
    write_table(rows, path, columns=["true class", *names])


def write_table(rows: Sequence[Sequence[Cell]], path: Path, *, columns: Sequence[str]) -> None:
    """Write rows under the names of columns; numbers stand right.

    Raises:
        InputError: If the ending is none of a table's, or the folder is not there.
    """
    check_table_file("table", path)
    made = {".csv": csv_text, ".md": _markdown, ".tex": _latex}[path.suffix.lower()]
    with atomic_file(path) as temporary:
        temporary.write_text(made(columns, rows), encoding="utf-8", newline="\n")


def _shown(cell: Cell) -> str:
    return f"{cell:.4f}" if isinstance(cell, float) else str(cell)


def _markdown(columns: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    def line(cells: Sequence[Cell]) -> str:
        shown = (
            _MARKUP.sub(r"\\\g<0>", html.escape(" ".join(_shown(cell).split()), quote=False))
            for cell in cells
        )
        return "| " + " | ".join(shown) + " |"

    rule = "| " + " | ".join(_rules(columns, rows, "---", "---:")) + " |"
    return "\n".join([line(columns), rule, *map(line, rows)]) + "\n"


def _latex(columns: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    def line(cells: Sequence[Cell]) -> str:
        shown = (" ".join(_shown(cell).split()).translate(_LATEX) for cell in cells)
        return " & ".join(shown) + r" \\"

    sides = "".join(_rules(columns, rows, "l", "r"))
    head = [rf"\begin{{tabular}}{{{sides}}}", r"\hline", line(columns), r"\hline"]
    return "\n".join([*head, *map(line, rows), r"\hline", r"\end{tabular}"]) + "\n"


def _rules(
    columns: Sequence[str], rows: Sequence[Sequence[Cell]], words: str, numbers: str
) -> list[str]:
    """How each column stands: words left, numbers right."""
    return [
        numbers if any(isinstance(row[i], int | float) for row in rows) else words
        for i in range(len(columns))
    ]
