"""Tables and bars of a report of a segmentation."""

from collections.abc import Mapping, Sequence
from typing import Any, cast

import torch
from jaxtyping import Int
from torch import Tensor

from splatseg.core import LOSS_CURVE, UNLABELLED, ClassTable, Labels, LayerInfo, RenderableLayer
from splatseg.evaluate.agreement import SEEN_WEIGHT, contested, rivals
from splatseg.report.chart import Chart, Line
from splatseg.report.html import Bars, Block, Cell, Curves, Table
from splatseg.report.segment_views import ViewPanel
from splatseg.report.words import count_text

_BINS = 10
_MIN_VIEWS = (1, 2, 3, 5, 10, 20, 50, 100)
_CLOSE = (0.5, 0.8, 0.95)
_ROWS = 60
_LONG = 200

TRAINING_FACTS = ("trained", "point_network", "point_network_trained_on")
"""Details of a layer that say how it was trained."""


def support_table(labels: Labels) -> Table:
    """How many Gaussians have a label, and from where."""
    labelled = labels.ids != UNLABELLED
    inferred = labels.inferred if labels.inferred is not None else torch.zeros_like(labelled)
    rows: list[tuple[Cell, ...]] = []

    def add(name: str, mask: Tensor) -> None:
        count = int(mask.sum())
        rows.append((name, count_text(count), f"{count / max(len(labels), 1):.1%}"))

    add("with a label, from evidence of their own", labelled & ~inferred)
    if labels.inferred is not None:
        add("with a label, inferred from neighbours", labelled & inferred)
    add("without a label", ~labelled)
    if labels.evidence is not None:
        add("that no evidence spoke for", labels.evidence <= 0)
        add("with less evidence than one fully visible pixel", labels.evidence < 1)
    return Table("What the labels rest on", ("Gaussians", "count", "share"), tuple(rows))


def confidence_bars(labels: Labels) -> Bars:
    """How the confidence of labelled Gaussians is distributed."""
    labelled = labels.ids != UNLABELLED
    values = labels.confidence.detach().double().cpu()[labelled.cpu()].clamp(0, 1)
    bins = (values * _BINS).long().clamp(max=_BINS - 1)
    series, columns = ["share of the labelled Gaussians"], [_shares(bins, None)]
    if labels.evidence is not None:
        series.append("share of their evidence")
        columns.append(_shares(bins, labels.evidence.detach().double().cpu()[labelled.cpu()]))
    rows = tuple(
        (f"{i / _BINS:.1f} to {(i + 1) / _BINS:.1f}", tuple(column[i] for column in columns))
        for i in reversed(range(_BINS))
    )
    return Bars(
        "Confidence",
        tuple(series),
        rows,
        note="The share of a Gaussian's evidence that speaks for its label.",
    )


def coverage_bars(seen: Int[Tensor, "n"], *, views: int) -> Bars:
    """Share of the Gaussians that at least so many views show."""
    steps = [n for n in _MIN_VIEWS if n <= views] or [1]
    count = max(len(seen), 1)
    return Bars(
        "Coverage",
        ("share of the Gaussians",),
        tuple(
            (f"at least {n} view{'s' if n > 1 else ''}", (int((seen >= n).sum()) / count,))
            for n in steps
        ),
        note=f"A view shows a Gaussian that has at least {SEEN_WEIGHT:g} of a pixel's light in "
        f"it. {views} of the views that the layer was made from were looked at.",
    )


def conflict_tables(labels: Labels, classes: ClassTable) -> list[Block]:
    """Where evidence disagrees with itself, Gaussian by Gaussian."""
    blocks: list[Block] = []
    if labels.candidates is not None and labels.candidates.shape[1] > 1 and len(labels):
        close = [(ratio, contested(labels, ratio=ratio)) for ratio in _CLOSE]
        blocks.append(
            Bars(
                "Conflicts",
                ("share of the Gaussians",),
                tuple(
                    (f"second has {ratio:.0%} of the first or more", (float(mask.double().mean()),))
                    for ratio, mask in close
                ),
                note="Gaussians whose second candidate has nearly as many votes as the first.",
            )
        )
        pairs = rivals(labels, ratio=_CLOSE[0])
        if pairs:
            blocks.append(
                Table(
                    "Who contests whom",
                    ("label", "second", "Gaussians"),
                    tuple(
                        (
                            classes.name_of(pair.winner),
                            classes.name_of(pair.second),
                            pair.count,
                        )
                        for pair in pairs
                    ),
                    note=f"Where the second has at least {_CLOSE[0]:.0%} of the first one's votes.",
                )
            )
    else:
        weak = labels.confidence[labels.ids != UNLABELLED]
        share = float((weak < 0.5).double().mean()) if len(weak) else 0.0
        blocks.append(
            Table(
                "Conflicts",
                ("Gaussians", "share"),
                (("whose label has less than half of the votes", f"{share:.1%}"),),
                note="The layer keeps one candidate a Gaussian; with more, this says who contests "
                "whom.",
            )
        )
    return blocks


def difference_tables(panels: Sequence[ViewPanel]) -> list[Table]:
    """Where evidence disagrees with the layer, view by view."""
    compared = [(s.name, s.agreement) for s in panels if s.agreement is not None]
    if not compared:
        return []
    compared.sort(key=lambda row: (-row[1].differ, row[0]))
    return [
        Table(
            "Evidence that differs from the layer",
            ("view", "pixels compared", "differ"),
            tuple((name, one.pixels, f"{one.differ:.1%}") for name, one in compared),
            note="Pixels where both have a label, the most contested view first. Evidence "
            "with ids of its own: pixels that are not of the id that most of their segment "
            "has.",
        )
    ]


def association_tables(info: LayerInfo) -> list[Block]:
    """What a method that joins ids says of it in the layer's info, as far as it says it."""
    facts = info.details.get("associate")
    if not isinstance(facts, Mapping):
        return []
    facts = cast(Mapping[str, Any], facts)
    blocks: list[Block] = []
    plain = fact_rows({k: v for k, v in facts.items() if not isinstance(v, list | Mapping)})
    if plain:
        blocks.append(Table("Segments to instances", ("what", "value"), tuple(plain)))
    for name, value in facts.items():
        if isinstance(value, list) and value:
            blocks.append(_listed(name, cast(list[Any], value)))
        elif isinstance(value, Mapping) and value:
            rows = fact_rows(cast(Mapping[str, Any], value))
            title = name.replace("_", " ").capitalize()
            blocks.append(Table(title, ("what", "value"), tuple(rows[:_ROWS])))
    return blocks


def training_blocks(info: LayerInfo) -> list[Block]:
    """How a trained layer was trained: its loss, and what its method says of it in words."""
    blocks: list[Block] = []
    curve = _points(info.details.get(LOSS_CURVE))
    if curve:
        line = Line("training views", curve)
        chart = Chart("Loss", "steps", (line,))
        blocks.append(Curves("How it was trained", (chart,)))
    said = {
        key: info.details[key] for key in TRAINING_FACTS if isinstance(info.details.get(key), str)
    }
    if said:
        rows = fact_rows(said)
        blocks.append(Table("Training", ("what", "value"), tuple(rows)))
    return blocks


def _points(value: object) -> tuple[tuple[float, float], ...]:
    """Points of a curve; what is none, in a record of another program, is left out."""
    if not isinstance(value, list):
        return ()
    pairs = [one for one in cast("list[object]", value) if isinstance(one, list)]
    return tuple(
        (float(x), float(y))
        for x, y in (cast("list[object]", one) for one in pairs if len(one) == 2)  # pyright: ignore[reportUnknownArgumentType]
        if isinstance(x, int | float) and isinstance(y, int | float)
    )


def instances_without_labels(layer: RenderableLayer) -> list[str]:
    """A sentence on instances that no Gaussian carries, where the method says how many it made."""
    facts = layer.info.details.get("associate")
    made = facts.get("instances") if isinstance(facts, Mapping) else None
    merged = layer.info.edit("merge_panoptic") is not None
    if not isinstance(made, int) or merged or layer.info.cut not in (None, "object"):
        return []
    lost = made - len([id for id in layer.ids if id != layer.background])
    if lost <= 0:
        return []
    nouns = ("instance", "has", "its") if lost == 1 else ("instances", "have", "their")
    return [
        f"Masks were joined into {made} instances; {lost} {nouns[0]} {nouns[1]} no label, for "
        f"other instances won all of {nouns[2]} Gaussians."
    ]


def id_table(
    labels: Labels, classes: ClassTable, *, scores: Mapping[int, float], scored: str
) -> Table:
    """One row an id: how many Gaussians, how sure, how good where that is known.

    Where the method lists its instances, also how many segments and views each was seen in.
    """
    instances = labels.info.instances
    known = {"segments": {id: facts.segments for id, facts in instances.items()}}
    known["views"] = {id: facts.views for id, facts in instances.items()}
    also = {
        name: counts
        for name, counts in known.items()
        if any(count is not None for count in counts.values())
    }
    ids, sure = labels.ids.cpu().long(), labels.confidence.detach().double().cpu()
    rows = _id_rows(ids, sure, classes, [*also.values(), *([scores] if scores else [])])
    columns = ("id", "name", "Gaussians", "confidence", *also)
    return _largest_first(columns, rows, scored if scores else "")


def visible_id_table(
    panels: Sequence[ViewPanel], classes: ClassTable, *, scores: Mapping[int, float], scored: str
) -> Table:
    """One row an id: how many pixels of the views shown, how sure, how good where it is known."""
    ids = torch.cat([torch.zeros(0), *(panel.drawn.reshape(-1) for panel in panels)]).long()
    sure = torch.cat([torch.zeros(0), *(panel.confidence.reshape(-1) for panel in panels)]).double()
    rows = _id_rows(ids, sure, classes, [scores] if scores else [])
    columns = ("id", "name", "pixels of the views shown", "confidence")
    return _largest_first(columns, rows, scored if scores else "")


def _id_rows(
    ids: Tensor, sure: Tensor, classes: ClassTable, also: Sequence[Mapping[int, Cell]]
) -> list[tuple[Cell, ...]]:
    """Id, name, count and mean confidence of each class, and what further tables say of its id."""
    rows: list[tuple[Cell, ...]] = []
    for row in classes.rows:
        mask = ids == row.id
        known = sure[mask & (sure >= 0)]
        mean = float(known.mean()) if len(known) else None
        more = (values.get(row.id) for values in also)
        rows.append((row.id, row.name, int(mask.sum()), mean, *more))
    return rows


def _largest_first(columns: Sequence[str], rows: list[tuple[Cell, ...]], scored: str) -> Table:
    """Rows of ids by their third column; `scored` says of what the last one is the IoU."""
    rows.sort(key=lambda row: (-cast(int, row[2]), cast(int, row[0])))
    more = len(rows) - _ROWS
    notes = [f"The {_ROWS} largest; {more} more are left out."] if more > 0 else []
    if scored:
        notes.append(f"IoU is of {scored}; a dash where the truth has none of it.")
        columns = (*columns, "IoU")
    return Table("Labels", tuple(columns), tuple(rows[:_ROWS]), note=" ".join(notes))


def fact_rows(values: object) -> list[tuple[Cell, ...]]:
    """Names and values of a mapping as cells; what is too long for a cell is counted."""
    if not isinstance(values, Mapping):
        return []
    return [
        (str(name).replace("_", " "), _cell(value))
        for name, value in cast(Mapping[str, Any], values).items()
    ]


def _listed(name: str, values: list[Any]) -> Table:
    """A list as a table: of objects by their keys, of lists by place, of others one a row."""
    title = name.replace("_", " ").capitalize()
    shown = values[:_ROWS]
    note = f"{len(values)} in all; the first {_ROWS} are shown." if len(values) > _ROWS else ""
    if all(isinstance(value, Mapping) for value in shown):
        rows = [cast(Mapping[str, Any], value) for value in shown]
        keys = tuple(dict.fromkeys(str(key) for row in rows for key in row))
        cells = tuple(tuple(_cell(row.get(key)) for key in keys) for row in rows)
        columns = tuple(key.replace("_", " ") for key in keys)
        return Table(title, columns or ("",), cells if keys else (), note=note)
    return Table(title, (name,), tuple((_cell(value),) for value in shown), note=note)


def _cell(value: Any) -> Cell:
    if value is None or (isinstance(value, int | float) and not isinstance(value, bool)):
        return value
    if isinstance(value, list | tuple):
        parts = [str(part) for part in cast(Sequence[Any], value)]
        words = ", ".join(parts)
        return words if len(words) <= _LONG else f"{len(parts)}: {words[:_LONG]}..."
    words = str(value)
    return words if len(words) <= _LONG else f"{words[:_LONG]}..."


def _shares(bins: Tensor, weights: Tensor | None) -> list[float]:
    counts = torch.bincount(bins, weights=weights, minlength=_BINS).double()
    # Rounding may carry a share past 1.
    return (counts / counts.sum().clamp_min(1e-300)).clamp(0, 1).tolist()
