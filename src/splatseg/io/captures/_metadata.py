"""Reads metadata.json beside a capture: class names, the up axis and the unit of length."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from splatseg.core import ClassInfo, ClassTable
from splatseg.errors import FileFormatError, MissingFileError

_UP_AXES = {
    f"{sign}{axis}": (
        (1.0 if sign == "+" else -1.0) * (axis == "x"),
        (1.0 if sign == "+" else -1.0) * (axis == "y"),
        (1.0 if sign == "+" else -1.0) * (axis == "z"),
    )
    for sign in "+-"
    for axis in "xyz"
}
_METRES = {"metres": 1.0, "meters": 1.0, "m": 1.0, "centimetres": 0.01, "cm": 0.01, "mm": 0.001}


@dataclass(frozen=True, slots=True, kw_only=True)
class Metadata:
    """What metadata.json says; None for what it leaves open."""

    classes: ClassTable | None = None
    up: tuple[float, float, float] | None = None
    metres_per_unit: float | None = None


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object from a file.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is not JSON, or holds something other than an object.
    """
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise MissingFileError(f"{path}: there is no such file.") from error
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise FileFormatError(
            f"{path}: expected JSON, but it cannot be parsed ({error})."
        ) from error
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read ({error.strerror}).") from error
    if not isinstance(value, dict):
        raise FileFormatError(f"{path}: expected a JSON object, got {type(value).__name__}.")
    return cast(dict[str, Any], value)


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
        classes=class_table(content["classes"], where=str(path)) if "classes" in content else None,
        up=_UP_AXES.get(str(content.get("up_axis", ""))),
        metres_per_unit=_METRES.get(str(content.get("units", ""))),
    )


def class_table(rows: object, *, where: str) -> ClassTable:
    """A class table from its JSON rows ``{id, name, isthing, colour}``; the last two may lack.

    A row of id 0 is left out: 0 is void in files.

    Raises:
        FileFormatError: If a row has no integer id or no name; the message starts with `where`.
    """
    if not isinstance(rows, list):
        raise FileFormatError(f"{where}: expected a list of classes, got {type(rows).__name__}.")
    table: list[ClassInfo] = []
    for i, row in enumerate(cast(list[object], rows)):
        table.append(_class_info(row, where=f"{where}: classes[{i}]"))
    return ClassTable(rows=tuple(row for row in table if row.id != 0))


def class_rows(table: ClassTable) -> list[dict[str, Any]]:
    """JSON rows of a class table. Inverse of `class_table`."""
    return [
        {
            "id": row.id,
            "name": row.name,
            "isthing": row.isthing,
            **({} if row.colour is None else {"colour": list(row.colour)}),
        }
        for row in table.rows
    ]


def _class_info(row: object, *, where: str) -> ClassInfo:
    if not isinstance(row, dict):
        raise FileFormatError(f"{where}: expected an object, got {type(row).__name__}.")
    entry = cast(dict[str, Any], row)
    id, name, colour = entry.get("id"), entry.get("name"), entry.get("colour")
    if isinstance(id, bool) or not isinstance(id, int) or not isinstance(name, str):
        raise FileFormatError(f"{where}: expected an integer id and a name, got {entry!r:.80}.")
    if colour is not None:
        values = cast(list[object], colour) if isinstance(colour, list) else []
        if len(values) != 3 or not all(isinstance(v, int) and 0 <= v <= 255 for v in values):
            raise FileFormatError(f"{where}: expected a colour of three bytes, got {colour!r:.80}.")
        colour = cast(tuple[int, int, int], tuple(values))
    return ClassInfo(id=id, name=name, isthing=bool(entry.get("isthing", True)), colour=colour)
