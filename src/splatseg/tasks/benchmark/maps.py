"""Classes and instances of every pixel of views, held against the truth."""

from dataclasses import dataclass
from typing import Any

from splatseg.core import (
    UNLABELLED,
    Features,
    LabelMap,
    Layer,
    View,
    map_ids,
)
from splatseg.core.benchmark import TrueMaps
from splatseg.errors import InputError
from splatseg.evaluate import (
    Confusion,
    evaluate_instances,
    per_image_miou,
    semantic_score,
)
from splatseg.evaluate.held_out import drawn_and_true
from splatseg.lift import GaussianField
from splatseg.tasks.benchmark.fits import held_out_views
from splatseg.tasks.benchmark.job import Job
from splatseg.tasks.benchmark.points import read_by_words, true_ids_of
from splatseg.tasks.benchmark.sight import Seen

_LAYER = "layer"
Scores = tuple[dict[str, float], list[dict[str, Any]], list[str]]
"""Figures, a row a view, and notes."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Maps:
    """True maps as a source of label maps."""

    maps: TrueMaps

    @property
    def view_names(self) -> tuple[str, ...]:
        return tuple(self.maps.read)

    def label_map(self, name: str) -> LabelMap:
        return self.maps.read[name]()


def map_scores(job: Job) -> Scores:
    """Figures of a method in the scored views of a scene.

    Evidence of classes gives ``miou`` and what goes with it; evidence of segments gives instances,
    and panoptic quality where each instance has a class.

    Raises:
        InputError: If the scene has no truth of what the method gives.
    """
    words = job.method.returns == "features" and job.method.evidence == ("features",)
    seen = job.seen(words=words)
    layer = job.layer(seen.name)
    if isinstance(layer, Features) and layer.info.head is None:
        truth = _truth(job, job.bench.semantic, "classes")
        if truth.table is None:
            raise InputError(f"scene {job.bench.name}: expected names of its classes, got none.")
        ids = [row.id for row in truth.table.rows]
        return _classes(job, seen, read_by_words(job, seen, layer, truth.table, ids), by_words=True)
    if seen.kind == "labels":
        return _classes(job, seen, layer, by_words=False)
    return _instances(job, layer)


def _classes(job: Job, seen: Seen, layer: Layer, *, by_words: bool) -> Scores:
    """Scores of classes, those of the evidence told in the truth's ids by name."""
    truth = _truth(job, job.bench.semantic, "classes")
    mapping, notes = (None, []) if by_words else true_ids_of(job, seen, truth.table)
    field = GaussianField(job.scene.gaussians, {_LAYER: layer}, backend=job.backend)
    views = _scored(job, truth)
    confusions: list[Confusion] = []
    with job.observer.stage("score") as step:
        for drawn, true in drawn_and_true(field, views, _LAYER, _Maps(maps=truth), progress=step):
            ids = drawn.ids
            if mapping is not None:
                ids = map_ids(ids, mapping, default=UNLABELLED)
            confusions.append(Confusion.of(ids, true.ids))
    pooled = semantic_score(sum(confusions, start=Confusion.none()))
    rows = [
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
    return scores, rows, notes


def _instances(job: Job, layer: Layer) -> Scores:
    """Scores of instances matched over the scene, and panoptic quality where they have classes."""
    truth = _truth(job, job.bench.instances, "instances")
    field = GaussianField(job.scene.gaussians, {_LAYER: layer}, backend=job.backend)
    views = _scored(job, truth)
    report = evaluate_instances(field, views, _LAYER, _Maps(maps=truth))
    scores = {"instance_miou": report.score.miou}
    return scores, [], []


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
