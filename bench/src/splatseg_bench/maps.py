"""Classes and instances of every pixel of views, held against the truth."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, cast

import torch
from jaxtyping import Int
from torch import Tensor

from splatseg.core import (
    UNLABELLED,
    InstanceTree,
    LabelMap,
    Layer,
    Selection,
    View,
    map_ids,
    with_info,
)
from splatseg.core.scans import LabelledMesh, LabelledPoints
from splatseg.errors import InputError
from splatseg.evaluate import (
    Confusion,
    SurfaceField,
    evaluate_instances,
    evaluate_panoptic,
    per_image_miou,
    semantic_score,
)
from splatseg.evaluate.held_out import drawn_and_true
from splatseg.io.atomic import path_inside
from splatseg.io.evidence import save_label_map
from splatseg.lift import GaussianField
from splatseg_bench.evidence import Seen, evidence_wanted
from splatseg_bench.job import Job
from splatseg_bench.measures import matched_instance_score
from splatseg_bench.points import read_by_words, read_in_words, true_ids_of
from splatseg_bench.protocols import MapSwitches
from splatseg_bench.scene import TrueMaps
from splatseg_bench.scenes import held_out_views

_LAYER = "layer"
_SURFACE = "label"
Scores = tuple[dict[str, float], list[dict[str, Any]], list[str]]
"""Figures, a row a view, and notes."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrueMapSource:
    """True maps as a source of label maps."""

    maps: TrueMaps

    @property
    def view_names(self) -> tuple[str, ...]:
        """Views that have a map."""
        return tuple(self.maps.read)

    def label_map(self, name: str) -> LabelMap:
        """The map of a view."""
        return self.maps.read[name]()


def map_scores(job: Job) -> Scores:
    """Figures of a method in the scored views of a scene.

    Evidence of classes gives ``miou`` and what goes with it; evidence of segments gives instances,
    and panoptic quality where each instance has a class.

    Raises:
        InputError: If the scene has no truth of what the method gives.
    """
    seen = job.seen(words=evidence_wanted(job.protocol, job.method, job.options) == "words")
    layer = job.whole_layer(seen.name)
    if read_in_words(layer):
        truth = _truth(job, true_classes(job), "classes")
        if truth.table is None:
            raise InputError(f"scene {job.bench.name}: expected names of its classes, got none.")
        ids = [row.id for row in truth.table.rows]
        return _classes(job, seen, read_by_words(job, seen, layer, truth.table, ids), by_words=True)
    if seen.kind == "labels":
        return _classes(job, seen, layer, by_words=False)
    return _instances(job, seen, layer)


def _classes(job: Job, seen: Seen, layer: Layer, *, by_words: bool) -> Scores:
    """Scores of classes, those of the evidence told in the truth's ids by name."""
    truth = _truth(job, true_classes(job), "classes")
    mapping, notes = (None, []) if by_words else true_ids_of(job, seen, truth.table)
    field = GaussianField(job.scene.gaussians, {_LAYER: layer}, backend=job.backend)
    views = _scored(job, truth)
    confusions: list[Confusion] = []
    with job.observer.stage("score") as step:
        maps = drawn_and_true(field, views, _LAYER, TrueMapSource(maps=truth), progress=step)
        for view, (drawn, true) in zip(views, maps, strict=True):
            ids = drawn.ids
            if mapping is not None:
                ids = map_ids(ids, mapping, default=UNLABELLED)
            keep_map(job, "classes", view, ids)
            confusions.append(Confusion.of(ids, true.ids))
    return *class_scores(views, confusions), notes


def class_scores(
    views: Sequence[View], confusions: Sequence[Confusion]
) -> tuple[dict[str, float], list[dict[str, Any]]]:
    """Scores of classes over views, and a row for each view that has a true class."""
    pooled = semantic_score(sum(confusions, start=Confusion.none()))
    rows: list[dict[str, Any]] = [
        {"view": view.name, "miou": semantic_score(one).miou}
        for view, one in zip(views, confusions, strict=True)
        if one.pixels
    ]
    scores = {
        "miou": pooled.miou,
        "fwiou": pooled.fwiou,
        "accuracy": pooled.accuracy,
        "mean_accuracy": pooled.mean_accuracy,
        "per_image_miou": per_image_miou(confusions),
    }
    return scores, rows


def _instances(job: Job, seen: Seen, layer: Layer) -> Scores:
    """Scores of instances matched over the scene, and panoptic quality where they have classes."""
    truth = _truth(job, job.bench.instances, "instances")
    switches = cast(MapSwitches, job.protocol.switches)
    if isinstance(layer, InstanceTree):
        layer = layer.cut()
    if isinstance(layer, Selection):
        raise InputError(f"method {job.method.name}: expected instances, got a selection.")
    layer, notes = _in_true_classes(job, seen, layer)
    field = GaussianField(job.scene.gaussians, {_LAYER: layer}, backend=job.backend)
    views, source = _scored(job, truth), TrueMapSource(maps=truth)
    pooled = evaluate_instances(field, views, _LAYER, source).score
    with job.observer.stage("score") as step:
        drawn = drawn_and_true(field, views, _LAYER, source, progress=step)
        matched = matched_instance_score(
            _kept_maps(job, views, drawn),
            none_is_object=switches.zero_is_instance,
        )
    scores = {
        "instance_miou": matched.miou,
        "precision": matched.precision50,
        "recall": matched.recall50,
        "pooled_instance_miou": pooled.miou,
    }
    rows = [
        {"instance": id, "match": found, "iou": iou}
        for id, (found, iou) in sorted(matched.matches.items())
    ]
    return scores | _panoptic(job, field, layer, views), rows, notes


def _kept_maps(
    job: Job, views: Sequence[View], maps: Iterable[tuple[LabelMap, LabelMap]]
) -> Iterator[tuple[str, Int[Tensor, "height width"], Int[Tensor, "height width"]]]:
    """Name, predicted and true ids of each view, which are written on the way."""
    for view, (found, true) in zip(views, maps, strict=True):
        keep_map(job, "instances", view, found.ids)
        yield view.name, found.ids, true.ids


def keep_map(job: Job, kind: str, view: View, ids: Int[Tensor, "height width"]) -> None:
    """Write a predicted map: 16 bit, 0 for none."""
    folder = path_inside(
        job.root, "predictions", job.protocol.name, job.method.name, job.bench.name, kind
    )
    save_label_map(LabelMap(ids=torch.where(ids > 0, ids, UNLABELLED)), folder, view.name)


def _panoptic(
    job: Job, field: GaussianField, layer: Layer, views: Sequence[View]
) -> dict[str, float]:
    """Panoptic quality, where the truth has classes and instances and the layer both as well."""
    semantic, instances = job.bench.semantic, job.bench.instances
    if semantic is None or instances is None or semantic.table is None:
        return {}
    if not layer.info.class_of:
        return {}
    report = evaluate_panoptic(
        field,
        views,
        classes=None,
        instances=_LAYER,
        true_classes=TrueMapSource(maps=semantic),
        true_instances=TrueMapSource(maps=instances),
        table=semantic.table,
        void_rule=cast(MapSwitches, job.protocol.switches).void_rule,
    )
    return {
        "pq_scene": report.score.pq,
        "pq": report.image_score.pq,
        "ap50": report.precision.mean,
        "miou": report.semantic.miou,
        "accuracy": report.semantic.accuracy,
    }


def _in_true_classes(job: Job, seen: Seen, layer: Layer) -> tuple[Layer, list[str]]:
    """The layer with classes of its instances in the truth's ids, by name."""
    if job.bench.semantic is None or not layer.info.class_of:
        return layer, []
    mapping, notes = true_ids_of(job, seen, job.bench.semantic.table)
    if mapping is None:
        return layer, notes
    classes = {id: mapping[one] for id, one in layer.info.class_of.items() if one in mapping}
    return with_info(layer, replace(layer.info, class_of=classes)), notes


def true_classes(job: Job) -> TrueMaps | None:
    """Class maps of the data set; drawn from its labelled surface where it has points alone.

    As the open-vocabulary voxel paper scores ScanNet++: rays from the pixels meet the mesh, and
    take the label of the nearest corner.
    """
    points = job.bench.points
    if job.bench.semantic is not None or points is None:
        return job.bench.semantic
    ids = {_SURFACE: points.labels.ids}
    surface = (
        LabelledPoints(points=points.points, labels=ids)
        if points.faces is None
        else LabelledMesh(vertices=points.points, faces=points.faces, vertex_labels=ids)
    )
    field = SurfaceField(surface)

    def drawn(name: str) -> LabelMap:
        with field.view(job.scene.view(name).camera) as view:
            return view.label_map(_SURFACE)

    reads = {view.name: partial(drawn, view.name) for view in job.scene.views}
    return TrueMaps(read=reads, table=points.table)


def _truth(job: Job, maps: TrueMaps | None, what: str) -> TrueMaps:
    if maps is None:
        raise InputError(f"scene {job.bench.name}: expected true {what} of views, got none.")
    return maps


def _scored(job: Job, truth: TrueMaps) -> list[View]:
    """Held-out views that have a truth; all that have one where nothing is held out."""
    out = held_out_views(job.bench, job.protocol)
    views = [
        view
        for view in job.scene.views
        if view.name in truth.read and (view.name in out or not out)
    ]
    if not views:
        raise InputError(
            f"scene {job.bench.name}: expected a truth of one of its {len(out)} held-out views."
        )
    return sorted(views, key=lambda view: view.name)
