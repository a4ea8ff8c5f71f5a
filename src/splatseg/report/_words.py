"""Words and numbers as a page writes them."""

import html
import re
from typing import Any

from splatseg.errors import visible

_LONG = 24
_BREAKS = re.compile(r"(?<=[_/\-])(?=\w)|(?<=\.)(?=[A-Za-z])")


def text(words: str) -> str:
    """Words, escaped; control characters and marks of direction are seen (`errors.visible`)."""
    return html.escape(visible(words), quote=True)


def name_text(name: str) -> str:
    """A name, escaped; a long one may be broken after ``_``, ``-``, ``/``, and at its ending.

    Example:
        >>> name_text("a_1")
        'a_1'
        >>> name_text("walk-through_of_the_house_0012")
        'walk-<wbr>through_<wbr>of_<wbr>the_<wbr>house_<wbr>0012'
    """
    if len(name) <= _LONG:
        return text(name)
    return "<wbr>".join(text(part) for part in _BREAKS.split(name))


def shown(value: Any) -> str:
    """A cell: None as a dash, a fraction with three digits."""
    if value is None:
        return "\N{EN DASH}"
    if isinstance(value, float):
        return f"{value:.3f}" if abs(value) < 100 else f"{value:.0f}"
    return str(value)
