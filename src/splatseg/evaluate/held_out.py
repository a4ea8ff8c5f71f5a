"""A field held against truth: its layers rendered in views and scored there.

A field is any `splatseg.core.Renderable`, such as a `splatseg.lift.GaussianField`. Predictions are
rendered in the pixels of the truth, so nothing that is scored was resized. A layer that learned
from a view it is scored on is said to, in the report's `learned_from`.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg._check import check_shape
from splatseg.core import (
    UNLABELLED,
    Camera,
    ClassTable,
    LabelMap,
    LabelSource,
    Renderable,
    RenderableLayer,
    RenderableView,
    View,
    camera_of_map,
    map_ids,
)
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, ShapeError
from splatseg.evaluate.boundary import (
    BoundaryCounts,
    BoundaryScore,
    boundary_overlap,
    boundary_score,
)
from splatseg.evaluate.metrics import (
    BinaryScore,
    Confusion,
    SemanticScore,
    binary_score,
    per_image_miou,
    semantic_score,
)
from splatseg.evaluate.overlaps import InstanceScore, Overlaps, instance_score
from splatseg.evaluate.panoptic import (
    Detections,
    PanopticCounts,
    PanopticScore,
    PrecisionScore,
    VoidRule,
    average_precision,
    image_panoptic_score,
    panoptic_score,
    segment_keys,
)

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewsReport:
    """What reports of layers in views have in common."""

    views: tuple[str, ...]
    """Views that were scored."""

    learned_from: tuple[str, ...]
    """Those of them that the layer was made from."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SemanticReport(ViewsReport):
    """Scores of a layer's classes."""

    score: SemanticScore
    """Pooled over all views."""

    per_image_miou: float
    """Mean over views of each view's own mean IoU."""

    boundary: BoundaryScore
    """Boundary IoU, pooled over all views."""

    confusion: Confusion
    """Pixels of all views by true class and class of the layer."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BinaryReport(ViewsReport):
    """Scores of one object, or of a selection."""

    score: BinaryScore
    boundary_mean: float
    """Mean over views of boundary IoU; a view where both masks are empty counts 1."""

    boundary_pooled: float
    """Boundary IoU of all views' pixels together; 0 where there are none."""


@boundary
def evaluate_semantic(
    field: Renderable,
    views: Sequence[View],
    layer: str,
    truth: LabelSource,
    *,
    progress: Progress | None = None,
) -> SemanticReport:
    """Score the classes of a layer in the views that have a truth.

    Args:
        field: What is scored.
        views: Where to look; those without a truth are left out.
        layer: Name of the layer of the field.
        truth: Label maps by view name; -1 is void.
        progress: Called with the views done and their number.

    Raises:
        InputError: If no view has a truth.
        ShapeError: If a truth does not have its photograph's proportions.
    """
    scored = with_truth(views, truth)
    confusions: list[Confusion] = []
    outlines = BoundaryCounts.none()
    for drawn, true in drawn_and_true(field, scored, layer, truth, progress=progress):
        confusions.append(Confusion.of(drawn.ids, true.ids))
        outlines = outlines + BoundaryCounts.of(drawn.ids, true.ids)
    pooled = sum(confusions, start=Confusion.none())
    return SemanticReport(
        score=semantic_score(pooled),
        confusion=pooled,
        per_image_miou=per_image_miou(confusions),
        boundary=boundary_score(outlines),
        views=tuple(view.name for view in scored),
        learned_from=learned_from(field.layer(layer), scored),
    )


@boundary
def evaluate_binary(
    field: Renderable,
    views: Sequence[View],
    layer: str,
    truth: LabelSource,
    *,
    id: int | None = None,
    progress: Progress | None = None,
) -> BinaryReport:
    """Score a selection, or one id of a layer, as a mask in the views that have a truth.

    Args:
        field: What is scored.
        views: Where to look; those without a truth are left out.
        layer: Name of the layer of the field, a selection or labels.
        truth: Label maps by view name.
        id: The id to score, of the truth and of a layer of labels; None takes every labelled
            pixel.
        progress: Called with the views done and their number.

    Raises:
        InputError: If no view has a truth.
        ShapeError: If a truth does not have its photograph's proportions.
    """
    scored = with_truth(views, truth)
    summary = field.layer(layer)
    wanted = id if summary.kind == "labels" else None
    outlines: list[tuple[int, int]] = []

    def pairs() -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        for drawn, true in drawn_and_true(field, scored, layer, truth, progress=progress):
            masks = _mask(drawn, wanted), _mask(true, id)
            outlines.append(boundary_overlap(*masks))
            yield masks

    score = binary_score(pairs())
    both, either = (sum(counts) for counts in zip(*outlines, strict=True))
    return BinaryReport(
        score=score,
        boundary_mean=math.fsum(b / e if e else 1.0 for b, e in outlines) / len(outlines),
        boundary_pooled=both / max(either, 1),
        views=tuple(view.name for view in scored),
        learned_from=learned_from(summary, scored),
    )


def drawn_and_true(
    field: Renderable,
    views: Sequence[View],
    layer: str,
    truth: LabelSource,
    *,
    progress: Progress | None = None,
) -> Iterator[tuple[LabelMap, LabelMap]]:
    """A layer rendered in each view, and the truth there, one view at a time.

    Arguments are those of `evaluate_semantic`; all views must have a truth.
    """
    for done, view in enumerate(views, start=1):
        true = truth.label_map(view.name)
        (drawn,) = drawn_like(field, view, (layer,), true)
        yield drawn, true
        if progress is not None:
            progress(done, len(views))


def drawn_like(
    field: Renderable, view: View, layers: Sequence[str], truth: LabelMap
) -> tuple[LabelMap, ...]:
    """Layers rendered in a view, in the pixels of its truth.

    Raises:
        ShapeError: If the truth does not have the photograph's proportions, or what the field
            gives has not the truth's pixels.
    """
    camera = camera_of_map(view, truth.height, truth.width)
    with field.view(camera) as looked_at:
        return tuple(label_map_in(looked_at, layer, camera) for layer in layers)


def label_map_in(looked_at: RenderableView, layer: str, camera: Camera) -> LabelMap:
    """The label map of a view that a field opened for a camera.

    Raises:
        ShapeError: If it has not the camera's pixels: fields come from other packages too.
    """
    found = looked_at.label_map(layer)
    if tuple(found.ids.shape) != (camera.height, camera.width):
        raise ShapeError(
            f"field: expected a label map of {layer!r} of {camera.width}x{camera.height} pixels, "
            f"those of the camera, got {found.width}x{found.height}."
        )
    return found


def _mask(ids: LabelMap, id: int | None) -> torch.Tensor:
    return ids.ids != UNLABELLED if id is None else ids.ids == id


def with_truth(views: Sequence[View], truth: LabelSource) -> list[View]:
    """The views that have a truth.

    Raises:
        InputError: If none has.
    """
    known = set(truth.view_names)
    scored = [view for view in views if view.name in known]
    if not scored:
        raise InputError(f"truth: expected the truth of at least one of {len(views)} views.")
    return scored


def learned_from(layer: RenderableLayer, views: Sequence[View]) -> tuple[str, ...]:
    """Names of those views that a layer says it was made from."""
    known = set(layer.info.views or ())
    return tuple(view.name for view in views if view.name in known)


# Instances and panoptic labels. Counts are kept by pair of segments that overlap, so memory does
# not grow with the number of views.


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
