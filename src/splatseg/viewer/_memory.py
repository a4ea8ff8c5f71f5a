"""Memory that was freed goes back to the system.

glibc keeps what is freed in its heaps, between things that stay, for the next of its size. With
pictures, masks and exports of all sizes the heaps would grow for hours. It gives whole pages back
when it is asked to, which takes some milliseconds.
"""

import ctypes
from collections.abc import Callable
from functools import cache

EVERY = 50
"""Answers after which memory is given back; after a job it always is."""


@cache
def _malloc_trim() -> Callable[[int], int] | None:
    try:
        return ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):
        return None  # another C library: macOS, Windows and musl do without


def give_back() -> bool:
    """Give freed memory back; whether there was any, False where the system has no way to."""
    trim = _malloc_trim()
    return trim is not None and bool(trim(0))
