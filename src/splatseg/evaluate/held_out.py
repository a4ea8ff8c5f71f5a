"""A scene held against truth: its layers drawn in views and scored there.

Predictions are drawn in the pixels of the truth, so nothing that is scored was resized. A layer
that learned from a view it is scored on is said to, in the report's `learned_from`.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch

from splatseg.core import (
    UNLABELLED,
    Gaussians,
    LabelMap,
    Labels,
    LabelSource,
    Selection,
    View,
    camera_of_map,
)
from splatseg.errors import InputError
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
from splatseg.lift import label_map
from splatseg.render import RenderOptions

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


@dataclass(frozen=True, slots=True, kw_only=True)
class BinaryReport(ViewsReport):
    """Scores of one object, or of a selection."""

    score: BinaryScore
    boundary_mean: float
    """Mean over views of boundary IoU; a view where both masks are empty counts 1."""

    boundary_pooled: float
    """Boundary IoU of all views' pixels together; 0 where there are none."""


def evaluate_semantic(
    gaussians: Gaussians,
    views: Sequence[View],
    labels: Labels,
    truth: LabelSource,
    *,
    options: RenderOptions | None = None,
    backend: str = "auto",
    progress: Progress | None = None,
) -> SemanticReport:
    """Score the classes of a layer in the views that have a truth.

    Args:
        gaussians: The Gaussians of the scene.
        views: Where to look; those without a truth are left out.
        labels: The layer.
        truth: Label maps by view name; -1 is void.
        options: Switches of the blending model.
        backend: Name of the rendering backend.
        progress: Called with the views done and their number.

    Raises:
        InputError: If no view has a truth.
        ShapeError: If a truth does not have its photograph's proportions.
    """
    scored = with_truth(views, truth)
    confusions: list[Confusion] = []
    outlines = BoundaryCounts.none()
    for drawn, true in drawn_and_true(
        gaussians, scored, labels, truth, options=options, backend=backend, progress=progress
    ):
        confusions.append(Confusion.of(drawn.ids, true.ids))
        outlines = outlines + BoundaryCounts.of(drawn.ids, true.ids)
    return SemanticReport(
        score=semantic_score(sum(confusions, start=Confusion.none())),
        per_image_miou=per_image_miou(confusions),
        boundary=boundary_score(outlines),
        views=tuple(view.name for view in scored),
        learned_from=learned_from(labels, scored),
    )


def evaluate_binary(
    gaussians: Gaussians,
    views: Sequence[View],
    layer: Labels | Selection,
    truth: LabelSource,
    *,
    id: int | None = None,
    options: RenderOptions | None = None,
    backend: str = "auto",
    progress: Progress | None = None,
) -> BinaryReport:
    """Score a selection, or one id of a layer, as a mask in the views that have a truth.

    Args:
        gaussians: The Gaussians of the scene.
        views: Where to look; those without a truth are left out.
        layer: A selection, or labels.
        truth: Label maps by view name.
        id: The id to score, of the truth and of a layer of labels; None takes every labelled
            pixel.
        options: Switches of the blending model.
        backend: Name of the rendering backend.
        progress: Called with the views done and their number.

    Raises:
        InputError: If no view has a truth.
        ShapeError: If a truth does not have its photograph's proportions.
    """
    scored = with_truth(views, truth)
    labels = layer if isinstance(layer, Labels) else labels_of(layer)
    wanted = id if isinstance(layer, Labels) else None
    outlines: list[tuple[int, int]] = []

    def pairs() -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        for drawn, true in drawn_and_true(
            gaussians, scored, labels, truth, options=options, backend=backend, progress=progress
        ):
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
        learned_from=learned_from(layer, scored),
    )


def labels_of(selection: Selection) -> Labels:
    """A selection as labels, 1 inside and none outside, to be drawn as a mask."""
    ids = torch.where(selection.mask, 1, UNLABELLED)
    return Labels(ids=ids, confidence=selection.mask.float(), info=selection.info)


def drawn_and_true(
    gaussians: Gaussians,
    views: Sequence[View],
    labels: Labels,
    truth: LabelSource,
    *,
    options: RenderOptions | None = None,
    backend: str = "auto",
    progress: Progress | None = None,
) -> Iterator[tuple[LabelMap, LabelMap]]:
    """A layer drawn in each view, and the truth there, one view at a time.

    Arguments are those of `evaluate_semantic`; all views must have a truth.
    """
    for done, view in enumerate(views, start=1):
        true = truth.label_map(view.name)
        yield drawn_like(gaussians, view, labels, true, options=options, backend=backend), true
        if progress is not None:
            progress(done, len(views))


def drawn_like(
    gaussians: Gaussians,
    view: View,
    labels: Labels,
    truth: LabelMap,
    *,
    options: RenderOptions | None = None,
    backend: str = "auto",
) -> LabelMap:
    """A layer drawn in a view, in the pixels of its truth.

    Raises:
        ShapeError: If the truth does not have the photograph's proportions.
    """
    camera = camera_of_map(view, truth.height, truth.width)
    return label_map(gaussians, camera, labels, options=options, backend=backend)


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


def learned_from(layer: Labels | Selection, views: Sequence[View]) -> tuple[str, ...]:
    """Names of those views that a layer says it was made from."""
    known = set(layer.info.views or ())
    return tuple(view.name for view in views if view.name in known)
