"""The report of a segmentation: what was seen, what became of it, and what it rests on."""

import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

import torch
from jaxtyping import Int
from torch import Tensor

from splatseg.core import (
    UNLABELLED,
    ClassTable,
    InstanceTree,
    Labels,
    LabelSource,
    Scene,
    View,
)
from splatseg.evaluate.agreement import SEEN_LONGEST, views_that_show
from splatseg.evaluate.metrics import Confusion, SemanticScore, semantic_score
from splatseg.evaluate.overlaps import InstanceScore, Overlaps, instance_score
from splatseg.io.atomic import atomic_file
from splatseg.methods import keeps_ids
from splatseg.report._segment_ids import class_table, ids_agree, ids_are_classes
from splatseg.report._segment_pictures import Sight, gallery, look, rename_truth
from splatseg.report._segment_tables import (
    association_tables,
    confidence_bars,
    conflict_tables,
    count_text,
    coverage_bars,
    fact_rows,
    id_table,
    support_table,
)
from splatseg.report.html import (
    Block,
    Commands,
    Figure,
    Legend,
    Report,
    Table,
    report_html,
)
from splatseg.report.tree_section import tree_section

_LEARNED_ROWS = 4
_HELD_OUT_ROWS = 3
_TREE_ROWS = 3
_COMPARED = 12
_COVERAGE_VIEWS = 100
_LEGEND = 40
_LARGEST = 4_500_000
"""Bytes of the page above which its pictures are made smaller."""

_PICTURE_SIZES = (448, 320, 224, 128)

# Methods whose layers keep the ids of the evidence.

_T = TypeVar("_T")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SegmentStory:
    """Everything that the report of a segmentation tells."""

    layer: str
    """Its name."""

    labels: Labels
    classes: ClassTable
    """Names and colours of the ids in use."""

    sights: tuple[Sight, ...]
    """Views that are shown."""

    compared: tuple[Sight, ...]
    """Views whose evidence was compared with the layer."""

    seen: Int[Tensor, "n"]
    """In how many views each Gaussian is seen."""

    seen_of: int
    """Views that were looked at for it."""

    views: int
    """Views that the layer was made from."""

    score: SemanticScore | InstanceScore | None = None
    """Of the views shown that have a truth, the held-out ones where there are some."""

    scored: str = ""
    """What was scored, in words: ``3 held-out views``."""

    evidence_has_same_ids: bool = True
    truth_names: dict[int, int] | None = None
    """Ids of the layer by true id, where they differ."""

    timings: Mapping[str, float] = field(default_factory=dict[str, float])
    """Seconds by step."""

    peak_bytes: int | None = None
    """Largest resident memory of the process."""

    command: str = ""
    tree: tuple[Block, ...] = ()
    """What there is to show of the levels above and below, see `tree_section`."""

    facts: Mapping[str, Any] = field(default_factory=dict[str, Any])


def segment_report(story: SegmentStory, *, longest: int = _PICTURE_SIZES[0]) -> Report:
    """The page.

    Args:
        story: The segmentation.
        longest: Longest side of the pictures, pixels.
    """
    labels = story.labels
    blocks: list[Block] = []
    if story.sights:
        blocks.append(
            gallery(
                story.sights,
                story.classes,
                truth_names=story.truth_names,
                evidence_has_same_ids=story.evidence_has_same_ids,
                longest=longest,
            )
        )
        blocks.append(_legend(story))
    blocks += story.tree
    blocks += [support_table(labels), confidence_bars(labels)]
    if story.seen_of:
        blocks.append(coverage_bars(story.seen, views=story.seen_of))
    blocks += conflict_tables(labels, story.compared, story.classes)
    blocks += association_tables(labels.metadata)
    scores = story.score.per_class if isinstance(story.score, SemanticScore) else {}
    blocks.append(id_table(labels, story.classes, scores=scores, scored=story.scored))
    blocks += _cost(story)
    if story.command:
        blocks.append(Commands(title="The same from the shell", lines=(story.command,)))
    method = labels.metadata.get("method", "unknown")
    return Report(
        title=f"Segmentation {story.layer}",
        summary=f"{len(story.classes.rows)} labels on {count_text(len(labels))} Gaussians, by "
        f"{method} from {story.views} views. "
        + (f"Scores are of {story.scored}." if story.scored else "There is no truth to score."),
        figures=_figures(story),
        blocks=tuple(blocks),
        facts=story.facts,
    )


def write_segmentation_report(
    path: Path,
    *,
    scene: Scene,
    labels: Labels,
    layer: str,
    evidence: LabelSource | None,
    views: Sequence[View],
    truth: LabelSource | None = None,
    timings: Mapping[str, float],
    peak_bytes: int | None,
    command: str,
    tree: InstanceTree | None = None,
    backend: str = "auto",
) -> None:
    """Write the report of a segmentation as one HTML file; atomic.

    A few of the views are shown, spread over all of them, and a few held-out ones; coverage is
    measured in at most 100. The file stays below 5 MB.

    Args:
        path: The file to write. Its folder must exist.
        scene: The scene.
        labels: The layer.
        layer: Its name.
        evidence: What it was made from; None leaves that out.
        views: Those it was made from.
        truth: True maps of any views, of classes or of instances; ids that do not mean the same
            as the layer's are matched.
        timings: Seconds by step.
        peak_bytes: Largest resident memory of the process; None leaves it out.
        command: The words that started it; may be empty.
        tree: The layer with all its levels, where it has levels; `labels` is a cut of it.
        backend: Who renders.

    Raises:
        MissingFileError: If the folder, or a photograph that is shown, is not there.
        ShapeError: If a truth does not have its photograph's proportions.
    """
    same = evidence is not None and ids_agree(
        labels, evidence, otherwise=keeps_ids(labels.metadata.get("method", "uplift"))
    )
    known = set(evidence.view_names) if evidence is not None else set[str]()
    learned = [view for view in views if _at_hand(view)]
    names = {view.name for view in views}
    others = [v for v in scene.test_views if v.name not in names and _at_hand(v)]
    if truth is not None:
        true = set(truth.view_names)
        others = [view for view in others if view.name in true] or others
    shown = [(v, False) for v in _spread(learned, _LEARNED_ROWS)]
    shown += [(v, True) for v in _spread(others, _HELD_OUT_ROWS)]
    sights = tuple(
        look(
            scene,
            labels,
            view,
            held_out=held_out,
            evidence=evidence,
            truth=truth,
            same_ids=same,
            backend=backend,
        )
        for view, held_out in shown
    )
    already = {sight.name for sight in sights}
    more = [view for view in learned if view.name in known and view.name not in already]
    further = tuple(
        look(
            scene,
            labels,
            view,
            held_out=False,
            evidence=evidence,
            truth=None,
            same_ids=same,
            backend=backend,
        )
        for view in _spread(more, max(0, _COMPARED - len(sights)))
    )
    looked_at = _spread(list(views), _COVERAGE_VIEWS)
    seen = views_that_show(scene.gaussians, looked_at, backend=backend)
    truth_names, score, scored = _scores(labels, evidence, truth, sights)
    story = SegmentStory(
        layer=layer,
        labels=labels,
        classes=class_table(labels, scene.classes, unnamed_are_classes=ids_are_classes(evidence)),
        sights=sights,
        compared=tuple(s for s in (*sights, *further) if s.agreement is not None),
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
        tree=()
        if tree is None
        else tree_section(scene, tree, [view for view, _ in shown[:_TREE_ROWS]], backend=backend),
        facts=_facts(labels, layer, backend),
    )
    pages = (report_html(segment_report(story, longest=longest)) for longest in _PICTURE_SIZES)
    page = next(pages)
    for smaller in pages:
        if len(page.encode()) <= _LARGEST:
            break
        page = smaller
    with atomic_file(path) as temporary:
        temporary.write_text(page, encoding="utf-8", newline="\n")


def _scores(
    labels: Labels,
    evidence: LabelSource | None,
    truth: LabelSource | None,
    sights: Sequence[Sight],
) -> tuple[dict[int, int] | None, SemanticScore | InstanceScore | None, str]:
    """Names of true ids, the score of the views shown, and words for what was scored."""
    with_truth = [s for s in sights if s.truth is not None and bool((s.truth >= 0).any())]
    if truth is None or not with_truth:
        return None, None, ""
    held_out = [sight for sight in with_truth if sight.held_out]
    scored = held_out or with_truth
    kind = "held-out view" if held_out else "view that the layer was made from"
    words = f"{len(scored)} {kind.replace('view', 'views', 1) if len(scored) > 1 else kind}"
    otherwise = ids_are_classes(evidence) and keeps_ids(labels.metadata.get("method", "uplift"))
    if ids_agree(labels, truth, otherwise=otherwise):
        pooled = Confusion.none()
        for sight in scored:
            if sight.truth is not None:
                pooled = pooled + Confusion.of(sight.drawn, sight.truth)
        return None, semantic_score(pooled), words
    total = Overlaps.none()
    for sight in scored:
        if sight.truth is not None:
            total = total + Overlaps.of(sight.drawn, sight.truth)
    return rename_truth(with_truth), instance_score(total), words


def _legend(story: SegmentStory) -> Legend:
    """The labels that are seen most in the pictures."""
    pixels: dict[int, int] = {}
    for sight in story.sights:
        ids, counts = torch.unique(sight.drawn, return_counts=True)
        for id, count in zip(ids.tolist(), counts.tolist(), strict=True):
            pixels[id] = pixels.get(id, 0) + count
    ids = sorted((id for id in pixels if id != UNLABELLED), key=lambda id: (-pixels[id], id))
    rows = {row.id: row for row in story.classes.rows}
    kept = [rows[id] for id in ids[:_LEGEND] if id in rows]
    more = f", the {len(kept)} seen most of {len(ids)}" if len(ids) > len(kept) else ""
    return Legend(classes=ClassTable(rows=tuple(kept)), title=f"Colours of the labels{more}")


def _figures(story: SegmentStory) -> tuple[Figure, ...]:
    labels, score = story.labels, story.score
    labelled = labels.ids != UNLABELLED
    share = float(labelled.double().mean()) if len(labels) else 0.0
    figures = [
        Figure(
            label="Gaussians with a label",
            value=f"{share:.1%}",
            note=f"{count_text(int(labelled.sum()))} of {count_text(len(labels))}",
        ),
        Figure(label="Labels", value=str(len(story.classes.rows)), note="ids in use"),
    ]
    if bool(labelled.any()):
        mean = float(labels.confidence[labelled].double().mean())
        figures.append(
            Figure(label="Confidence", value=f"{mean:.3f}", note="mean of those with a label")
        )
    if story.compared:
        pixels = sum(s.agreement.pixels for s in story.compared if s.agreement is not None)
        differ = sum(
            s.agreement.pixels * s.agreement.differ
            for s in story.compared
            if s.agreement is not None
        )
        figures.append(
            Figure(
                label="Evidence that differs from the layer",
                value=f"{differ / max(pixels, 1):.1%}",
                note=f"of the pixels of {len(story.compared)} views",
            )
        )
    if isinstance(score, SemanticScore):
        figures.append(
            Figure(label="mIoU", value=f"{score.miou:.3f}", note=f"pooled, {story.scored}")
        )
    elif score is not None:
        figures.append(
            Figure(
                label="mIoU of instances",
                value=f"{score.miou:.3f}",
                note=f"matched one to one, {story.scored}",
            )
        )
    return tuple(figures)


def _cost(story: SegmentStory) -> list[Table]:
    rows: list[tuple[str, str]] = [
        (step, f"{seconds:.1f} s") for step, seconds in story.timings.items()
    ]
    if len(story.timings) > 1:
        rows.append(("together", f"{sum(story.timings.values()):.1f} s"))
    if story.peak_bytes is not None:
        rows.append(("largest memory", f"{story.peak_bytes / 2**30:.2f} GiB resident"))
    tables = [Table(title="What it cost", columns=("what", "value"), rows=tuple(rows))]
    options = fact_rows(story.labels.metadata.get("options"))
    if options:
        tables.append(
            Table(title="Options of the method", columns=("option", "value"), rows=tuple(options))
        )
    return [table for table in tables if table.rows]


def _facts(labels: Labels, layer: str, backend: str) -> dict[str, Any]:
    said = labels.metadata
    facts = {
        "layer": layer,
        "method": said.get("method"),
        "evidence": said.get("evidence"),
        "views asked for": said.get("views_asked"),
        "seed": said.get("seed"),
        "backend": backend,
        "coverage": f"in pictures of at most {SEEN_LONGEST} pixels",
    }
    return {name: value for name, value in facts.items() if value is not None} | {
        "splatseg": metadata.version("splatseg"),
        "torch": metadata.version("torch"),
        "Python": platform.python_version(),
        "cores": os.cpu_count(),
    }


def _at_hand(view: View) -> bool:
    """Whether a view can be shown: it has no photograph, or one that is there."""
    return view.image is None or view.image.is_file()


def _spread(items: Sequence[_T], count: int) -> tuple[_T, ...]:
    """At most `count` items, evenly spread over the whole."""
    kept = min(count, len(items))
    return tuple(items[i * len(items) // kept] for i in range(kept))
