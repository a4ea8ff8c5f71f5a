"""A report as one HTML page that needs nothing else: no network, no scripts, no files beside it.

Pure functions: pictures, tables and facts in, one string out.
"""

import base64
import html
import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from PIL import Image

from splatseg.core import ClassTable
from splatseg.errors import InputError
from splatseg.report.chart import Chart, chart_svg
from splatseg.report.images import Gallery, GalleryImage
from splatseg.report.legend import colour_of

Cell = str | int | float | None

_JPEG_QUALITY = 88


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """One number that matters, shown large at the top."""

    value: str
    """As it is read: ``29.4 dB``."""

    label: str
    note: str = ""
    """A sentence that says how it came about or what it compares with."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """Rows of numbers and words. Numbers stand right, None shows as a dash."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise InputError(
                    f"rows: expected {len(self.columns)} cells as there are columns, "
                    f"got {len(row)} in the row of {row[0] if row else 'nothing'!r}."
                )


@dataclass(frozen=True, slots=True, kw_only=True)
class Bars:
    """Values in [0, 1] as bars, one group a row, one bar a series."""

    title: str
    series: tuple[str, ...]
    rows: tuple[tuple[str, tuple[float | None, ...]], ...]
    """Name and one value a series; None where there is none."""

    note: str = ""

    def __post_init__(self) -> None:
        for name, values in self.rows:
            if len(values) != len(self.series):
                raise InputError(
                    f"rows: expected {len(self.series)} values as there are series, "
                    f"got {len(values)} for {name!r}."
                )
            if any(value is not None and not 0 <= value <= 1 for value in values):
                raise InputError(f"rows: expected values in [0, 1], got {values} for {name!r}.")


@dataclass(frozen=True, slots=True, kw_only=True)
class Legend:
    """What the colours of label pictures mean."""

    classes: ClassTable
    title: str = "Colours"


@dataclass(frozen=True, slots=True, kw_only=True)
class Commands:
    """Lines that a reader can copy into a terminal."""

    title: str
    lines: tuple[str, ...]
    note: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Curves:
    """Charts beside each other."""

    title: str
    charts: tuple[Chart, ...]
    note: str = ""


Block = Table | Bars | Curves | Gallery | Legend | Commands


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """Everything on one page."""

    title: str
    summary: str = ""
    figures: tuple[Figure, ...] = ()
    blocks: tuple[Block, ...] = ()

    facts: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """How it was made: versions, seeds, settings. Shown last."""


def report_html(report: Report) -> str:
    """The whole page as HTML, pictures inside as data URIs.

    All words are escaped. The page follows the reader's light or dark setting, and prints.

    Example:
        >>> page = report_html(Report(title="Two & three", summary="Short."))
        >>> "<h1>Two &amp; three</h1>" in page
        True
    """
    parts = [f"<h1>{_text(report.title)}</h1>"]
    if report.summary:
        parts.append(f'<p class="summary">{_text(report.summary)}</p>')
    if report.figures:
        cards = "".join(_figure(figure) for figure in report.figures)
        parts.append(f'<section class="figures">{cards}</section>')
    parts += [_block(block) for block in report.blocks]
    if report.facts:
        rows = "".join(
            f"<dt>{_text(name)}</dt><dd>{_text(_shown(value))}</dd>"
            for name, value in report.facts.items()
        )
        parts.append(f"<section><h2>How it was made</h2><dl>{rows}</dl></section>")
    body = "\n".join(parts)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{_text(report.title)}</title>\n<style>{_STYLE}</style>\n</head>\n"
        f"<body>\n<main>\n{body}\n</main>\n</body>\n</html>\n"
    )


def data_uri(panel: GalleryImage) -> str:
    """The picture as a ``data:`` address: JPEG for a photo, PNG for a chart."""
    file = io.BytesIO()
    image = Image.fromarray(panel.image.cpu().numpy())
    if panel.kind == "photo":
        image.save(file, format="JPEG", quality=_JPEG_QUALITY)
        kind = "jpeg"
    else:
        image.save(file, format="PNG", optimize=True)
        kind = "png"
    return f"data:image/{kind};base64,{base64.b64encode(file.getvalue()).decode('ascii')}"


def _text(words: str) -> str:
    return html.escape(words, quote=True)


def _shown(value: Any) -> str:
    if value is None:
        return "\N{EN DASH}"
    if isinstance(value, float):
        return f"{value:.3f}" if abs(value) < 100 else f"{value:.0f}"
    return str(value)


def _figure(figure: Figure) -> str:
    note = f'<div class="note">{_text(figure.note)}</div>' if figure.note else ""
    return (
        f'<div class="figure"><div class="label">{_text(figure.label)}</div>'
        f'<div class="value">{_text(figure.value)}</div>{note}</div>'
    )


def _block(block: Block) -> str:
    if isinstance(block, Table):
        inner = _table(block)
    elif isinstance(block, Bars):
        inner = _bars(block)
    elif isinstance(block, Curves):
        inner = _curves(block)
    elif isinstance(block, Gallery):
        inner = _gallery(block)
    elif isinstance(block, Legend):
        inner = _legend(block)
    else:
        inner = f"<pre>{_text(chr(10).join(block.lines))}</pre>"
    note = "" if isinstance(block, Legend) or not block.note else block.note
    intro = f'<p class="note">{_text(note)}</p>' if note else ""
    return f"<section><h2>{_text(block.title)}</h2>{intro}{inner}</section>"


def _table(table: Table) -> str:
    numeric = [
        all(isinstance(row[i], int | float | None) for row in table.rows)
        for i in range(len(table.columns))
    ]
    kinds = [' class="number"' if number else "" for number in numeric]
    head = "".join(
        f'<th scope="col"{kind}>{_text(name)}</th>'
        for name, kind in zip(table.columns, kinds, strict=True)
    )
    rows = "".join(
        "<tr>"
        + "".join(
            f"<td{kind}>{_text(_shown(cell))}</td>" for cell, kind in zip(row, kinds, strict=True)
        )
        + "</tr>"
        for row in table.rows
    )
    inside = f"<thead><tr>{head}</tr></thead><tbody>{rows}</tbody>"
    return f'<div class="wide"><table>{inside}</table></div>'


def _bars(bars: Bars) -> str:
    keys = "".join(
        f'<span><i class="series{i}"></i>{_text(name)}</span>' for i, name in enumerate(bars.series)
    )
    rows: list[str] = []
    for name, values in bars.rows:
        lines = "".join(
            f'<div class="bar"><i class="series{i}" style="width:{100 * (value or 0):.1f}%"></i>'
            f"<b>{_shown(value)}</b></div>"
            for i, value in enumerate(values)
        )
        rows.append(f'<div class="name">{_text(name)}</div><div class="group">{lines}</div>')
    return f'<div class="keys">{keys}</div><div class="bars">{"".join(rows)}</div>'


def _curves(curves: Curves) -> str:
    figures: list[str] = []
    for chart in curves.charts:
        names = [line.name for line in chart.lines]
        keys = "".join(
            f'<span><i class="series{i + 1}"></i>{_text(name)}</span>'
            for i, name in enumerate(names)
        )
        key = f'<div class="keys">{keys}</div>' if len(names) > 1 else ""
        figures.append(
            f"<figure><figcaption>{_text(chart.title)}</figcaption>{key}{chart_svg(chart)}</figure>"
        )
    return f'<div class="charts">{"".join(figures)}</div>'


def _gallery(gallery: Gallery) -> str:
    head = "".join(f'<th scope="col">{_text(name)}</th>' for name in ("", *gallery.columns))
    rows: list[str] = []
    for label, panels in gallery.rows:
        cells = "".join(
            f"<td>{_image(panel, f'{label}: {name}')}</td>"
            for panel, name in zip(panels, gallery.columns, strict=True)
        )
        rows.append(f'<tr><th scope="row">{_text(label)}</th>{cells}</tr>')
    return (
        f'<div class="wide"><table class="gallery"><thead><tr>{head}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _image(panel: GalleryImage, alternative: str) -> str:
    height, width = panel.image.shape[:2]
    caption = f"<figcaption>{_text(panel.caption)}</figcaption>" if panel.caption else ""
    return (
        f'<figure><img src="{data_uri(panel)}" width="{width}" height="{height}" '
        f'alt="{_text(panel.caption or alternative)}" loading="lazy">{caption}</figure>'
    )


def _legend(legend: Legend) -> str:
    entries: list[str] = []
    for row in legend.classes.rows:
        red, green, blue = colour_of(row.id, legend.classes)
        entries.append(
            f'<span><i style="background:rgb({red},{green},{blue})"></i>{_text(row.name)}</span>'
        )
    return f'<div class="keys">{"".join(entries)}</div>'


_STYLE = """
:root { color-scheme: light dark; --paper: #faf9f6; --card: #ffffff; --ink: #20222a;
  --quiet: #63666f; --line: #dedcd5; --first: #b9b4a6; --second: #2f7d6d; --third: #c2703d; }
@media (prefers-color-scheme: dark) {
  :root { --paper: #17181c; --card: #202228; --ink: #e9e7e1; --quiet: #a2a4ac; --line: #363941;
    --first: #6a6c76; --second: #58b39f; --third: #dd935f; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }
main { max-width: 1240px; margin: 0 auto; padding: 2.5rem 1.25rem 4rem; }
h1 { font-size: 2rem; line-height: 1.2; margin: 0 0 .5rem; letter-spacing: -.01em; }
h2 { font-size: 1.2rem; margin: 0 0 .5rem; }
section { margin-top: 2.5rem; }
.summary { max-width: 46rem; margin: 0; color: var(--quiet); font-size: 1.05rem; }
.note { max-width: 46rem; margin: 0 0 .75rem; color: var(--quiet); font-size: .9rem; }
.figures { display: flex; flex-wrap: wrap; gap: .75rem; }
.figure { flex: 1 1 13rem; padding: .9rem 1rem; background: var(--card);
  border: 1px solid var(--line); border-radius: .6rem; }
.figure .label { color: var(--quiet); font-size: .85rem; }
.figure .value { font-size: 1.75rem; font-weight: 650; line-height: 1.3;
  font-variant-numeric: tabular-nums; }
.figure .note { margin: .15rem 0 0; font-size: .82rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; }
th, td { text-align: left; padding: .35rem .9rem .35rem 0; border-bottom: 1px solid var(--line);
  vertical-align: top; }
thead th { color: var(--quiet); font-weight: 550; font-size: .88rem; }
.number { text-align: right; font-variant-numeric: tabular-nums; }
.gallery { width: 100%; }
.gallery th, .gallery td { border: 0; padding: .2rem .35rem .2rem 0; }
.gallery tbody th { font-weight: 450; font-size: .82rem; color: var(--quiet);
  overflow-wrap: anywhere; min-width: 6rem; }
figure { margin: 0; }
figcaption { color: var(--quiet); font-size: .78rem; }
img { display: block; width: 100%; min-width: 10rem; max-width: 24rem; height: auto;
  border-radius: .3rem; }
.keys { display: flex; flex-wrap: wrap; gap: .3rem 1.1rem; font-size: .9rem;
  margin-bottom: .75rem; }
.keys i { display: inline-block; width: .85em; height: .85em; border-radius: .2em;
  margin-right: .4em; vertical-align: -.08em; }
.bars { display: grid; grid-template-columns: max-content minmax(10rem, 40rem);
  gap: .5rem 1rem; align-items: center; }
.bars .name { font-size: .92rem; }
.bar { display: flex; align-items: center; gap: .5rem; height: 1rem; }
.bar i { height: .6rem; border-radius: .15rem; min-width: 1px; }
.bar b { font-weight: 450; font-size: .78rem; color: var(--quiet);
  font-variant-numeric: tabular-nums; }
.series0 { background: var(--first); } .series1 { background: var(--second); }
.series2 { background: var(--third); }
.charts { display: grid; grid-template-columns: repeat(auto-fit, minmax(18rem, 1fr)); gap: 1rem; }
.charts figcaption { font-size: .92rem; color: var(--ink); }
svg { display: block; width: 100%; height: auto; }
svg text { fill: var(--quiet); font-size: 11px; font-variant-numeric: tabular-nums; }
svg .grid { stroke: var(--line); stroke-width: 1; }
svg polyline { fill: none; stroke-width: 1.8; stroke-linejoin: round; }
.line0 { stroke: var(--second); } .line1 { stroke: var(--third); }
.dot0 { fill: var(--second); } .dot1 { fill: var(--third); }
pre { margin: 0; padding: .9rem 1rem; overflow-x: auto; background: var(--card);
  border: 1px solid var(--line); border-radius: .6rem;
  font: .85rem/1.6 ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .25rem 1.25rem; margin: 0;
  font-size: .9rem; }
dt { color: var(--quiet); } dd { margin: 0; overflow-wrap: anywhere; }
@media print { body { background: none; } .wide { overflow: visible; } }
"""
