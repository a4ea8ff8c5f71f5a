"""``splatseg evaluate``: a layer against truth, and pictures against photographs."""

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.table import Table

from splatseg.cli._figures import (
    binary_figures,
    instance_figures,
    panoptic_figures,
    point_figures,
    read_points,
    read_scores,
    semantic_figures,
)
from splatseg.cli._work import layer_of, mask_use, open_scene, progress, views_of_split
from splatseg.core import ClassTable, Features, Labels, Layer, Scene, View
from splatseg.errors import InputError
from splatseg.evaluate import (
    SemanticReport,
    evaluate_binary,
    evaluate_instances,
    evaluate_panoptic,
    evaluate_photographs,
    evaluate_points,
    evaluate_semantic,
)
from splatseg.evaluate.lpips import Lpips, load_lpips
from splatseg.evaluate.solid import PointRule
from splatseg.io.class_tables import class_table
from splatseg.io.evidence import Evidence, open_evidence
from splatseg.io.json_files import read_json, write_json
from splatseg.render import BackendName

Metric = Literal["semantic", "instances", "panoptic", "binary"]

# The array of a file of points that holds the truth of each metric.
_POINT_TRUTH: Mapping[str, str] = {"semantic": "semantic", "instances": "instance"}

_PER_CLASS = {
    "per_class": "classes",
    "PQ_per_class": "panoptic quality of each class",
    "AP50_per_class": "average precision of each class of things",
    "points_per_class": "classes of points",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Score a layer against the truth, and the pictures against the photographs.

    mIoU, fwIoU and accuracy are pooled over all views and equal to those of the usual scorers;
    the per-image mIoU is the mean over views. Predictions are drawn in the truth's own pixels.
    Instances are matched one to one over the whole scene; panoptic quality takes a segment as
    all its pixels in all views.
    """

    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """The scene folder."""

    layer: str | None = None
    """Name of the layer to score. None scores the pictures only."""

    truth: Path | None = None
    """Folder of the true id maps, one PNG a view; 0 is void. Of classes, or of instances with
    --metric instances."""

    instances: str | None = None
    """With panoptic: name of the layer of instances; --layer is that of the classes. None takes
    --layer for both: its metadata must tell each instance's class, as that of associate does."""

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

    split: str = "test"
    """Which views: test, train, another split of the scene, or all."""

    metric: Metric = "semantic"
    """What to score: semantic, classes; instances, objects whatever their ids; panoptic, both
    together; binary, one id or a selection as a mask."""

    id: int | None = None
    """With binary: the id to score. None takes every labelled pixel."""

    photographs: bool = False
    """Insist on scoring the pictures (PSNR, SSIM). Without it they are scored where the
    photographs are at hand."""

    lpips: tuple[Path, ...] = ()
    """Also score LPIPS with your weights: AlexNet's or VGG-16's, and the heads', as .safetensors
    or .npz with the names of torchvision and of the lpips package."""

    json: bool = False
    """Print one JSON object instead of a table."""

    json_file: Path | None = None
    """Also write that object to this file."""

    backend: BackendName = "auto"
    """Who renders. auto: cuda for scenes on a GPU, cpu otherwise."""

    data: Path | None = None
    """Folder of the capture, where it was moved."""


def run(command: Command) -> None:
    """Evaluate a scene."""
    _check(command)
    network = load_lpips(command.lpips) if command.lpips else None
    scene = open_scene(command.scene, command.data)
    figures: dict[str, Any] = {"scene": str(command.scene), "split": command.split}
    if command.layer is not None:
        figures |= {"layer": command.layer, "metric": command.metric}
    if command.truth is not None or command.layer is None:
        views = views_of_split(scene, command.split)
        figures |= _in_views(command, scene, views, network)
    if command.points is not None:
        figures |= _point_figures(command, scene, command.points)
    if command.json_file is not None:
        write_json(command.json_file, figures)
    if command.json:
        sys.stdout.write(json.dumps(figures) + "\n")
    else:
        _print_tables(figures, scene)


def _check(command: Command) -> None:
    """Say which options belong together before anything is read."""
    if command.layer is None and (command.truth or command.points):
        raise InputError("--layer: expected the layer that --truth and --points are to score.")
    if command.layer is not None and not (command.truth or command.points):
        raise InputError("--truth: expected a folder of true id maps (or --points), got none.")
    panoptic = (
        command.instances,
        command.truth_instances,
        command.metadata,
        command.scores,
    )
    if command.metric == "panoptic" and command.truth_instances is None:
        raise InputError(
            "--truth-instances: expected the folder of true instance maps beside --truth, which "
            "is of classes, got none."
        )
    if command.metric != "panoptic" and any(panoptic):
        raise InputError(
            "--instances, --truth-instances, --metadata, --scores: expected --metric panoptic "
            f"with them, got {command.metric}."
        )
    if command.points is not None and command.metric not in _POINT_TRUTH:
        raise InputError(
            f"--points: expected --metric semantic or instances, got {command.metric}."
        )


def _in_views(
    command: Command, scene: Scene, views: tuple[View, ...], network: Lpips | None
) -> dict[str, Any]:
    """Scores of the layer, and of the pictures where there are photographs or they are asked."""
    figures: dict[str, Any] = {}
    if command.layer is not None and command.truth is not None:
        truth = open_evidence(command.truth, zero_is_class=command.zero_is_class, void=command.void)
        layer = layer_of(scene, command.layer)
        figures |= _layer_figures(command, scene, views, layer, truth)
    if network is not None or _wants_photographs(command, views):
        figures |= _photograph_figures(command, scene, views, network)
    elif command.layer is None:
        raise InputError(
            f"{command.scene}: expected a layer with a truth, or photographs to score against, "
            "got neither."
        )
    return figures


def _layer_figures(
    command: Command,
    scene: Scene,
    views: tuple[View, ...],
    layer: Layer,
    truth: Evidence,
) -> dict[str, Any]:
    if isinstance(layer, Features):
        raise InputError(f"--layer: {command.layer} holds features, which have no score.")
    if command.metric == "binary":
        with progress("evaluate") as step:
            report = evaluate_binary(
                scene.gaussians,
                views,
                layer,
                truth,
                id=command.id,
                backend=command.backend,
                progress=step,
            )
        return binary_figures(report)
    if not isinstance(layer, Labels):
        raise InputError("--metric: a selection has no classes; use --metric binary.")
    if command.metric == "panoptic" and command.truth_instances is not None:
        true_instances = open_evidence(command.truth_instances)
        return _panoptic_figures(
            command, scene, views, layer, truth=truth, true_instances=true_instances
        )
    method = evaluate_semantic if command.metric == "semantic" else evaluate_instances
    with progress("evaluate") as step:
        report = method(
            scene.gaussians, views, layer, truth, backend=command.backend, progress=step
        )
    if isinstance(report, SemanticReport):
        return semantic_figures(report)
    return instance_figures(report)


def _panoptic_figures(
    command: Command,
    scene: Scene,
    views: tuple[View, ...],
    layer: Labels,
    *,
    truth: Evidence,
    true_instances: Evidence,
) -> dict[str, Any]:
    other = None
    if command.instances is not None:
        other = _labels(scene, command.instances, "--instances")
    with progress("evaluate") as step:
        report = evaluate_panoptic(
            scene.gaussians,
            views,
            classes=None if other is None else layer,
            instances=layer if other is None else other,
            true_classes=truth,
            true_instances=true_instances,
            table=_thing_table(command, scene, truth),
            scores=None if command.scores is None else read_scores(command.scores),
            backend=command.backend,
            progress=step,
        )
    return panoptic_figures(report)


def _thing_table(command: Command, scene: Scene, truth: Evidence) -> ClassTable:
    if command.metadata is not None:
        if command.zero_is_class:
            raise InputError(
                "--metadata: its ids are those of the files, which --zero-is-class changes; "
                "put it beside the truth as metadata.json instead."
            )
        return class_table(read_json(command.metadata).get("classes"), where=str(command.metadata))
    table = truth.classes or scene.classes
    if table is None:
        raise InputError(
            "--metadata: expected a JSON file that says which classes are things; neither the "
            "truth nor the scene does."
        )
    return table


def _point_figures(command: Command, scene: Scene, path: Path) -> dict[str, Any]:
    """Scores of points, under names that begin with points_."""
    labels = _labels(scene, command.layer or "", "--layer")
    points, truth = read_points(path, _POINT_TRUTH[command.metric])
    report = evaluate_points(
        scene.gaussians,
        labels,
        points=points,
        truth=truth,
        matched=command.metric == "instances",
        rule=command.points_rule,
    )
    return point_figures(report, rule=command.points_rule)


def _labels(scene: Scene, name: str, option: str) -> Labels:
    layer = layer_of(scene, name)
    if not isinstance(layer, Labels):
        raise InputError(f"{option}: expected a layer of labels, {name} is none.")
    return layer


def _wants_photographs(command: Command, views: tuple[View, ...]) -> bool:
    at_hand = all(view.image is not None and view.image.is_file() for view in views)
    return command.photographs or at_hand


def _photograph_figures(
    command: Command, scene: Scene, views: tuple[View, ...], network: Lpips | None
) -> dict[str, Any]:
    with progress("photographs") as step:
        report = evaluate_photographs(
            scene.gaussians,
            views,
            masks=mask_use(scene),
            lpips=network,
            backend=command.backend,
            progress=step,
        )
    figures: dict[str, Any] = {
        "PSNR": report.psnr,
        "SSIM": report.ssim,
        "PSNR_min": report.psnr_min,
        "photographs": len(report.views),
    }
    if network is not None:
        figures |= {"LPIPS": report.lpips, "LPIPS_network": network.network}
    return figures


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
