"""The report of a segmentation: what was seen, what became of it, and what it rests on."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from pathlib import Path
from typing import Any

from splatseg.core import (
    ClassTable,
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
from splatseg.io.json_files import write_json
from splatseg.methods import keeps_ids
from splatseg.report._common import environment, spread
from splatseg.report._object_facts import ObjectFacts, object_facts, with_sightings
from splatseg.report._segment_ids import ids_agree, ids_are_classes
from splatseg.report._segment_page import SegmentationReportData, segmentation_page
from splatseg.report._segment_panels import ViewPanel, rename_truth, view_panel
from splatseg.report._segment_record import segmentation_record
from splatseg.report.html import report_html
from splatseg.report.layer_colours import layer_colours
from splatseg.report.object_gallery import MAX_OBJECTS, MAX_VIEWS, sightings
from splatseg.report.tree_section import tree_section

_LEARNED_ROWS = 4
_HELD_OUT_ROWS = 3
_TREE_ROWS = 3
_COMPARED = 12
_COVERAGE_VIEWS = 100
_LARGEST = 9_000_000
"""Bytes of the page above which its pictures are made smaller."""

_IMAGE_SIZES = (640, 448, 320, 224, 128)
"""Longest sides of the pictures, pixels, the one to prefer first."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SegmentationRun:
    """How the layer of a report was made, for its reader. Everything may be left out."""

    timings: Mapping[str, float] = dataclass_field(default_factory=dict[str, float])
    """Seconds by step."""

    peak_bytes: int | None = None
    """Largest resident memory of the process."""

    command: str = ""
    """The words that started it."""

    files: Mapping[int, str] = dataclass_field(default_factory=dict[int, str])
    """Where objects were exported to, by id."""

    warnings: tuple[str, ...] = ()
    """What a reader should know before all else, in sentences."""

    backend: str = "auto"
    """Who renders, said in the page and asked what views show of Gaussians."""


def write_segmentation_report(
    scene: Scene,
    path: Path,
    *,
    field: Renderable,
    layer: str,
    evidence: LabelSource | None,
    views: Sequence[View],
    truth: LabelSource | None = None,
    labels: Labels | None = None,
    tree: InstanceTree | None = None,
    run: SegmentationRun | None = None,
) -> None:
    """Write the report of a segmentation as one HTML file, and beside it as JSON; both atomic.

    A few of the views are shown, spread over all of them, and a few held-out ones; coverage is
    measured in at most 100, and objects are looked for in at most 60. At most 1000 objects are
    shown, the JSON has all. The page stays below 10 MB.

    Args:
        scene: The scene.
        path: The file to write. Its folder must exist.
        field: What is rendered: its Gaussians, or another field of the same views.
        layer: Name of the field's layer.
        evidence: What it was made from; None leaves that out.
        views: Those it was made from.
        truth: True maps of any views, of classes or of instances; ids that do not mean the same
            as the layer's are matched.
        labels: The labels of Gaussians of the scene, of which tables tell; None leaves these out,
            where the layer is not one of Gaussians.
        tree: The layer with all its levels, where it has levels; `labels` is a cut of it.
        run: How it was made.

    Raises:
        MissingFileError: If the folder, or a photograph that is shown, is not there.
        ShapeError: If a truth does not have its photograph's proportions.
    """
    data = _gathered(
        scene, field, layer, views,
        evidence=evidence, truth=truth, labels=labels, tree=tree, run=run or SegmentationRun(),
    )  # fmt: skip
    page = _small_page(data)
    with atomic_file(path) as temporary:
        temporary.write_text(page, encoding="utf-8", newline="\n")
    write_json(segmentation_record(data), path.with_suffix(".json"))


def _gathered(
    scene: Scene,
    field: Renderable,
    layer: str,
    views: Sequence[View],
    *,
    evidence: LabelSource | None,
    truth: LabelSource | None,
    labels: Labels | None,
    tree: InstanceTree | None,
    run: SegmentationRun,
) -> SegmentationReportData:
    """Everything that the page and its JSON tell."""
    summary = field.layer(layer)
    same = evidence is not None and ids_agree(
        summary, evidence, otherwise=keeps_ids(summary.info.method or "uplift")
    )
    panels, further = _panels(
        scene, field, layer, views, evidence=evidence, truth=truth, same_ids=same
    )
    looked_at = () if labels is None else spread(views, _COVERAGE_VIEWS)
    truth_names, score, scored = _scores(summary, evidence, truth, panels)
    shown = [scene.view(panel.name) for panel in panels[:_TREE_ROWS]]
    known = scene.classes if summary.info.names or ids_are_classes(evidence) else None
    colours = layer_colours(summary, known, gaussians=scene.gaussians, labels=labels)
    return SegmentationReportData(
        layer=layer,
        summary=summary,
        labels=labels,
        classes=colours,
        panels=panels,
        compared=tuple(s for s in (*panels, *further) if s.agreement is not None),
        seen=views_that_show(scene.gaussians, looked_at, backend=run.backend),
        seen_of=len(looked_at),
        views=len(views),
        score=score,
        scored=scored,
        evidence_has_same_ids=same,
        truth_names=truth_names,
        timings=run.timings,
        peak_bytes=run.peak_bytes,
        command=run.command,
        warnings=run.warnings,
        objects=_objects(scene, field, layer, colours, labels=labels, files=run.files),
        looked_at=min(MAX_VIEWS, sum(map(_at_hand, scene.views))),
        tree=()
        if tree is None
        else tree_section(field, layer, tree, shown, gaussians=scene.gaussians),
        facts=_facts(summary, layer, run.backend),
    )


def _objects(
    scene: Scene,
    field: Renderable,
    layer: str,
    colours: ClassTable,
    *,
    labels: Labels | None,
    files: Mapping[int, str],
) -> tuple[ObjectFacts, ...]:
    """Each object with the picture of it, where it is among those that are shown."""
    views = [view for view in scene.views if _at_hand(view)]
    objects = object_facts(
        field.layer(layer), colours, labels=labels, classes=scene.classes, files=files
    )
    largest = {one.id: one.colour for one in objects[:MAX_OBJECTS]}
    return with_sightings(objects, sightings(field, layer, views, largest))


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
    words = f"{len(scored)} {kind.replace('view', 'views', 1) if len(scored) != 1 else kind}"
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
