"""The report of a segmentation: what was seen, what became of it, and what it rests on."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from splatseg.core import (
    UNLABELLED,
    ClassTable,
    InstanceTree,
    Labels,
    LabelSource,
    Renderable,
    RenderableLayer,
    Scene,
    View,
    layer_info_to_json,
)
from splatseg.evaluate.agreement import SEEN_LONGEST, views_that_show
from splatseg.evaluate.metrics import Confusion, SemanticScore, semantic_score
from splatseg.evaluate.overlaps import InstanceScore, Overlaps, instance_score
from splatseg.io.atomic import atomic_file
from splatseg.io.evidence import Evidence
from splatseg.io.json_files import write_json
from splatseg.methods import keeps_ids
from splatseg.report.colours import layer_colours
from splatseg.report.html import Block, Figure, Legend, Notice, Report, Table, report_html
from splatseg.report.images import ObjectGallery, Scale
from splatseg.report.objects import (
    MAX_OBJECTS,
    MAX_VIEWS,
    ObjectFacts,
    object_cards,
    object_facts,
    objects_record,
    sightings,
    with_sightings,
)
from splatseg.report.segment_tables import (
    association_tables,
    confidence_bars,
    conflict_tables,
    coverage_bars,
    difference_tables,
    fact_rows,
    id_table,
    instances_without_labels,
    support_table,
    training_blocks,
    visible_id_table,
)
from splatseg.report.segment_views import (
    ViewPanel,
    confidence_range,
    gallery,
    rename_truth,
    tree_section,
    view_panel,
)
from splatseg.report.words import count_text, counted, environment, spread

_LEARNED_ROWS = 4
_HELD_OUT_ROWS = 3
_TREE_ROWS = 3
_COMPARED = 12
_COVERAGE_VIEWS = 100
_LEGEND = 40
_LARGEST = 9_000_000
"""Bytes of the page above which its pictures are made smaller."""

_IMAGE_SIZES = (640, 448, 320, 224, 128)
"""Longest sides of the pictures, pixels, the one to prefer first."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SegmentationRun:
    """How the layer of a report was made, for its reader. Everything may be left out."""

    timings: Mapping[str, float] = field(default_factory=dict[str, float])
    """Seconds by step."""

    peak_bytes: int | None = None
    """Largest resident memory of the process."""

    command: str = ""
    """The words that started it."""

    files: Mapping[int, str] = field(default_factory=dict[int, str])
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
    run = run or SegmentationRun()
    summary = field.layer(layer)
    same_ids = evidence is not None and ids_agree(
        summary, evidence, otherwise=keeps_ids(summary.info.method or "uplift")
    )
    panels, further = _panels(
        scene, field, layer, views, evidence=evidence, truth=truth, same_ids=same_ids
    )
    looked_at = () if labels is None else spread(views, _COVERAGE_VIEWS)
    truth_names, score, scored = _scores(summary, evidence, truth, panels)
    known = scene.classes if summary.info.names or _are_classes(evidence) else None
    colours = layer_colours(summary, known, gaussians=scene.gaussians, labels=labels)
    shown = [scene.view(panel.name) for panel in panels[:_TREE_ROWS]]
    at_hand = [view for view in scene.views if _at_hand(view)]
    objects = object_facts(summary, colours, labels=labels, classes=scene.classes, files=run.files)
    largest = {one.id: one.colour for one in objects[:MAX_OBJECTS]}
    made = _Segmentation(
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
        same_ids=same_ids,
        truth_names=truth_names,
        objects=with_sightings(objects, sightings(field, layer, at_hand, largest)),
        looked_at=min(MAX_VIEWS, len(at_hand)),
        tree=()
        if tree is None
        else tree_section(field, layer, tree, shown, gaussians=scene.gaussians),
        run=run,
    )
    page = _small_page(made)
    with atomic_file(path) as temporary:
        temporary.write_text(page, encoding="utf-8", newline="\n")
    write_json(_record(made), path.with_suffix(".json"))


def ids_agree(layer: RenderableLayer, source: LabelSource, *, otherwise: bool) -> bool:
    """Whether ids of a layer mean what a source of maps means by them.

    They do where every name that the layer has is the source's name of the same id. Where one
    of them has no names, `otherwise` says.
    """
    named = layer.info.names
    table = source.classes if isinstance(source, Evidence) else None
    if table is None or not table.rows or not named:
        return otherwise
    present = set(layer.ids)
    theirs = {row.id: row.name for row in table.rows}
    return all(theirs.get(id) == name for id, name in named.items() if id in present)


def _are_classes(evidence: LabelSource | None) -> bool:
    """Whether a layer made of this evidence has class ids, as far as the evidence tells."""
    return not isinstance(evidence, Evidence) or evidence.kind == "labels"


def _at_hand(view: View) -> bool:
    """Whether a view can be shown: it has no photograph, or one that is there."""
    return view.image is None or view.image.is_file()


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

    def panels(
        views: Sequence[View], count: int, truth: LabelSource | None, *, held_out: bool = False
    ) -> tuple[ViewPanel, ...]:
        return tuple(
            view_panel(
                field, layer, view,
                held_out=held_out, evidence=evidence, truth=truth, same_ids=same_ids,
            )
            for view in spread(views, count)
        )  # fmt: skip

    learned = [view for view in views if _at_hand(view)]
    names = {view.name for view in views}
    others = [v for v in scene.test_views if v.name not in names and _at_hand(v)]
    if truth is not None:
        true = set(truth.view_names)
        others = [view for view in others if view.name in true] or others
    shown = panels(learned, _LEARNED_ROWS, truth)
    shown += panels(others, _HELD_OUT_ROWS, truth, held_out=True)
    already = {one.name for one in shown}
    known = set(evidence.view_names) if evidence is not None else set[str]()
    more = [view for view in learned if view.name in known and view.name not in already]
    return shown, panels(more, max(0, _COMPARED - len(shown)), None)


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
    pairs = [(panel.drawn, panel.truth) for panel in scored if panel.truth is not None]
    otherwise = _are_classes(evidence) and keeps_ids(layer.info.method or "uplift")
    if ids_agree(layer, truth, otherwise=otherwise):
        pooled = sum((Confusion.of(*pair) for pair in pairs), Confusion.none())
        return None, semantic_score(pooled), words
    total = sum((Overlaps.of(*pair) for pair in pairs), Overlaps.none())
    return rename_truth(with_truth), instance_score(total), words


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Segmentation:
    """Everything that the page and its JSON tell."""

    layer: str
    summary: RenderableLayer
    labels: Labels | None
    """Of Gaussians; None where the layer is not of Gaussians."""

    classes: ClassTable
    """Names and colours of the ids in use."""

    panels: tuple[ViewPanel, ...]
    compared: tuple[ViewPanel, ...]
    """Views whose evidence was compared with the layer."""

    seen: Int[Tensor, "n"]
    """In how many views each Gaussian is seen, of `seen_of`."""

    seen_of: int
    views: int
    """Views that the layer was made from."""

    score: SemanticScore | InstanceScore | None
    """Of the views shown that have a truth, the held-out ones where there are some."""

    scored: str
    """What was scored, in words: ``3 held-out views``."""

    same_ids: bool
    """Whether ids of the evidence mean what those of the layer mean."""

    truth_names: dict[int, int] | None
    """Ids of the layer by true id, where they differ."""

    objects: tuple[ObjectFacts, ...]
    looked_at: int
    """Views that objects were looked for in."""

    tree: tuple[Block, ...]
    run: SegmentationRun

    @property
    def facts(self) -> dict[str, Any]:
        """How the layer was made."""
        made = self.summary.info
        facts = {
            "layer": self.layer,
            "method": made.method,
            "evidence": made.evidence,
            "views asked for": made.views_asked,
            "seed": made.seed,
            "backend": self.run.backend,
            "coverage": f"in pictures of at most {SEEN_LONGEST} pixels",
        }
        return {name: value for name, value in facts.items() if value is not None} | environment()


def _small_page(made: _Segmentation) -> str:
    """The page with the largest pictures that leave it small enough, else with the smallest."""
    pages = (report_html(_page(made, longest=size)) for size in _IMAGE_SIZES)
    page = next(pages)
    for smaller in pages:
        if len(page.encode()) <= _LARGEST:
            break
        page = smaller
    return page


def _page(made: _Segmentation, *, longest: int) -> Report:
    labels = made.labels
    blocks: list[Block] = []
    if made.panels:
        shown = gallery(
            made.panels,
            made.classes,
            truth_names=made.truth_names,
            evidence_has_same_ids=made.same_ids,
            longest=longest,
        )
        blocks += [shown, _scale(*confidence_range(made.panels)), _legend(made)]
    blocks += [_objects(made), *made.tree]
    if labels is not None:
        blocks += [support_table(labels), confidence_bars(labels)]
    if made.seen_of:
        blocks.append(coverage_bars(made.seen, views=made.seen_of))
    if labels is not None:
        blocks += conflict_tables(labels, made.classes)
    blocks += difference_tables(made.compared)
    blocks += association_tables(made.summary.info)
    blocks += training_blocks(made.summary.info)
    scores = made.score.per_class if isinstance(made.score, SemanticScore) else {}
    blocks.append(
        visible_id_table(made.panels, made.classes, scores=scores, scored=made.scored)
        if labels is None
        else id_table(labels, made.classes, scores=scores, scored=made.scored)
    )
    blocks += _cost(made)
    return Report(
        title=f"Segmentation {made.layer}",
        summary=_summary(made),
        command=made.run.command,
        notices=tuple(Notice("Take care", words, warns=True) for words in made.run.warnings),
        figures=tuple(_figures(made)),
        blocks=tuple(blocks),
        facts=made.facts,
    )


def _summary(made: _Segmentation) -> str:
    method = made.summary.info.method or "an unknown method"
    carriers = "" if made.labels is None else f" on {counted(len(made.labels), 'Gaussian')}"
    sentences = [
        f"{counted(len(made.classes.rows), 'label')}{carriers}, by {method} from "
        f"{counted(made.views, 'view')}.",
        *instances_without_labels(made.summary),
        f"Scores are of {made.scored}." if made.scored else "There is no truth to score.",
    ]
    return " ".join(sentences)


def _scale(low: float, high: float) -> Scale:
    return Scale(
        "Confidence",
        f"{low:.2f} or less" if low > 0 else "0",
        f"{high:.2f} or more" if high < 1 else "1",
        "Confidence is the share of the votes that speak for a label; nothing is there where "
        "it is nearly black.",
    )


def _legend(made: _Segmentation) -> Legend:
    """The labels that are seen most in the pictures."""
    drawn = torch.cat([panel.drawn.reshape(-1) for panel in made.panels])
    ids, counts = torch.unique(drawn[drawn != UNLABELLED], return_counts=True)
    order = torch.argsort(counts, descending=True, stable=True).tolist()
    rows = {row.id: row for row in made.classes.rows}
    kept = [rows[id] for i in order[:_LEGEND] if (id := int(ids[i])) in rows]
    more = f", the {len(kept)} seen most of {len(ids)}" if len(ids) > len(kept) else ""
    title = f"Colours of the labels{more}"
    return Legend(ClassTable(rows=tuple(kept)), title=title, with_ids=True)


def _objects(made: _Segmentation) -> ObjectGallery:
    """The largest objects, each from the view that shows it best."""
    kept = made.objects[:MAX_OBJECTS]
    more = len(made.objects) - len(kept)
    notes = [f"The {len(kept)} largest; {more} more are in the JSON file."] if more else []
    notes.append(
        f"Each from the one of {counted(made.looked_at, 'view')} that shows most of it; what is "
        "not it is grey."
    )
    folders = sorted({one.file.rpartition("/")[0] for one in kept if one.file})
    notes += [f"Files are in {folder}, in the scene's folder." for folder in folders]
    if not folders:
        notes.append("segment --export writes each into a file of its own.")
    return ObjectGallery("Objects", object_cards(kept), " ".join(notes))


def _figures(made: _Segmentation) -> list[Figure]:
    figures = [Figure("Labels", str(len(made.classes.rows)), "ids in use")]
    if made.labels is not None:
        labelled = made.labels.ids != UNLABELLED
        share = float(labelled.double().mean()) if len(labelled) else 0.0
        of = f"{count_text(int(labelled.sum()))} of {count_text(len(labelled))}"
        figures.insert(0, Figure("Gaussians with a label", f"{share:.1%}", of))
        if bool(labelled.any()):
            mean = float(made.labels.confidence[labelled].double().mean())
            figures.append(Figure("Confidence", f"{mean:.3f}", "mean of those with a label"))
    found = [panel.agreement for panel in made.compared if panel.agreement is not None]
    if found:
        differ = sum(one.pixels * one.differ for one in found)
        value = f"{differ / max(sum(one.pixels for one in found), 1):.1%}"
        note = f"of the pixels of {counted(len(found), 'view')}"
        figures.append(Figure("Evidence that differs from the layer", value, note))
    if isinstance(made.score, SemanticScore):
        figures.append(Figure("mIoU", f"{made.score.miou:.3f}", f"pooled, {made.scored}"))
    elif made.score is not None:
        note = f"matched one to one, {made.scored}"
        figures.append(Figure("mIoU of instances", f"{made.score.miou:.3f}", note))
    return figures


def _cost(made: _Segmentation) -> list[Table]:
    run = made.run
    rows = [(step, f"{seconds:.1f} s") for step, seconds in run.timings.items()]
    if len(rows) > 1:
        rows.append(("together", f"{sum(run.timings.values()):.1f} s"))
    if run.peak_bytes is not None:
        rows.append(("largest memory", f"{run.peak_bytes / 2**30:.2f} GiB resident"))
    options = tuple(fact_rows(made.summary.info.options))
    tables = (
        Table("What it cost", ("what", "value"), tuple(rows)),
        Table("Options of the method", ("option", "value"), options),
    )
    return [table for table in tables if table.rows]


def _record(made: _Segmentation) -> dict[str, Any]:
    """What the page tells, for programs: NAME.json beside NAME.html."""
    labels = made.labels
    inferred = None if labels is None else labels.inferred
    return {
        "made_by": "splatseg segment",
        "command": made.run.command,
        "layer": made.layer,
        "warnings": list(made.run.warnings),
        "views": made.views,
        "labels": len(made.classes.rows),
        "gaussians": None if labels is None else len(labels),
        "labelled": None if labels is None else int((labels.ids != UNLABELLED).sum()),
        "inferred": None if inferred is None else int(inferred.sum()),
        "scored": made.scored or None,
        "score": _score_record(made.score),
        "evidence_that_differs": [
            {"view": panel.name, **asdict(panel.agreement)}
            for panel in made.compared
            if panel.agreement is not None
        ],
        "objects": objects_record(made.objects),
        "seconds": {name: round(spent, 3) for name, spent in made.run.timings.items()},
        "peak_bytes": made.run.peak_bytes,
        "made": layer_info_to_json(made.summary.info),
        **made.facts,
    }


def _score_record(score: SemanticScore | InstanceScore | None) -> dict[str, Any] | None:
    if score is None:
        return None
    if isinstance(score, SemanticScore):
        per_class = {str(id): value for id, value in score.per_class.items()}
        return {"mIoU": score.miou, "accuracy": score.accuracy, "per_class": per_class}
    return {
        "mIoU_of_instances": score.miou,
        "recall50": score.recall50,
        "precision50": score.precision50,
        "truth_instances": score.truth_instances,
        "predicted_instances": score.predicted_instances,
    }
