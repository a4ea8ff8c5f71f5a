"""The page of a mesh field of a drive: what was built, how it went, and what it shows."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from splatseg.core import ClassTable
from splatseg.report.chart import Chart, Line
from splatseg.report.html import Block, Curves, Figure, Legend, Notice, Report, Table
from splatseg.report.images import Gallery
from splatseg.report.words import count_text, counted, environment
from splatseg.street.geometry import GeometryRecord
from splatseg.street.radiance_training import RadianceRecord

_BINS = 200
"""Points of a curve of training: means of as many steps each."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelFacts:
    """The primitives of one level."""

    side: float
    """Of its voxels, metres."""

    started: int
    """Primitives that voxels gave."""

    kept: int
    """Of these, after those were removed that stood before surfaces or around cameras."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PointScore:
    """How well some points of scans that brought their truth are labelled."""

    points: str
    """Which: all, seen (by a camera), or unseen."""

    count: int
    """Of them, with a truth."""

    miou: float | None
    """Mean IoU of the classes that they have; a point without a label is wrong. None of none."""

    accuracy: float | None
    undefined: float | None
    """Share without a label."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PointCounts:
    """Points of laser scans that were labelled."""

    folder: str
    """Where the labels are."""

    by: str
    """Who labelled them."""

    vertex_rule: str | None
    """Which vertices eq. 9 asked; None where points took labels otherwise."""

    scans: int
    points: int
    unlabelled: int
    ids: Mapping[int, int]
    """How many points have each id, by id."""

    scores: tuple[PointScore, ...] = ()
    """Where scans brought their truth: of all points, of seen and of unseen ones."""

    sight: str = ""
    """By whose depth points count as seen."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StreetReportData:
    """Everything that the page tells but its pictures."""

    scene: str
    """What the scene is called."""

    layer: str
    classes: ClassTable
    """Names and colours of its ids."""

    name: str = ""
    """Of the field; empty where none was made."""

    primitives: int = 0
    blocks: int = 0
    """Of a drive in blocks; 0 where it is one field."""

    levels: tuple[LevelFacts, ...] = ()
    shaping: tuple[GeometryRecord, ...] = ()
    training: tuple[RadianceRecord, ...] = ()
    metres_per_unit: float = 1.0
    psnr: Mapping[str, float] = field(default_factory=dict[str, float])
    """Of the views that are shown, decibels."""

    points: PointCounts | None = None
    timings: Mapping[str, float] = field(default_factory=dict[str, float])
    """Seconds by stage."""

    notices: tuple[Notice, ...] = ()
    facts: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """More of how it was made."""

    command: str = ""
    """The words that started it."""


def street_report(
    data: StreetReportData, *, views: Gallery | None = None, above: Gallery | None = None
) -> Report:
    """The page.

    Args:
        data: What is told.
        views: Photographs, renders, depth and label maps of some views.
        above: Labelled points from above.
    """
    legend = Legend(data.classes) if data.classes.rows else None
    points = data.points
    charts = _charts(data)
    how = Curves(
        "How it went",
        charts,
        "Shapes are fitted to depth level by level, then colours and classes are "
        f"learned. Means of at most {_BINS} parts of the training each.",
    )
    blocks: list[Block | None] = [
        views,
        None if views is None else legend,
        above,
        legend if views is None and above is not None else None,
        None if points is None else _point_table(data, points),
        _score_table(points) if points is not None and points.scores else None,
        _levels(data) if data.levels else None,
        how if charts else None,
        _times(data) if data.timings else None,
    ]
    return Report(
        title=f"Street {data.scene}",
        summary=_summary(data),
        command=data.command,
        notices=data.notices,
        figures=tuple(_figures(data)),
        blocks=tuple(block for block in blocks if block is not None),
        facts={**data.facts, **environment()},
    )


def street_record(data: StreetReportData) -> dict[str, Any]:
    """The same as values that JSON holds."""
    error = _depth_error(data)
    record: dict[str, Any] = {
        "made_by": "splatseg street",
        "command": data.command,
        "scene": data.scene,
        "field": data.name or None,
        "layer": data.layer,
        "primitives": data.primitives,
        "blocks": data.blocks,
        "levels": [asdict(level) for level in data.levels],
        "depth_error": dict(zip(("first", "last"), error, strict=True)) if error else None,
        "psnr": dict(data.psnr),
        "training": [
            {"iteration": at, "colour_loss": colour, "semantic_loss": semantic}
            for at, colour, semantic in _thinned(data.training)
        ],
        "seconds": {name: round(spent, 3) for name, spent in data.timings.items()},
        "classes": {str(row.id): row.name for row in data.classes.rows},
    }
    if data.points is not None:
        ids = {str(id): count for id, count in data.points.ids.items()}
        record["points"] = asdict(data.points) | {"ids": ids}
    return record


def _summary(data: StreetReportData) -> str:
    sentences: list[str] = []
    if data.name:
        of = f" in {counted(data.blocks, 'block')}" if data.blocks else ""
        count = len(data.classes.rows)
        classes = "1 class" if count == 1 else f"{count} classes"
        primitives = counted(data.primitives, "primitive")
        sentences.append(f"Field {data.name}: {primitives}{of} with {classes}.")
    if data.points is not None:
        points, scans = counted(data.points.points, "point"), counted(data.points.scans, "scan")
        sentences.append(f"{points} of {scans} labelled by {data.points.by}.")
    return " ".join(sentences)


def _figures(data: StreetReportData) -> list[Figure]:
    figures: list[Figure] = []
    if data.name:
        figures.append(Figure("primitives", count_text(data.primitives)))
    if error := _depth_error(data):
        note = f"mean of the finest level; {error[0]:.2f} m in its first steps"
        figures.append(Figure("error of depth", f"{error[1]:.2f} m", note))
    if data.psnr:
        mean = math.fsum(data.psnr.values()) / len(data.psnr)
        note = f"of the {counted(len(data.psnr), 'training view')} shown"
        figures.append(Figure("PSNR", f"{mean:.1f} dB", note))
    if data.points is not None and data.points.points:
        share = 1 - data.points.unlabelled / data.points.points
        figures.append(Figure("points with a label", f"{share:.1%}"))
    return figures


def _depth_error(data: StreetReportData) -> tuple[float, float] | None:
    """Of the rays of the first and of the last steps of the finest level, metres."""
    finest = [r for r in data.shaping if r.level == 0 and math.isfinite(r.loss)]
    if not finest:
        return None
    return finest[0].loss * data.metres_per_unit, finest[-1].loss * data.metres_per_unit


def _levels(data: StreetReportData) -> Table:
    return Table(
        "Primitives",
        ("level", "side of voxels, m", "of voxels", "kept"),
        tuple(
            (i, f"{level.side:g}", level.started, level.kept) for i, level in enumerate(data.levels)
        ),
        note="0 is the finest level. What stood before measured surfaces or around a camera was "
        "removed.",
    )


def _point_table(data: StreetReportData, points: PointCounts) -> Table:
    names = {row.id: row.name for row in data.classes.rows}
    total = max(points.points, 1)
    ordered = sorted(points.ids.items(), key=lambda item: (-item[1], item[0]))
    rows: list[tuple[str, int | None, int, float]] = [
        (names.get(id, ""), id, count, count / total) for id, count in ordered
    ]
    rows.append(("without a label", None, points.unlabelled, points.unlabelled / total))
    return Table(
        "Points by class",
        ("class", "id", "points", "share"),
        tuple(rows),
        note=f"Of {counted(points.scans, 'scan')}; the labels are in {points.folder}.",
    )


def _score_table(points: PointCounts) -> Table:
    return Table(
        "Points against their truth",
        ("points", "number", "mIoU", "accuracy", "without a label"),
        tuple((s.points, s.count, s.miou, s.accuracy, s.undefined) for s in points.scores),
        note="Seen are points that a view which was learned from shows, by "
        f"{points.sight}: no more than 0.1 m and 3 % behind it. A point without a label is wrong.",
    )


def _charts(data: StreetReportData) -> tuple[Chart, ...]:
    charts: list[Chart] = []
    shaped = [record for record in data.shaping if math.isfinite(record.loss)]
    if shaped:
        by_level: dict[int, list[tuple[float, float]]] = {}
        for record in shaped:
            loss = record.loss * data.metres_per_unit
            by_level.setdefault(record.level, []).append((float(record.step), loss))
        lines = tuple(Line(f"level {level}", tuple(points)) for level, points in by_level.items())
        charts.append(Chart("Error of depth, m", "steps of a level", lines))
    learned = _thinned(data.training)
    for title, column in (("Squared error of colours", 1), ("Cross-entropy of classes", 2)):
        points = tuple((row[0], row[column]) for row in learned if math.isfinite(row[column]))
        if points:
            line = Line(title, points)
            charts.append(Chart(title, "steps", (line,)))
    return tuple(charts)


def _thinned(records: Sequence[RadianceRecord]) -> list[tuple[float, float, float]]:
    """Step, and means of both losses, of equal parts of the training."""
    size = max(1, -(-len(records) // _BINS))
    parts = [records[start : start + size] for start in range(0, len(records), size)]
    return [
        (
            float(part[-1].iteration),
            math.fsum(record.colour_loss for record in part) / len(part),
            math.fsum(record.semantic_loss for record in part) / len(part),
        )
        for part in parts
    ]


def _times(data: StreetReportData) -> Table:
    rows = [(name, round(spent, 1)) for name, spent in data.timings.items()]
    rows.append(("together", round(math.fsum(data.timings.values()), 1)))
    return Table("Time", ("stage", "seconds"), tuple(rows))
