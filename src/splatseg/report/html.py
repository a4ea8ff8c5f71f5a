"""A report as one HTML page that needs nothing else: no network, no scripts, no files beside it.

Pure functions: pictures, tables and facts in, one string out.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from splatseg.core import ClassTable
from splatseg.errors import InputError
from splatseg.report._page_style import PAGE_STYLE
from splatseg.report._pictures import PictureHtml
from splatseg.report._words import name_text, shown, text
from splatseg.report.chart import Chart, chart_svg
from splatseg.report.images import Gallery, ObjectGallery, Scale
from splatseg.report.legend import colour_of

Cell = str | int | float | None

_TALL = 40
"""Tables of more rows scroll within the page."""

_POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; "
    "form-action 'none'"
)
"""What a browser may do for a page: show its own pictures and styles. There are no scripts, and
nothing is asked of another place, whatever a name in it holds."""

_MIN_CONTENTS = 3
"""From so many sections on, a page begins with links to them."""


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
    with_ids: bool = False
    """Whether ids stand before names; pictures have them."""


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Notice:
    """A sentence that is read before all else."""

    verdict: str
    """A word or two: ``Too short``."""

    sentence: str
    warns: bool = False
    """Whether something is wrong."""


Block = Table | Bars | Curves | Gallery | ObjectGallery | Legend | Scale | Commands


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """Everything on one page."""

    title: str
    summary: str = ""
    command: str = ""
    """The words that made it; told under the summary."""

    notices: tuple[Notice, ...] = ()
    figures: tuple[Figure, ...] = ()
    blocks: tuple[Block, ...] = ()

    facts: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """How it was made: versions, seeds, settings. Shown last."""


def report_html(report: Report) -> str:
    """The whole page as HTML, pictures inside as data URIs.

    All words are escaped. Pictures are enlarged by a click or the Enter key, and made small
    again by Escape, without scripts. The page follows the reader's light or dark setting, and
    prints.

    Example:
        >>> page = report_html(Report(title="Two & three", summary="Short."))
        >>> "<h1>Two &amp; three</h1>" in page
        True
    """
    parts = [f"<h1>{name_text(report.title)}</h1>"]
    if report.summary:
        parts.append(f'<p class="summary">{text(report.summary)}</p>')
    if report.command:
        parts.append(f'<p class="made">Made by <code>{_command(report.command)}</code></p>')
    parts += [_notice(notice) for notice in report.notices]
    pictures = PictureHtml()
    sections: list[tuple[str, str]] = []
    for block in report.blocks:
        content = _block(block, pictures)
        if isinstance(block, Legend | Scale) and sections:
            title, before = sections[-1]
            key = f'<div class="key"><h3>{text(block.title)}</h3>{content}</div>'
            sections[-1] = (title, before + key)
        else:
            sections.append((block.title, content))
    if report.facts:
        sections.append(("How it was made", _facts(report.facts)))
    titles = [title for title, _ in sections]
    if len(titles) >= _MIN_CONTENTS:
        links = "".join(f'<a href="#s{i}">{text(title)}</a>' for i, title in enumerate(titles))
        parts.append(f'<nav aria-label="Contents">{links}</nav>')
    if report.figures:
        cards = "".join(_figure(figure) for figure in report.figures)
        parts.append(f'<section class="figures">{cards}</section>')
    parts += [
        f'<section id="s{i}"><h2>{text(title)}</h2>{content}</section>'
        for i, (title, content) in enumerate(sections)
    ]
    body = "\n".join(parts)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{text(report.title)}</title>\n<style>{PAGE_STYLE}</style>\n</head>\n"
        f"<body>\n<main>\n{body}\n</main>\n</body>\n</html>\n"
    )


def _command(line: str) -> str:
    """A command line, which no narrow window breaks within the name of an option."""
    return " ".join(
        f'<span class="option">{text(word)}</span>' if word.startswith("-") else text(word)
        for word in line.split(" ")
    )


def _facts(facts: Mapping[str, Any]) -> str:
    rows = "".join(
        f"<dt>{text(name)}</dt><dd>{text(shown(value))}</dd>" for name, value in facts.items()
    )
    return f"<dl>{rows}</dl>"


def _notice(notice: Notice) -> str:
    kind = "notice warn" if notice.warns else "notice"
    words = f"<b>{text(notice.verdict)}.</b> {text(notice.sentence)}"
    return f'<p class="{kind}" role="note">{words}</p>'


def _figure(figure: Figure) -> str:
    note = f'<div class="note">{text(figure.note)}</div>' if figure.note else ""
    return (
        f'<div class="figure"><div class="label">{text(figure.label)}</div>'
        f'<div class="value">{text(figure.value)}</div>{note}</div>'
    )


def _block(block: Block, pictures: PictureHtml) -> str:
    if isinstance(block, Table):
        inner = _table(block)
    elif isinstance(block, Bars):
        inner = _bars(block)
    elif isinstance(block, Curves):
        inner = _curves(block)
    elif isinstance(block, Gallery):
        inner = pictures.gallery(block)
    elif isinstance(block, ObjectGallery):
        inner = pictures.objects(block)
    elif isinstance(block, Legend):
        inner = _legend(block)
    elif isinstance(block, Scale):
        inner = pictures.scale(block)
    else:
        inner = f"<pre>{chr(10).join(map(text, block.lines))}</pre>"
    note = "" if isinstance(block, Legend) or not block.note else block.note
    intro = f'<p class="note">{text(note)}</p>' if note else ""
    return f"{intro}{inner}"


def _table(table: Table) -> str:
    numeric = [
        all(isinstance(row[i], int | float | None) for row in table.rows)
        for i in range(len(table.columns))
    ]
    kinds = [' class="number"' if number else "" for number in numeric]
    head = "".join(
        f'<th scope="col"{kind}>{text(name)}</th>'
        for name, kind in zip(table.columns, kinds, strict=True)
    )
    rows = "".join(
        "<tr>"
        + "".join(
            f"<td{kind}>{text(shown(cell))}</td>" for cell, kind in zip(row, kinds, strict=True)
        )
        + "</tr>"
        for row in table.rows
    )
    inside = f"<thead><tr>{head}</tr></thead><tbody>{rows}</tbody>"
    tall = " tall" if len(table.rows) > _TALL else ""
    # What scrolls can be reached by keys.
    opening = (
        f'<div class="wide{tall}" tabindex="0" role="region" aria-label="{text(table.title)}">'
    )
    return f"{opening}<table>{inside}</table></div>"


def _bars(bars: Bars) -> str:
    keys = "".join(
        f'<span><i class="series{i}"></i>{text(name)}</span>' for i, name in enumerate(bars.series)
    )
    rows: list[str] = []
    for name, values in bars.rows:
        lines = "".join(
            f'<div class="bar-line"><i class="series{i}" '
            f'style="width:{100 * (value or 0):.1f}%"></i>'
            f"<b>{shown(value)}</b></div>"
            for i, value in enumerate(values)
        )
        rows.append(f'<div class="name">{text(name)}</div><div class="group">{lines}</div>')
    return f'<div class="keys">{keys}</div><div class="bars">{"".join(rows)}</div>'


def _curves(curves: Curves) -> str:
    figures: list[str] = []
    for chart in curves.charts:
        names = [line.name for line in chart.lines]
        keys = "".join(
            f'<span><i class="series{i + 1}"></i>{text(name)}</span>'
            for i, name in enumerate(names)
        )
        key = f'<div class="keys">{keys}</div>' if len(names) > 1 else ""
        figures.append(
            f"<figure><figcaption>{text(chart.title)}</figcaption>{key}{chart_svg(chart)}</figure>"
        )
    return f'<div class="charts">{"".join(figures)}</div>'


def _legend(legend: Legend) -> str:
    entries: list[str] = []
    for row in legend.classes.rows:
        red, green, blue = colour_of(row.id, legend.classes)
        said = not legend.with_ids or str(row.id) in row.name.split()
        name = row.name if said else f"{row.id} {row.name}"
        entries.append(
            f'<span><i style="background:rgb({red},{green},{blue})"></i>{text(name)}</span>'
        )
    return f'<div class="keys">{"".join(entries)}</div>'
