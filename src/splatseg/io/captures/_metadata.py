"""Reads metadata.json beside a capture: class names, the up axis and the unit of length."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from splatseg.core import ClassTable
from splatseg.core.boundary import boundary
from splatseg.io.json_files import read_json
from splatseg.io.tables import class_table

_UP_AXES = {
    f"{sign}{axis}": (
        (1.0 if sign == "+" else -1.0) * (axis == "x"),
        (1.0 if sign == "+" else -1.0) * (axis == "y"),
        (1.0 if sign == "+" else -1.0) * (axis == "z"),
    )
    for sign in "+-"
    for axis in "xyz"
}
_METRES = {
    "metres": 1.0,
    "meters": 1.0,
    "m": 1.0,
    "centimetres": 0.01,
    "cm": 0.01,
    "mm": 0.001,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Metadata:
    """What metadata.json says; None for what it leaves open."""

    classes: ClassTable | None = None
    tables: Mapping[str, ClassTable] = field(default_factory=dict[str, ClassTable])
    """Names of further kinds of ids: ``instances`` and ``parts``."""

    up: tuple[float, float, float] | None = None
    metres_per_unit: float | None = None


@boundary
def read_metadata(folder: Path) -> Metadata:
    """Metadata of a capture; all None where there is no metadata.json.

    Raises:
        FileFormatError: If metadata.json is there and broken, or its class table is.
    """
    path = folder / "metadata.json"
    if not path.is_file():
        return Metadata()
    content = read_json(path)
    return Metadata(
        tables={
            name: class_table(content[name], where=str(path))
            for name in ("instances", "parts")
            if isinstance(content.get(name), list)
        },
        classes=class_table(content["classes"], where=str(path)) if "classes" in content else None,
        up=_UP_AXES.get(_word(content, "up_axis")),
        metres_per_unit=_METRES.get(_word(content, "units")),
    )


def _word(content: Mapping[str, Any], key: str) -> str:
    value: object = content.get(key)
    return value if isinstance(value, str) else ""
