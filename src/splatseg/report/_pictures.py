"""Pictures inside a page: side by side, and enlarged without a script.

A picture stands in an element with the attribute ``popover``; a button over it makes the browser
show that element above the page, and Escape puts it back. The bytes are in the page once.
"""

import base64
import io

from PIL import Image

from splatseg.report._words import name_text, text
from splatseg.report.images import SHADES, Gallery, GalleryImage, ObjectCard, ObjectGallery, Scale

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
        stops = ",".join(f"rgb({red},{green},{blue})" for red, green, blue in SHADES)
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
        red, green, blue = card.colour
        title = f"{card.id} {card.name}".strip()
        if card.image is None:
            picture = '<div class="unseen">in no view that was looked at</div>'
        else:
            picture = self._frame(card.image, f"object {title}")
        swatch = f"background:rgb({red},{green},{blue})"
        facts = "".join(_fact(name, value) for name, value in card.facts)
        return (
            f'<li id="object-{card.id}">{picture}<h3><i style="{swatch}"></i>'
            f"{name_text(title)}</h3><dl>{facts}</dl></li>"
        )


def _fact(name: str, value: str) -> str:
    """A short value beside its name; a long one, such as a file, alone on its line."""
    kind = ' class="long"' if len(value) > _SHORT else ""
    return f"<dt{kind}>{text(name)}</dt><dd{kind}>{name_text(value)}</dd>"
