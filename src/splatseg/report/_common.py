"""What several reports say in the same way."""

import os
import platform
from collections.abc import Sequence
from importlib import metadata
from typing import Any, TypeVar

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
