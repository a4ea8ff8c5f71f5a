"""A report as one HTML page that needs nothing else: no network, no scripts, no files beside it.

Pure functions: pictures, tables and facts in, one string out.
"""

import base64
import io
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from PIL import Image

from splatseg.core import ClassTable
from splatseg.report.chart import Chart, chart_svg
from splatseg.report.colours import Colour, colour_of
from splatseg.report.images import SHADES, Gallery, GalleryImage, ObjectCard, ObjectGallery, Scale
from splatseg.report.words import name_text, shown, text

Cell = str | int | float | None

_STYLE = (Path(__file__).parent / "page.css").read_text(encoding="utf-8")
"""Light and dark, wide and narrow, on paper; nothing is fetched."""

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


@dataclass(frozen=True, slots=True)
class Figure:
    """One number that matters, shown large at the top."""

    label: str
    value: str
    """As it is read: ``29.4 dB``."""

    note: str = ""
    """A sentence that says how it came about or what it compares with."""


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of numbers and words. Numbers stand right, None shows as a dash."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""


@dataclass(frozen=True, slots=True)
class Bars:
    """Values in [0, 1] as bars, one group a row, one bar a series."""

    title: str
    series: tuple[str, ...]
    rows: tuple[tuple[str, tuple[float | None, ...]], ...]
    """Name and one value a series; None where there is none."""

    note: str = ""


@dataclass(frozen=True, slots=True)
class Legend:
    """What the colours of label pictures mean."""

    classes: ClassTable
    title: str = "Colours"
    with_ids: bool = False
    """Whether ids stand before names; pictures have them."""


@dataclass(frozen=True, slots=True)
class Commands:
    """Lines that a reader can copy into a terminal."""

    title: str
    lines: tuple[str, ...]
    note: str = ""


@dataclass(frozen=True, slots=True)
class Curves:
    """Charts beside each other."""

    title: str
    charts: tuple[Chart, ...]
    note: str = ""


@dataclass(frozen=True, slots=True)
class Notice:
    """A sentence that is read before all else."""

    verdict: str
    """A word or two: ``Too short``."""

    sentence: str
    warns: bool = False
    """Whether something is wrong."""


Block = Table | Bars | Curves | Gallery | ObjectGallery | Legend | Scale | Commands


@dataclass(frozen=True, slots=True)
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
        rows = (f"<dt>{text(k)}</dt><dd>{text(shown(v))}</dd>" for k, v in report.facts.items())
        sections.append(("How it was made", f"<dl>{''.join(rows)}</dl>"))
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
        f"<title>{text(report.title)}</title>\n<style>\n{_STYLE}</style>\n</head>\n"
        f"<body>\n<main>\n{body}\n</main>\n</body>\n</html>\n"
    )


def _command(line: str) -> str:
    """A command line, which no narrow window breaks within the name of an option."""
    return " ".join(
        f'<span class="option">{text(word)}</span>' if word.startswith("-") else text(word)
        for word in line.split(" ")
    )


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


def _block(block: Block, pictures: "PictureHtml") -> str:
    match block:
        case Table():
            inner = _table(block)
        case Bars():
            inner = _bars(block)
        case Curves():
            inner = _curves(block)
        case Gallery():
            inner = pictures.gallery(block)
        case ObjectGallery():
            inner = pictures.objects(block)
        case Legend():
            return _legend(block)
        case Scale():
            inner = pictures.scale(block)
        case Commands():
            inner = f"<pre>{chr(10).join(map(text, block.lines))}</pre>"
    intro = f'<p class="note">{text(block.note)}</p>' if block.note else ""
    return f"{intro}{inner}"


def _table(table: Table) -> str:
    columns = range(len(table.columns))
    numeric = [all(isinstance(row[i], int | float | None) for row in table.rows) for i in columns]
    kinds = [' class="number"' if number else "" for number in numeric]
    head = "".join(
        f'<th scope="col"{kind}>{text(name)}</th>'
        for name, kind in zip(table.columns, kinds, strict=True)
    )
    rows = [
        "".join(
            f"<td{kind}>{text(shown(cell))}</td>" for cell, kind in zip(row, kinds, strict=True)
        )
        for row in table.rows
    ]
    body = "".join(f"<tr>{cells}</tr>" for cells in rows)
    tall = " tall" if len(rows) > _TALL else ""
    # What scrolls can be reached by keys.
    return (
        f'<div class="wide{tall}" tabindex="0" role="region" aria-label="{text(table.title)}">'
        f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def _keys(entries: Iterable[tuple[str, str]]) -> str:
    """Swatches, each an attribute that colours it, with a name."""
    spans = "".join(f"<span><i {swatch}></i>{text(name)}</span>" for swatch, name in entries)
    return f'<div class="keys">{spans}</div>'


def _bars(bars: Bars) -> str:
    rows: list[str] = []
    for name, values in bars.rows:
        lines = "".join(
            f'<div class="bar-line"><i class="series{i}" '
            f'style="width:{100 * (value or 0):.1f}%"></i><b>{shown(value)}</b></div>'
            for i, value in enumerate(values)
        )
        rows.append(f'<div class="name">{text(name)}</div><div class="group">{lines}</div>')
    keys = _keys((f'class="series{i}"', name) for i, name in enumerate(bars.series))
    return f'{keys}<div class="bars">{"".join(rows)}</div>'


def _curves(curves: Curves) -> str:
    figures: list[str] = []
    for chart in curves.charts:
        names = [line.name for line in chart.lines]
        entries = ((f'class="series{i}"', name) for i, name in enumerate(names, start=1))
        key = _keys(entries) if len(names) > 1 else ""
        figures.append(
            f"<figure><figcaption>{text(chart.title)}</figcaption>{key}{chart_svg(chart)}</figure>"
        )
    return f'<div class="charts">{"".join(figures)}</div>'


def _legend(legend: Legend) -> str:
    entries: list[tuple[str, str]] = []
    for row in legend.classes.rows:
        named = not legend.with_ids or str(row.id) in row.name.split()
        swatch = f'style="background:{_rgb(colour_of(row.id, legend.classes))}"'
        entries.append((swatch, row.name if named else f"{row.id} {row.name}"))
    return _keys(entries)


def _rgb(colour: Colour) -> str:
    return f"rgb({','.join(map(str, colour))})"


# A picture stands in an element with the attribute ``popover``; a button over it makes the browser
# show that element above the page, and Escape puts it back. The bytes are in the page once.


_JPEG_QUALITY = 86
_SHORT = 8

_LEAST_WIDTH = {2: 30, 3: 20, 4: 17, 5: 13, 6: 11.5}
"""Least width of a picture, in letters' heights, where so many are to stand in one line."""


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


class PictureHtml:
    """The pictures of one page; each has an id of its own there."""

    def __init__(self) -> None:
        self._count = 0

    def gallery(self, gallery: Gallery) -> str:
        """Rows with a heading each, and under it their pictures with the columns' names."""
        rows: list[str] = []
        least = _LEAST_WIDTH.get(len(gallery.columns))
        width = "" if least is None else f' style="--least-width:{least}rem"'
        for label, panels in gallery.rows:
            shots = "".join(
                self._shot(panel, column, f"{label}: {panel.caption or column}")
                for panel, column in zip(panels, gallery.columns, strict=True)
            )
            head = f"<h3>{name_text(label)}</h3>"
            rows.append(f'<div class="row">{head}<div class="shots"{width}>{shots}</div></div>')
        return "".join(rows)

    def objects(self, gallery: ObjectGallery) -> str:
        """A list of objects."""
        cards = "".join(self._card(card) for card in gallery.cards)
        return f'<ul class="objects">{cards}</ul>'

    def scale(self, scale: Scale) -> str:
        """The shades from left to right, between what they stand for."""
        stops = ",".join(map(_rgb, SHADES))
        bar = f'<i style="background:linear-gradient(to right,{stops})"></i>'
        return f'<div class="scale"><b>{text(scale.low)}</b>{bar}<b>{text(scale.high)}</b></div>'

    def _shot(self, panel: GalleryImage, column: str, alternative: str) -> str:
        words = " \N{MIDDLE DOT} ".join(
            ([f"<b>{text(column)}</b>"] if column else [])
            + ([text(panel.caption)] if panel.caption else [])
        )
        caption = f"<figcaption>{words}</figcaption>" if words else ""
        return f"<figure>{self._frame(panel, alternative)}{caption}</figure>"

    def _frame(self, panel: GalleryImage, alternative: str) -> str:
        self._count += 1
        height, width = panel.image.shape[:2]
        name, words = f"p{self._count}", text(alternative)
        flat = ' class="flat"' if panel.kind == "chart" else ""
        return (
            f'<div class="frame" style="--aspect-ratio:{width}/{height}">'
            f'<div class="zoom" popover id="{name}"><img{flat} src="{data_uri(panel)}" '
            f'width="{width}" height="{height}" alt="{words}" loading="lazy">'
            f'<div class="bar"><span>{words}</span><button type="button" '
            f'popovertarget="{name}" popovertargetaction="hide">Close</button></div></div>'
            f'<button type="button" class="open" popovertarget="{name}" '
            f'aria-label="Enlarge {words}"></button></div>'
        )

    def _card(self, card: ObjectCard) -> str:
        title = f"{card.id} {card.name}".strip()
        if card.image is None:
            picture = '<div class="unseen">in no view that was looked at</div>'
        else:
            picture = self._frame(card.image, f"object {title}")
        swatch = f"background:{_rgb(card.colour)}"
        facts = "".join(_fact(name, value) for name, value in card.facts)
        return (
            f'<li id="object-{card.id}">{picture}<h3><i style="{swatch}"></i>'
            f"{name_text(title)}</h3><dl>{facts}</dl></li>"
        )


def _fact(name: str, value: str) -> str:
    """A short value beside its name; a long one, such as a file, alone on its line."""
    kind = ' class="long"' if len(value) > _SHORT else ""
    return f"<dt{kind}>{text(name)}</dt><dd{kind}>{name_text(value)}</dd>"
