"""A field held against truth: its layers rendered in views and scored there.

A field is any `splatseg.core.Renderable`, such as a `splatseg.lift.GaussianField`. Predictions are
rendered in the pixels of the truth, so nothing that is scored was resized. A layer that learned
from a view it is scored on is said to, in the report's `learned_from`.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch

from splatseg.core import (
    UNLABELLED,
    Camera,
    LabelMap,
    LabelSource,
    Renderable,
    RenderableLayer,
    RenderableView,
    View,
    camera_of_map,
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
