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

from splatseg.cli._work import layer_of, mask_use, open_scene, progress, views_of_split
from splatseg.core import Labels, Scene, Selection, View
from splatseg.errors import InputError
from splatseg.evaluate import evaluate_binary, evaluate_photographs, evaluate_semantic
from splatseg.evaluate.lpips import Lpips, load_lpips
from splatseg.io.evidence import Evidence, open_evidence
from splatseg.render import BackendName


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Score a layer against the truth, and the pictures against the photographs.

    mIoU, fwIoU and accuracy are pooled over all views and equal to those of the usual scorers;
    the per-image mIoU is the mean over views. Predictions are drawn in the truth's own pixels.
    """

    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """The scene folder."""

    layer: str | None = None
    """Name of the layer to score. None scores the pictures only."""

    truth: Path | None = None
    """Folder of the true id maps, one PNG a view; 0 is void."""

    zero_is_class: bool = False
    """The id 0 of the truth's files is a class and not void: ids grow by 1."""

    void: int | None = None
    """A further id of the truth's files that means void, such as 255."""

    split: str = "test"
    """Which views: test, train, another split of the scene, or all."""

    metric: Literal["semantic", "binary"] = "semantic"
    """What to score: semantic, classes; binary, one id or a selection as a mask."""

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

    backend: BackendName = "auto"
    """Who renders. auto: cuda for scenes on a GPU, cpu otherwise."""

    data: Path | None = None
    """Folder of the capture, where it was moved."""


def run(command: Command) -> None:
    """Evaluate a scene."""
    if (command.layer is None) != (command.truth is None):
        raise InputError("--layer, --truth: expected both or neither, got one of them.")
    network = load_lpips(command.lpips) if command.lpips else None
    scene = open_scene(command.scene, command.data)
    views = views_of_split(scene, command.split)
    figures: dict[str, Any] = {"scene": str(command.scene), "split": command.split}
    if command.layer is not None and command.truth is not None:
        layer = layer_of(scene, command.layer)
        if not isinstance(layer, (Labels, Selection)):
            raise InputError(f"--layer: {command.layer} holds features, which have no score.")
        truth = open_evidence(command.truth, zero_is_class=command.zero_is_class, void=command.void)
        figures |= {"layer": command.layer, "metric": command.metric}
        figures |= _layer_figures(command, scene, views, layer, truth)
    if network is not None or _wants_photographs(command, views):
        figures |= _photograph_figures(command, scene, views, network)
    elif command.layer is None:
        raise InputError(
            f"{command.scene}: expected a layer with a truth, or photographs to score against, "
            "got neither."
        )
    if command.json:
        sys.stdout.write(json.dumps(figures) + "\n")
    else:
        _print_table(figures, scene)


def _layer_figures(
    command: Command,
    scene: Scene,
    views: tuple[View, ...],
    layer: Labels | Selection,
    truth: Evidence,
) -> dict[str, Any]:
    if command.metric == "binary":
        with progress("evaluate") as step:
            binary = evaluate_binary(
                scene.gaussians,
                views,
                layer,
                truth,
                id=command.id,
                backend=command.backend,
                progress=step,
            )
        return {
            "views": len(binary.views),
            "learned_from": len(binary.learned_from),
            "IoU_mean_over_views": binary.score.iou_mean,
            "IoU_pooled": binary.score.iou_pooled,
            "accuracy": binary.score.accuracy,
        }
    if not isinstance(layer, Labels):
        raise InputError("--metric: a selection has no classes; use --metric binary.")
    with progress("evaluate") as step:
        report = evaluate_semantic(
            scene.gaussians, views, layer, truth, backend=command.backend, progress=step
        )
    score = report.score
    return {
        "views": len(report.views),
        "learned_from": len(report.learned_from),
        "mIoU": score.miou,
        "fwIoU": score.fwiou,
        "accuracy": score.accuracy,
        "mAcc": score.mean_accuracy,
        "mIoU_per_image": report.per_image_miou,
        "classes": len(score.per_class),
        "per_class": {str(k): v for k, v in score.per_class.items()},
    }


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


def _print_table(figures: Mapping[str, Any], scene: Scene) -> None:
    console = Console(highlight=False)
    table = Table("measure", "value", title=f"{figures['scene']}, {figures['split']} views")
    table.columns[1].justify = "right"
    for key, value in figures.items():
        if key not in ("scene", "split", "per_class", "learned_from"):
            table.add_row(key, f"{value:.4f}" if isinstance(value, float) else str(value))
    console.print(table)
    if "per_class" in figures:
        classes = Table("id", "class", "IoU")
        classes.columns[2].justify = "right"
        for key, value in figures["per_class"].items():
            name = "" if scene.classes is None else scene.classes.name_of(int(key))
            classes.add_row(key, name, f"{value:.4f}")
        console.print(classes)
    if figures.get("learned_from"):
        console.print(
            f"The layer was made from {figures['learned_from']} of these views: "
            "this is no held-out score."
        )
