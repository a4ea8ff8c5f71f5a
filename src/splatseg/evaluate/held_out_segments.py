"""Instances and panoptic labels held against truth: in views, and at labelled points.

As in `splatseg.evaluate.held_out`, predictions are drawn in the pixels of the truth, and views
that a layer learned from are named. Counts are kept by pair of segments that overlap, so memory
does not grow with the number of views.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor

from splatseg._check import check_shape
from splatseg.core import (
    UNLABELLED,
    ClassTable,
    LabelMap,
    LabelSource,
    Renderable,
    RenderableLayer,
    View,
    map_ids,
)
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, ShapeError
from splatseg.evaluate._panoptic_counts import PanopticCounts, VoidRule
from splatseg.evaluate.held_out import (
    Progress,
    ViewsReport,
    drawn_and_true,
    drawn_like,
    learned_from,
    with_truth,
)
from splatseg.evaluate.metrics import Confusion, SemanticScore, semantic_score
from splatseg.evaluate.overlaps import InstanceScore, Overlaps, instance_score
from splatseg.evaluate.panoptic import (
    Detections,
    PanopticScore,
    PrecisionScore,
    average_precision,
    image_panoptic_score,
    panoptic_score,
    segment_keys,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class InstanceReport(ViewsReport):
    """Scores of a layer's instances, classes aside."""

    score: InstanceScore


@dataclass(frozen=True, slots=True, kw_only=True)
class PanopticReport(ViewsReport):
    """Scores of a layer of classes with a layer of instances; `learned_from` is of either."""

    score: PanopticScore
    """PQ over the scene."""

    image_score: PanopticScore
    """PQ of segments of single images."""

    precision: PrecisionScore
    """AP50 of instances in views."""

    semantic: SemanticScore
    """Of the classes alone."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PointReport:
    """Scores of the labels that a layer gives to points."""

    semantic: SemanticScore | None
    """Where ids of the layer and of the points mean the same."""

    instances: InstanceScore | None
    """Where they do not, and are matched."""

    points: int
    """Points that are not void."""

    unlabelled: float
    """Share of them that got no label."""


@boundary
def evaluate_instances(
    field: Renderable,
    views: Sequence[View],
    layer: str,
    truth: LabelSource,
    *,
    progress: Progress | None = None,
) -> InstanceReport:
    """Match the instances of a layer to the true ones over the whole scene, and score them.

    Args:
        field: What is scored.
        views: Where to look; those without a truth are left out.
        layer: Name of the layer; its ids need not be the truth's.
        truth: Instance maps by view name; -1 is void.
        progress: Called with the views done and their number.

    Raises:
        InputError: If no view has a truth, or there is no true instance in them.
        ShapeError: If a truth does not have its photograph's proportions.
    """
    scored = with_truth(views, truth)
    total = Overlaps.none()
    for drawn, true in drawn_and_true(field, scored, layer, truth, progress=progress):
        total = total + Overlaps.of(drawn.ids, true.ids)
    return InstanceReport(
        score=instance_score(total),
        views=tuple(view.name for view in scored),
        learned_from=learned_from(field.layer(layer), scored),
    )


@boundary
def evaluate_panoptic(
    field: Renderable,
    views: Sequence[View],
    *,
    classes: str | None,
    instances: str,
    true_classes: LabelSource,
    true_instances: LabelSource,
    table: ClassTable,
    scores: Mapping[int, float] | None = None,
    void_rule: VoidRule = "coco",
    progress: Progress | None = None,
) -> PanopticReport:
    """Score a layer of classes and a layer of instances together.

    Views are gone through by name, so that AP50 without scores is that of other scorers.

    Args:
        field: What is scored.
        views: Where to look; those without a truth are left out.
        classes: Name of the layer of classes, in the ids of the truth. None takes the class that
            the layer of instances says each of them has (`classes_of_instances`), pixel by pixel.
        instances: Name of the layer of instances; its ids need not be the truth's.
        true_classes: Class maps by view name; -1 is void.
        true_instances: Instance maps by view name, of the same views.
        table: Which classes are things. A class that it does not know is stuff.
        scores: How sure each instance is, by its id, for AP50; 1 where there is none.
        void_rule: Which segments of images without a match are false, see `PanopticCounts`.
        progress: Called with the views done and their number.

    Raises:
        InputError: If no view has a truth, one has classes but no instances, or a layer that
            should tell the classes of its instances does not.
        ShapeError: If a truth does not have its photograph's proportions, or the two differ.
    """
    things = frozenset(row.id for row in table.rows if row.isthing)
    scored = sorted(with_truth(views, true_classes), key=lambda view: view.name)
    class_of = None if classes is not None else classes_of_instances(field.layer(instances))
    layers = [layer for layer in (instances, classes) if layer is not None]
    _check_instances(scored, true_instances)
    total, detections, confusion = Overlaps.none(), Detections(), Confusion.none()
    counts = PanopticCounts()
    for done, view in enumerate(scored, start=1):
        true, true_ids = _true_maps(view, true_classes, true_instances)
        maps = drawn_like(field, view, layers, true)
        found = maps[0].ids
        drawn = maps[1].ids if class_of is None else map_ids(found, class_of, default=UNLABELLED)
        keys = segment_keys(drawn, found, things=things)
        true_keys = segment_keys(true.ids, true_ids.ids, things=things)
        one = Overlaps.of(keys, true_keys)
        counts = counts + PanopticCounts.of_image(keys, true_keys, void_rule=void_rule)
        total = total + one
        detections = detections + Detections.of(one, view=view.name, things=things, scores=scores)
        confusion = confusion + Confusion.of(drawn, true.ids)
        if progress is not None:
            progress(done, len(scored))
    both = {name for layer in layers for name in learned_from(field.layer(layer), scored)}
    return PanopticReport(
        score=panoptic_score(total, things=things),
        image_score=image_panoptic_score(counts, things=things),
        precision=average_precision(detections),
        semantic=semantic_score(confusion),
        views=tuple(view.name for view in scored),
        learned_from=tuple(view.name for view in scored if view.name in both),
    )


def _check_instances(scored: Sequence[View], true_instances: LabelSource) -> None:
    known = set(true_instances.view_names)
    lacking = [view.name for view in scored if view.name not in known]
    if lacking:
        raise InputError(
            f"true_instances: expected those of all {len(scored)} views with true classes, "
            f"{len(lacking)} lack them, the first is {lacking[0]}."
        )


def _true_maps(
    view: View, true_classes: LabelSource, true_instances: LabelSource
) -> tuple[LabelMap, LabelMap]:
    """The true classes and instances of a view, of one size."""
    classes, instances = true_classes.label_map(view.name), true_instances.label_map(view.name)
    if classes.ids.shape != instances.ids.shape:
        raise ShapeError(
            f"true_instances: {view.name}: expected the size {tuple(classes.ids.shape)} of the "
            f"true classes, got {tuple(instances.ids.shape)}."
        )
    return classes, instances


def classes_of_instances(instances: RenderableLayer) -> dict[int, int]:
    """Class by instance id, -1 none, as the layer's info tells it.

    Raises:
        InputError: If it tells none.
    """
    info = instances.info
    found = dict.fromkeys(info.instances, UNLABELLED)
    found |= {id: category for id, category in info.class_of.items() if category > 0}
    if not found:
        raise InputError(
            "instances: expected a layer whose info tells the class of each instance, "
            "as associate writes it, or a layer of classes beside it."
        )
    return found


@boundary
def evaluate_points(
    field: Renderable,
    layer: str,
    *,
    points: Float[Tensor, "p 3"],
    truth: Int[Tensor, "p"],
    matched: bool = False,
) -> PointReport:
    """Score the labels that a layer gives to labelled points of the scene.

    Args:
        field: What is scored; it knows how points take labels.
        layer: Name of the layer.
        points: Positions in the world, scene units.
        truth: Their true ids, -1 void.
        matched: Ids of the layer are instances that mean something else than the truth's.

    Raises:
        ShapeError: If there is not one true id a point.
        InputError: If all points are void.
    """
    check_shape("truth", truth, (len(points),))
    ids = field.labels_at(points, layer).ids
    return PointReport(
        semantic=None if matched else semantic_score(Confusion.of(ids, truth)),
        instances=instance_score(Overlaps.of(ids, truth)) if matched else None,
        points=int((truth >= 0).sum()),
        unlabelled=float((ids[truth >= 0] < 0).double().mean()),
    )
