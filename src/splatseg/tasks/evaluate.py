"""A layer against truth, and renders against photographs."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from splatseg.core import ClassTable, Layer, Renderable, Scene, View
from splatseg.core.boundary import boundary
from splatseg.core.options import options as options_class
from splatseg.errors import InputError
from splatseg.evaluate import (
    SemanticReport,
    evaluate_binary,
    evaluate_instances,
    evaluate_panoptic,
    evaluate_photographs,
    evaluate_points,
    evaluate_semantic,
    matched_miou,
)
from splatseg.evaluate.photographs import Lpips, load_lpips
from splatseg.io.evidence import Evidence, check_map_sizes, open_evidence
from splatseg.render import BackendName
from splatseg.tasks.figures import (
    binary_figures,
    instance_figures,
    panoptic_figures,
    point_figures,
    read_points,
    semantic_figures,
)
from splatseg.tasks.work import SILENT, Observer, Work, mask_use, photographed

Metric = Literal["semantic", "instances", "panoptic", "binary"]

# Folders of a capture whose true ids are of instances.
_INSTANCE_FOLDERS = ("instance", "instances")

# The array of a file of points that holds the truth of each metric.
_POINT_TRUTH: Mapping[str, str] = {"semantic": "semantic", "instances": "instance"}


@options_class(
    removed={
        "metadata": "`classes` takes the same JSON file",
        "scores": "AP50 ranks all instances alike; `evaluate.evaluate_panoptic` takes scores",
        "points_rule": "the density of the Gaussians around a point decides; "
        "`lift.PointLabelOptions` has the nearest",
        "photographs": "renders are scored where photographs are at hand",
    }
)
class EvaluationOptions:
    """What is scored, and the truth."""

    layer: str | None = None
    """Name of the layer to score. NAME@part is a cut of a tree; NAME@hard reads features of each
    Gaussian instead of each pixel. None scores renders only."""

    truth: Path | None = None
    """Folder of true id maps, one PNG per view; 0 is void. Of classes, or of instances where
    `metric` is instances."""

    instances: str | None = None
    """With panoptic: name of the layer of instances; `layer` is that of the classes. None takes
    `layer` for both: its record must tell each instance's class, as that of associate does."""

    truth_instances: Path | None = None
    """With panoptic: folder of true instance maps; `truth` is that of the classes."""

    points: Path | None = None
    """Also score labels of points: an .npz with xyz (n x 3, world) and, for the metric, semantic or
    instance (n, 0 is void)."""

    zero_is_class: bool = False
    """The id 0 of the truth's files is a class, not void: ids grow by 1."""

    void: int | None = None
    """A further id of the truth's files that means void, such as 255."""

    suffix: str = ""
    """Text between the view's name and the ending in names of the truth's files, such as _gt for
    000_gt.png; files without it are skipped."""

    classes: str | None = None
    """Names of the truth's ids: ade20k, coco, cityscapes, scannet, kitti360 or semantic-kitti, with
    the suffix -train for the ids that networks predict; or a JSON file with "classes" (id, name,
    isthing). Pictures in a table's colours are read by it. None takes what the truth, the layer or
    the scene says."""

    split: str = "test"
    """Views: test, train, another split of the scene, or all."""

    metric: Metric = "semantic"
    """What to score: semantic, classes; instances, objects by their overlap; panoptic, both;
    binary, one id or a selection as a mask."""

    id: int | None = None
    """With binary: the id to score. None takes every labelled pixel."""

    lpips: tuple[Path, ...] = ()
    """Also score LPIPS with your weights: AlexNet's or VGG-16's, and the heads', as .safetensors
    or .npz with the names of torchvision and of the lpips package."""


@boundary
def evaluate_scene(
    scene: Scene,
    *,
    options: EvaluationOptions | None = None,
    layers: Mapping[str, Layer] | None = None,
    field: Renderable | None = None,
    backend: BackendName = "auto",
    observer: Observer = SILENT,
) -> dict[str, Any]:
    """Score a layer against the truth, and renders against the photographs.

    mIoU, fwIoU and accuracy are pooled over all views and equal to those of the usual scorers;
    the per-image mIoU is the mean over views. Predictions are drawn in the truth's own pixels.
    Instances are matched one to one over the whole scene; panoptic quality takes a segment as
    all its pixels in all views.

    Args:
        scene: The scene.
        options: What to score.
        layers: Layers at hand; others are read from the scene's folder.
        field: What is scored, with layers of its own; None is the scene's Gaussians with theirs.
        backend: Rendering backend of the Gaussians.
        observer: Is told of the progress.

    Returns:
        Scores by name, in values that JSON holds; those of classes in mappings of their own.

    Raises:
        InputError: If options do not belong together, or something asked for is not there.
    """
    options = options or EvaluationOptions()
    _check(options)
    work = Work(scene=scene, layers=layers, backend=backend, observer=observer)
    if field is None:
        field = work.field(name for name in (options.layer, options.instances) if name is not None)
    job = _Job(scene=scene, field=field, options=options, observer=observer)
    network = load_lpips(options.lpips) if options.lpips else None
    figures: dict[str, Any] = {"scene": str(scene.root), "split": options.split}
    if options.layer is not None:
        figures |= {"layer": options.layer, "metric": options.metric}
    if options.truth is not None or options.layer is None:
        views = work.views_of_split(options.split)
        figures |= _in_views(job, views, network)
    if options.points is not None:
        figures |= _point_figures(job, options.points)
    return figures


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Job:
    scene: Scene
    field: Renderable
    options: EvaluationOptions
    observer: Observer


def _check(options: EvaluationOptions) -> None:
    """Say which options belong together before anything is read."""
    if options.layer is None and (options.truth or options.points):
        raise InputError(
            "layer: expected the layer that the truth and the points are to score, got none."
        )
    if options.layer is not None and not (options.truth or options.points):
        raise InputError("truth: expected a folder of true id maps (or points), got none.")
    if options.metric == "panoptic" and options.truth_instances is None:
        raise InputError(
            "truth_instances: expected the folder of true instance maps beside the truth, which "
            "is of classes, got none."
        )
    if options.metric != "panoptic" and (options.instances or options.truth_instances):
        raise InputError(
            f"instances, truth_instances: expected metric panoptic with them, got {options.metric}."
        )
    if options.points is not None and options.metric not in _POINT_TRUTH:
        raise InputError(
            f"points: expected the metric semantic or instances, got {options.metric}."
        )


def _in_views(job: _Job, views: tuple[View, ...], network: Lpips | None) -> dict[str, Any]:
    """Scores of the layer, and of the pictures where there are photographs or they are asked."""
    figures: dict[str, Any] = {}
    if job.options.layer is not None and job.options.truth is not None:
        truth = open_evidence(
            job.options.truth,
            zero_is_class=job.options.zero_is_class,
            void=job.options.void,
            suffix=job.options.suffix,
            classes=job.options.classes,
        )
        check_map_sizes(truth, views)
        figures |= _layer_figures(job, views, job.options.layer, truth)
    if network is not None or len(photographed(views)) == len(views):
        figures |= _photograph_figures(job, views, network)
    elif job.options.layer is None:
        raise InputError(
            f"{job.scene.root}: expected a layer with a truth, or photographs to score against, "
            "got neither."
        )
    return figures


def _layer_figures(
    job: _Job,
    views: tuple[View, ...],
    layer: str,
    truth: Evidence,
) -> dict[str, Any]:
    kind = job.field.layer(layer).kind
    if kind == "features":
        raise InputError(
            f"layer: {layer} holds features without a classifier, which have no score."
        )
    if job.options.metric == "binary":
        with job.observer.stage("evaluate") as step:
            report = evaluate_binary(
                job.field, views, layer, truth, id=job.options.id, progress=step
            )
        return binary_figures(report)
    if kind != "labels":
        raise InputError("metric: a selection has no classes, expected the metric binary.")
    if job.options.metric == "panoptic" and job.options.truth_instances is not None:
        true_instances = open_evidence(job.options.truth_instances)
        check_map_sizes(true_instances, views)
        return _panoptic_figures(job, views, layer, truth=truth, true_instances=true_instances)
    method = evaluate_semantic if job.options.metric == "semantic" else evaluate_instances
    with job.observer.stage("evaluate") as step:
        report = method(job.field, views, layer, truth, progress=step)
    if isinstance(report, SemanticReport):
        _note_other_ids(job, layer, truth, report)
        return semantic_figures(report, _names(job, layer, truth))
    return instance_figures(report)


def _names(job: _Job, layer: str, truth: Evidence) -> Callable[[int], str]:
    """Names of ids: those of the truth, else of the layer's record, else of the scene."""
    known: dict[int, str] = {}
    if job.scene.classes is not None:
        known |= {row.id: row.name for row in job.scene.classes.rows}
    known |= job.field.layer(layer).info.names
    if truth.kind == "labels" and truth.classes is not None:
        known |= {row.id: row.name for row in truth.classes.rows}
    return lambda id: known.get(id, f"id {id}")


_OTHER_IDS = 0.3
"""By how much more the mean IoU would be with ids matched than as they are, for a note."""


def _note_other_ids(job: _Job, layer: str, truth: Evidence, report: SemanticReport) -> None:
    """Say that ids look like instances, or like those of another table."""
    folder = truth.folder.name
    if truth.kind in ("tracked", "panoptic") or folder in _INSTANCE_FOLDERS:
        job.observer.note(
            f"{truth.folder} holds instances, and its ids were compared with the classes of "
            f"{layer}; metric instances compares things whatever their ids"
        )
        return
    matched = matched_miou(report.confusion)
    if matched - report.score.miou >= _OTHER_IDS:
        job.observer.note(
            f"mIoU is {report.score.miou:.3f}, but {matched:.3f} once ids are matched one to one: "
            f"{layer} and {truth.folder} number their ids differently (instances? metric instances "
            "compares these; another class table? see `classes` and `zero_is_class`)"
        )


def _panoptic_figures(
    job: _Job,
    views: tuple[View, ...],
    layer: str,
    *,
    truth: Evidence,
    true_instances: Evidence,
) -> dict[str, Any]:
    other = job.options.instances
    if other is not None:
        _check_labels(job, other, "instances")
    with job.observer.stage("evaluate") as step:
        report = evaluate_panoptic(
            job.field,
            views,
            classes=None if other is None else layer,
            instances=layer if other is None else other,
            true_classes=truth,
            true_instances=true_instances,
            table=_thing_table(job, truth),
            progress=step,
        )
    return panoptic_figures(report)


def _thing_table(job: _Job, truth: Evidence) -> ClassTable:
    table = truth.classes or job.scene.classes
    if table is None:
        raise InputError(
            "classes: expected a JSON file that says which classes are things; neither the truth "
            "nor the scene does."
        )
    return table


def _point_figures(job: _Job, path: Path) -> dict[str, Any]:
    """Scores of points, under names that begin with points_."""
    layer = job.options.layer or ""
    _check_labels(job, layer, "layer")
    points, truth = read_points(path, _POINT_TRUTH[job.options.metric])
    report = evaluate_points(
        job.field,
        layer,
        points=points,
        truth=truth,
        matched=job.options.metric == "instances",
    )
    return point_figures(report)


def _check_labels(job: _Job, name: str, option: str) -> None:
    if job.field.layer(name).kind != "labels":
        raise InputError(f"{option}: expected a layer of labels, {name} is none.")


def _photograph_figures(
    job: _Job, views: tuple[View, ...], network: Lpips | None
) -> dict[str, Any]:
    with job.observer.stage("photographs") as step:
        report = evaluate_photographs(
            job.field,
            views,
            masks=mask_use(job.scene),
            lpips=network,
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
