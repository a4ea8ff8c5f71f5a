"""Doors from values to packages above them, for people who explore in a notebook.

`View.read_image`, `Scene.layers` and the previews that notebooks ask for need files and pictures,
which the core knows nothing of. They are looked up when somebody opens the door; nothing of the
core's own work goes through one. Decision 0024.
"""

import importlib
from typing import Any


def late(package: str, name: str) -> Any:
    """The function `name` of a package of splatseg that stands above the core."""
    return getattr(importlib.import_module(f"splatseg.{package}"), name)


def preview(value: object) -> str:
    """The HTML by which a notebook shows a value."""
    return str(late("report.notebook", "preview_html")(value))
