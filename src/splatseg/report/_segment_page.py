"""The page of a segmentation: what is told, and in which order."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from splatseg.core import UNLABELLED, ClassTable, Labels, RenderableLayer
from splatseg.evaluate.metrics import SemanticScore
from splatseg.evaluate.overlaps import InstanceScore
from splatseg.report._object_facts import ObjectFacts, object_cards
from splatseg.report._segment_panels import ViewPanel, confidence_range, gallery
from splatseg.report._segment_tables import (
    association_tables,
    confidence_bars,
    conflict_tables,
    coverage_bars,
    difference_tables,
    fact_rows,
    id_table,
    instances_without_labels,
    seen_id_table,
    support_table,
    training_blocks,
)
from splatseg.report.html import Block, Figure, Legend, Notice, Report, Table
from splatseg.report.images import ObjectGallery, Scale
from splatseg.report.object_gallery import MAX_OBJECTS
from splatseg.report.words import count_text, counted

_LEGEND = 40


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SegmentationReportData:
    """Everything that the report of a segmentation tells."""

    layer: str
    """Its name."""

    summary: RenderableLayer
    """What the field says of it."""

    labels: Labels | None
    """Of Gaussians; None where the layer is not of Gaussians."""

    classes: ClassTable
    """Names and colours of the ids in use."""

    panels: tuple[ViewPanel, ...]
    """Views that are shown."""

    compared: tuple[ViewPanel, ...]
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
    objects: tuple[ObjectFacts, ...] = ()
    """What is known of each id."""

    looked_at: int = 0
    """Views that objects were looked for in."""

    warnings: tuple[str, ...] = ()
    """What a reader should know before all else, in sentences."""

    tree: tuple[Block, ...] = ()
    """What there is to show of the levels above and below, see `tree_section`."""

    facts: Mapping[str, Any] = field(default_factory=dict[str, Any])


def segmentation_page(data: SegmentationReportData, *, longest: int) -> Report:
    """The page.

    Args:
        data: The segmentation.
        longest: Longest side of the pictures, pixels.
    """
    labels = data.labels
    blocks: list[Block] = []
    if data.panels:
        blocks.append(
            gallery(
                data.panels,
                data.classes,
                truth_names=data.truth_names,
                evidence_has_same_ids=data.evidence_has_same_ids,
                longest=longest,
            )
        )
        low, high = confidence_range(data.panels)
        blocks += [_scale(low, high), _legend(data)]
    blocks += [_objects(data), *data.tree]
    if labels is not None:
        blocks += [support_table(labels), confidence_bars(labels)]
    if data.seen_of:
        blocks.append(coverage_bars(data.seen, views=data.seen_of))
    if labels is not None:
        blocks += conflict_tables(labels, data.classes)
    blocks += difference_tables(data.compared)
    blocks += association_tables(data.summary.info)
    blocks += training_blocks(data.summary.info)
    scores = data.score.per_class if isinstance(data.score, SemanticScore) else {}
    blocks.append(
        seen_id_table(data.panels, data.classes, scores=scores, scored=data.scored)
        if labels is None
        else id_table(labels, data.classes, scores=scores, scored=data.scored)
    )
    blocks += _cost(data)
    return Report(
        title=f"Segmentation {data.layer}",
        summary=_summary(data),
        command=data.command,
        notices=tuple(
            Notice(verdict="Take care", sentence=words, warns=True) for words in data.warnings
        ),
        figures=_figures(data),
        blocks=tuple(blocks),
        facts=data.facts,
    )


def _summary(data: SegmentationReportData) -> str:
    method = data.summary.info.method or "an unknown method"
    labels = counted(len(data.classes.rows), "label")
    carriers = "" if data.labels is None else f" on {counted(len(data.labels), 'Gaussian')}"
    return " ".join(
        [
            f"{labels}{carriers}, by {method} from {counted(data.views, 'view')}.",
            *instances_without_labels(data.summary),
            f"Scores are of {data.scored}." if data.scored else "There is no truth to score.",
        ]
    )


def _scale(low: float, high: float) -> Scale:
    return Scale(
        title="Confidence",
        low=f"{low:.2f} or less" if low > 0 else "0",
        high=f"{high:.2f} or more" if high < 1 else "1",
        note="Confidence is the share of the votes that speak for a label; nothing is there where "
        "it is nearly black.",
    )


def _objects(data: SegmentationReportData) -> ObjectGallery:
    """The largest objects, each from the view that shows it best."""
    kept = data.objects[:MAX_OBJECTS]
    more = len(data.objects) - len(kept)
    notes = [f"The {len(kept)} largest; {more} more are in the JSON file."] if more else []
    notes.append(
        f"Each from the one of {counted(data.looked_at, 'view')} that shows most of it; what is "
        "not it is grey."
    )
    folders = sorted({one.file.rpartition("/")[0] for one in kept if one.file})
    notes += [f"Files are in {folder}, in the scene's folder." for folder in folders]
    if not folders:
        notes.append("segment --export writes each into a file of its own.")
    return ObjectGallery(title="Objects", cards=object_cards(kept), note=" ".join(notes))


def _legend(data: SegmentationReportData) -> Legend:
    """The labels that are seen most in the pictures."""
    pixels: dict[int, int] = {}
    for panel in data.panels:
        ids, counts = torch.unique(panel.drawn, return_counts=True)
        for id, count in zip(ids.tolist(), counts.tolist(), strict=True):
            pixels[id] = pixels.get(id, 0) + count
    ids = sorted((id for id in pixels if id != UNLABELLED), key=lambda id: (-pixels[id], id))
    rows = {row.id: row for row in data.classes.rows}
    kept = [rows[id] for id in ids[:_LEGEND] if id in rows]
    more = f", the {len(kept)} seen most of {len(ids)}" if len(ids) > len(kept) else ""
    return Legend(
        classes=ClassTable(rows=tuple(kept)),
        title=f"Colours of the labels{more}",
        with_ids=True,
    )


def _figures(data: SegmentationReportData) -> tuple[Figure, ...]:
    score = data.score
    figures = [] if data.labels is None else _label_figures(data.labels)
    count = Figure(label="Labels", value=str(len(data.classes.rows)), note="ids in use")
    figures.insert(min(1, len(figures)), count)
    if data.compared:
        pixels = sum(s.agreement.pixels for s in data.compared if s.agreement is not None)
        differ = sum(
            s.agreement.pixels * s.agreement.differ
            for s in data.compared
            if s.agreement is not None
        )
        figures.append(
            Figure(
                label="Evidence that differs from the layer",
                value=f"{differ / max(pixels, 1):.1%}",
                note=f"of the pixels of {counted(len(data.compared), 'view')}",
            )
        )
    if isinstance(score, SemanticScore):
        figures.append(
            Figure(label="mIoU", value=f"{score.miou:.3f}", note=f"pooled, {data.scored}")
        )
    elif score is not None:
        figures.append(
            Figure(
                label="mIoU of instances",
                value=f"{score.miou:.3f}",
                note=f"matched one to one, {data.scored}",
            )
        )
    return tuple(figures)


def _label_figures(labels: Labels) -> list[Figure]:
    """How many Gaussians have a label, and how sure it is."""
    labelled = labels.ids != UNLABELLED
    share = float(labelled.double().mean()) if len(labels) else 0.0
    figures = [
        Figure(
            label="Gaussians with a label",
            value=f"{share:.1%}",
            note=f"{count_text(int(labelled.sum()))} of {count_text(len(labels))}",
        )
    ]
    if bool(labelled.any()):
        mean = float(labels.confidence[labelled].double().mean())
        figures.append(
            Figure(label="Confidence", value=f"{mean:.3f}", note="mean of those with a label")
        )
    return figures


def _cost(data: SegmentationReportData) -> list[Table]:
    rows: list[tuple[str, str]] = [
        (step, f"{seconds:.1f} s") for step, seconds in data.timings.items()
    ]
    if len(data.timings) > 1:
        rows.append(("together", f"{sum(data.timings.values()):.1f} s"))
    if data.peak_bytes is not None:
        rows.append(("largest memory", f"{data.peak_bytes / 2**30:.2f} GiB resident"))
    tables = [Table(title="What it cost", columns=("what", "value"), rows=tuple(rows))]
    options = fact_rows(data.summary.info.options)
    if options:
        tables.append(
            Table(title="Options of the method", columns=("option", "value"), rows=tuple(options))
        )
    return [table for table in tables if table.rows]
