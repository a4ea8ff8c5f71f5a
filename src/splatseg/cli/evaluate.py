"""``splatseg evaluate``: a layer against truth, and renders against photographs."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console
from rich.table import Table

from splatseg.cli._shared import Field, OnScene, plain, print_result
from splatseg.core import Scene
from splatseg.io.json_files import write_json
from splatseg.tasks import EvaluationOptions, evaluate_scene
from splatseg.tasks.figures import check_table_file, write_class_table, write_confusion
from splatseg.tasks.work import check_parent, scene_field

_PER_CLASS = {
    "per_class": ("classes", "IoU"),
    "PQ_per_class": ("panoptic quality of each class", "PQ"),
    "AP50_per_class": ("average precision of each class of things", "AP50"),
    "points_per_class": ("classes of points", "IoU"),
}
"""Title of each table, and what its one column of figures is."""


@dataclass(frozen=True, kw_only=True)
class Command(OnScene):
    """Score a layer against the truth, and renders against the photographs.

    mIoU, fwIoU and accuracy are pooled over all views and equal those of the common scorers; the
    per-image mIoU is the mean over views. Predictions are drawn in the truth's pixels. Instances
    are matched one to one over the whole scene; for panoptic quality a segment is all its pixels
    in all views. Renders are scored where all photographs are at hand.

    For example:

    splatseg evaluate room --layer semantic --truth capture/semantic

    splatseg evaluate room --layer objects --truth capture/instance --metric instances --json

    splatseg evaluate room --layer semantic --truth gt --table classes.tex --confusion pixels.csv

    splatseg evaluate room --split train
    """

    scoring: tyro.conf.OmitArgPrefixes[EvaluationOptions] = field(default_factory=EvaluationOptions)
    """What is scored, and the truth."""

    field: Field = None

    table: Path | None = None
    """Also write the scores of classes (id, name, pixels, IoU) to this .csv, .md or .tex file."""

    confusion: Path | None = None
    """Also write the confusion matrix, pixels by true class (rows) and class of the layer
    (columns), to this .csv, .md or .tex file."""

    json_file: Path | None = None
    """Also write what --json prints to this file."""


def run(command: Command) -> None:
    """Evaluate a scene."""
    if command.json_file is not None:
        check_parent(command.json_file)
    check_table_file("table", command.table)
    check_table_file("confusion", command.confusion)
    scene = command.open()
    figures = evaluate_scene(
        scene,
        options=command.scoring,
        field=None if command.field is None else scene_field(scene, command.field),
        backend=command.backend,
        observer=command.observer,
    )
    figures["scene"] = str(command.scene)
    if command.field is not None:
        figures["field"] = command.field
    if command.table is not None:
        write_class_table(figures, command.table)
    if command.confusion is not None:
        write_confusion(figures, command.confusion)
    if command.json_file is not None:
        write_json(figures, command.json_file)
    if command.json:
        print_result(figures, [], json=True)
    else:
        _print_tables(figures, scene)


def _print_tables(figures: Mapping[str, Any], scene: Scene) -> None:
    console = Console(highlight=False)
    table = Table("measure", "value", title=plain(f"{figures['scene']}, {figures['split']} views"))
    table.columns[1].justify = "right"
    for key, value in figures.items():
        if key not in ("scene", "split", "learned_from") and not isinstance(value, dict):
            table.add_row(key, plain(f"{value:.4f}" if isinstance(value, float) else value))
    console.print(table)
    for key, (title, measure) in _PER_CLASS.items():
        if key in figures:
            rows = figures[key]
            if key == "per_class" and "pixels_per_class" in figures:
                pixels = figures["pixels_per_class"]
                rows = {id: {"pixels": pixels[id], "IoU": iou} for id, iou in rows.items()}
            names = figures.get("names_per_class", {})
            console.print(_class_table(rows, names, scene, title=title, measure=measure))
    if figures.get("learned_from"):
        console.print(
            f"The layer was made from {figures['learned_from']} of these views: "
            "this is no held-out score."
        )


def _class_table(
    rows: Mapping[str, Any], known: Mapping[str, str], scene: Scene, *, title: str, measure: str
) -> Table:
    """One row a class; its figures are one value, or several by name."""
    first = next(iter(rows.values()), 0.0)
    measures = tuple(first) if isinstance(first, dict) else (measure,)
    table = Table("id", "class", *measures, title=title)
    for column in table.columns[2:]:
        column.justify = "right"
    for key, value in rows.items():
        values = value.values() if isinstance(value, dict) else (value,)
        other = "" if scene.classes is None else scene.classes.name_of(int(key))
        name = known.get(key, other)
        shown = (f"{v:.4f}" if isinstance(v, float) else str(v) for v in values)
        table.add_row(key, plain(name), *shown)
    return table
