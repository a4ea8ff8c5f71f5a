"""Words and numbers as pages and tables have them."""

import html
import os
import platform
import re
from collections.abc import Sequence
from importlib import metadata
from typing import Any, TypeVar

from splatseg.errors import visible


def count_text(count: int) -> str:
    """A count with thin spaces between thousands."""
    return f"{count:,}".replace(",", "\N{THIN SPACE}")


def counted(count: int, noun: str) -> str:
    """A count with its noun, in the plural where it is not one.

    Example:
        >>> counted(1, "view"), counted(3, "view")
        ('1 view', '3 views')
    """
    return f"{count_text(count)} {noun}" + ("" if count == 1 else "s")


# Words and numbers as a page writes them.


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


# What several reports say in the same way.


_T = TypeVar("_T")


def spread(items: Sequence[_T], count: int) -> tuple[_T, ...]:
    """At most `count` items, evenly spread over the whole."""
    kept = min(count, len(items))
    return tuple(items[i * len(items) // kept] for i in range(kept))


def environment() -> dict[str, Any]:
    """What a report was made with."""
    return {
        "splatseg": metadata.version("splatseg"),
        "torch": metadata.version("torch"),
        "Python": platform.python_version(),
        "cores": os.cpu_count(),
    }
