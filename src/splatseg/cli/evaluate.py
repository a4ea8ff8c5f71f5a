"""``splatseg evaluate``: a layer against truth, and renders against photographs."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from splatseg.cli._types import Backend, Data, Json, Quiet, SceneFolder, Split
from splatseg.cli._work import ConsoleObserver, open_scene, print_result
from splatseg.core import Scene
from splatseg.evaluate.solid import PointRule
from splatseg.io.json_files import write_json
from splatseg.tasks import EvaluationOptions, evaluate
from splatseg.tasks.evaluate import Metric

_PER_CLASS = {
    "per_class": "classes",
    "PQ_per_class": "panoptic quality of each class",
    "AP50_per_class": "average precision of each class of things",
    "points_per_class": "classes of points",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Score a layer against the truth, and renders against the photographs.

    mIoU, fwIoU and accuracy are pooled over all views and equal to those of the usual scorers;
    the per-image mIoU is the mean over views. Predictions are drawn in the truth's own pixels.
    Instances are matched one to one over the whole scene; panoptic quality takes a segment as
    all its pixels in all views.

    For example:

    splatseg evaluate room --layer semantic --truth capture/semantic

    splatseg evaluate room --layer objects --truth capture/instance --metric instances --json

    splatseg evaluate room --split train --photographs
    """

    scene: SceneFolder

    layer: str | None = None
    """Name of the layer to score. None scores renders only."""

    truth: Path | None = None
    """Folder of the true id maps, one PNG a view; 0 is void. Of classes, or of instances with
    --metric instances."""

    instances: str | None = None
    """With panoptic: name of the layer of instances; --layer is that of the classes. None takes
    --layer for both: its record must tell each instance's class, as that of associate does."""

    truth_instances: Path | None = None
    """With panoptic: folder of the true instance maps; --truth is that of the classes."""

    metadata: Path | None = None
    """With panoptic: JSON whose "classes" say which are things (id, name, isthing). None takes
    the metadata.json beside the truth, else the classes of the scene."""

    scores: Path | None = None
    """With panoptic: JSON object of a score by instance id, by which AP50 ranks. None ranks all
    alike."""

    points: Path | None = None
    """Also score labels of points: an .npz with xyz (n x 3, world) and, as the metric asks,
    semantic or instance (n, 0 is void)."""

    points_rule: PointRule = "weighted"
    """How a point takes its label: weighted, by the density there of the Gaussians around it;
    nearest, that of the nearest centre."""

    zero_is_class: bool = False
    """The id 0 of the truth's files is a class and not void: ids grow by 1."""

    void: int | None = None
    """A further id of the truth's files that means void, such as 255."""

    split: Split = "test"

    metric: Metric = "semantic"
    """What to score: semantic, classes; instances, objects whatever their ids; panoptic, both
    together; binary, one id or a selection as a mask."""

    id: int | None = None
    """With binary: the id to score. None takes every labelled pixel."""

    photographs: bool = False
    """Insist on scoring renders (PSNR, SSIM). Without it they are scored where the
    photographs are at hand."""

    lpips: tuple[Path, ...] = ()
    """Also score LPIPS with your weights: AlexNet's or VGG-16's, and the heads', as .safetensors
    or .npz with the names of torchvision and of the lpips package."""

    json_file: Path | None = None
    """Also write that object to this file."""

    backend: Backend = "auto"
    data: Data = None
    json: Json = False
    quiet: Quiet = False


def run(command: Command) -> None:
    """Evaluate a scene."""
    scene = open_scene(command.scene, command.data)
    asked = {field.name: getattr(command, field.name) for field in fields(EvaluationOptions)}
    figures = evaluate(
        scene,
        options=EvaluationOptions(**asked),
        backend=command.backend,
        observer=ConsoleObserver(quiet=command.quiet, json=command.json),
    )
    figures["scene"] = str(command.scene)
    if command.json_file is not None:
        write_json(command.json_file, figures)
    if command.json:
        print_result(figures, [], json=True)
    else:
        _print_tables(figures, scene)


def _print_tables(figures: Mapping[str, Any], scene: Scene) -> None:
    console = Console(highlight=False)
    table = Table("measure", "value", title=f"{figures['scene']}, {figures['split']} views")
    table.columns[1].justify = "right"
    for key, value in figures.items():
        if key not in ("scene", "split", "learned_from") and not isinstance(value, dict):
            table.add_row(key, f"{value:.4f}" if isinstance(value, float) else str(value))
    console.print(table)
    for key, title in _PER_CLASS.items():
        if key in figures:
            console.print(_class_table(figures[key], scene, title))
    if figures.get("learned_from"):
        console.print(
            f"The layer was made from {figures['learned_from']} of these views: "
            "this is no held-out score."
        )


def _class_table(rows: Mapping[str, Any], scene: Scene, title: str) -> Table:
    """One row a class; its figures are one value, or several by name."""
    first = next(iter(rows.values()), 0.0)
    names = tuple(first) if isinstance(first, dict) else ("IoU",)
    table = Table("id", "class", *names, title=title)
    for column in table.columns[2:]:
        column.justify = "right"
    for key, value in rows.items():
        values = value.values() if isinstance(value, dict) else (value,)
        name = "" if scene.classes is None else scene.classes.name_of(int(key))
        shown = (f"{v:.4f}" if isinstance(v, float) else str(v) for v in values)
        table.add_row(key, name, *shown)
    return table
