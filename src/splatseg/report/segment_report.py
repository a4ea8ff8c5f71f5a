"""The report of a segmentation: what was seen, what became of it, and what it rests on."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from splatseg.core import (
    InstanceTree,
    Labels,
    LabelSource,
    Renderable,
    RenderableLayer,
    Scene,
    View,
)
from splatseg.evaluate.agreement import SEEN_LONGEST, views_that_show
from splatseg.evaluate.metrics import Confusion, SemanticScore, semantic_score
from splatseg.evaluate.overlaps import InstanceScore, Overlaps, instance_score
from splatseg.io.atomic import atomic_file
from splatseg.methods import keeps_ids
from splatseg.report._common import environment, spread
from splatseg.report._segment_ids import class_table, ids_agree, ids_are_classes
from splatseg.report._segment_page import SegmentationReportData, segmentation_page
from splatseg.report._segment_panels import ViewPanel, rename_truth, view_panel
from splatseg.report.html import report_html
from splatseg.report.tree_section import tree_section

_LEARNED_ROWS = 4
_HELD_OUT_ROWS = 3
_TREE_ROWS = 3
_COMPARED = 12
_COVERAGE_VIEWS = 100
_LARGEST = 4_500_000
"""Bytes of the page above which its pictures are made smaller."""

_IMAGE_SIZES = (448, 320, 224, 128)
"""Longest sides of the pictures, pixels, the one to prefer first."""


def write_segmentation_report(
    scene: Scene,
    path: Path,
    *,
    field: Renderable,
    layer: str,
    evidence: LabelSource | None,
    views: Sequence[View],
    truth: LabelSource | None = None,
    timings: Mapping[str, float],
    peak_bytes: int | None,
    command: str,
    labels: Labels | None = None,
    tree: InstanceTree | None = None,
    backend: str = "auto",
) -> None:
    """Write the report of a segmentation as one HTML file; atomic.

    A few of the views are shown, spread over all of them, and a few held-out ones; coverage is
    measured in at most 100. The file stays below 5 MB.

    Args:
        scene: The scene.
        path: The file to write. Its folder must exist.
        field: What is rendered: its Gaussians, or another field of the same views.
        layer: Name of the field's layer.
        evidence: What it was made from; None leaves that out.
        views: Those it was made from.
        truth: True maps of any views, of classes or of instances; ids that do not mean the same
            as the layer's are matched.
        timings: Seconds by step.
        peak_bytes: Largest resident memory of the process; None leaves it out.
        command: The words that started it; may be empty.
        labels: The labels of Gaussians of the scene, of which tables tell; None leaves these out,
            where the layer is not one of Gaussians.
        tree: The layer with all its levels, where it has levels; `labels` is a cut of it.
        backend: Who renders, said in the page and asked what views show of Gaussians.

    Raises:
        MissingFileError: If the folder, or a photograph that is shown, is not there.
        ShapeError: If a truth does not have its photograph's proportions.
    """
    summary = field.layer(layer)
    same = evidence is not None and ids_agree(
        summary, evidence, otherwise=keeps_ids(summary.info.method or "uplift")
    )
    panels, further = _panels(
        scene, field, layer, views, evidence=evidence, truth=truth, same_ids=same
    )
    looked_at = () if labels is None else spread(views, _COVERAGE_VIEWS)
    seen = views_that_show(scene.gaussians, looked_at, backend=backend)
    truth_names, score, scored = _scores(summary, evidence, truth, panels)
    shown = [scene.view(panel.name) for panel in panels[:_TREE_ROWS]]
    data = SegmentationReportData(
        layer=layer,
        summary=summary,
        labels=labels,
        classes=class_table(summary, scene.classes, unnamed_are_classes=ids_are_classes(evidence)),
        panels=panels,
        compared=tuple(s for s in (*panels, *further) if s.agreement is not None),
        seen=seen,
        seen_of=len(looked_at),
        views=len(views),
        score=score,
        scored=scored,
        evidence_has_same_ids=same,
        truth_names=truth_names,
        timings=timings,
        peak_bytes=peak_bytes,
        command=command,
        tree=() if tree is None else tree_section(field, layer, tree, shown),
        facts=_facts(summary, layer, backend),
    )
    page = _small_page(data)
    with atomic_file(path) as temporary:
        temporary.write_text(page, encoding="utf-8", newline="\n")


def _panels(
    scene: Scene,
    field: Renderable,
    layer: str,
    views: Sequence[View],
    *,
    evidence: LabelSource | None,
    truth: LabelSource | None,
    same_ids: bool,
) -> tuple[tuple[ViewPanel, ...], tuple[ViewPanel, ...]]:
    """Views to show, and further ones whose evidence is only compared with the layer."""

    def panel(view: View, *, held_out: bool, truth: LabelSource | None) -> ViewPanel:
        return view_panel(
            field,
            layer,
            view,
            held_out=held_out,
            evidence=evidence,
            truth=truth,
            same_ids=same_ids,
        )

    learned = [view for view in views if _at_hand(view)]
    names = {view.name for view in views}
    others = [v for v in scene.test_views if v.name not in names and _at_hand(v)]
    if truth is not None:
        true = set(truth.view_names)
        others = [view for view in others if view.name in true] or others
    shown = [panel(v, held_out=False, truth=truth) for v in spread(learned, _LEARNED_ROWS)]
    shown += [panel(v, held_out=True, truth=truth) for v in spread(others, _HELD_OUT_ROWS)]
    already = {one.name for one in shown}
    known = set(evidence.view_names) if evidence is not None else set[str]()
    more = [view for view in learned if view.name in known and view.name not in already]
    further = [
        panel(view, held_out=False, truth=None)
        for view in spread(more, max(0, _COMPARED - len(shown)))
    ]
    return tuple(shown), tuple(further)


def _small_page(data: SegmentationReportData) -> str:
    """The page with the largest pictures that leave it small enough, else with the smallest."""
    pages = (report_html(segmentation_page(data, longest=size)) for size in _IMAGE_SIZES)
    page = next(pages)
    for smaller in pages:
        if len(page.encode()) <= _LARGEST:
            break
        page = smaller
    return page


def _scores(
    layer: RenderableLayer,
    evidence: LabelSource | None,
    truth: LabelSource | None,
    panels: Sequence[ViewPanel],
) -> tuple[dict[int, int] | None, SemanticScore | InstanceScore | None, str]:
    """Names of true ids, the score of the views shown, and words for what was scored."""
    with_truth = [s for s in panels if s.truth is not None and bool((s.truth >= 0).any())]
    if truth is None or not with_truth:
        return None, None, ""
    held_out = [panel for panel in with_truth if panel.held_out]
    scored = held_out or with_truth
    kind = "held-out view" if held_out else "view that the layer was made from"
    words = f"{len(scored)} {kind.replace('view', 'views', 1) if len(scored) > 1 else kind}"
    otherwise = ids_are_classes(evidence) and keeps_ids(layer.info.method or "uplift")
    if ids_agree(layer, truth, otherwise=otherwise):
        pooled = Confusion.none()
        for panel in scored:
            if panel.truth is not None:
                pooled = pooled + Confusion.of(panel.drawn, panel.truth)
        return None, semantic_score(pooled), words
    total = Overlaps.none()
    for panel in scored:
        if panel.truth is not None:
            total = total + Overlaps.of(panel.drawn, panel.truth)
    return rename_truth(with_truth), instance_score(total), words


def _facts(summary: RenderableLayer, layer: str, backend: str) -> dict[str, Any]:
    made = summary.info
    facts = {
        "layer": layer,
        "method": made.method,
        "evidence": made.evidence,
        "views asked for": made.views_asked,
        "seed": made.seed,
        "backend": backend,
        "coverage": f"in pictures of at most {SEEN_LONGEST} pixels",
    }
    return {name: value for name, value in facts.items() if value is not None} | environment()


def _at_hand(view: View) -> bool:
    """Whether a view can be shown: it has no photograph, or one that is there."""
    return view.image is None or view.image.is_file()
