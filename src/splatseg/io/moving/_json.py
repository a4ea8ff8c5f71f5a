"""Boxes of moving things in a JSON file of our own.

    {"boxes": [{"centre": [x, y, z], "size": [x, y, z], "rotation": [w, x, y, z],
                "start": 12, "end": 12.5, "name": "car 3"}, ...]}

World and scene units of the capture; ``rotation`` is world_from_box, and without it a box lies
along the axes of the world. ``time`` may stand for a ``start`` and ``end`` that are equal; without
any a box is always there.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import torch

from splatseg.core.boundary import boundary
from splatseg.core.json_values import json_matrix, json_number
from splatseg.core.moving import MovingBox
from splatseg.errors import FileFormatError, quoted
from splatseg.io.foreign import made_from
from splatseg.io.json_files import read_json, write_json

_KEYS = ("centre", "size", "rotation", "start", "end", "time", "name")
_UPRIGHT = [1.0, 0.0, 0.0, 0.0]


def read_json_boxes(path: Path) -> tuple[MovingBox, ...]:
    """The boxes of a file, in its order.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no file of boxes, or one of them cannot be.
    """
    rows = read_json(path).get("boxes")
    if not isinstance(rows, list):
        raise FileFormatError(f"{path}: expected a list of boxes of moving things, got none.")
    return tuple(
        _box(row, where=f"{path}: boxes[{i}]") for i, row in enumerate(cast("list[object]", rows))
    )


@boundary
def write_moving(boxes: Sequence[MovingBox], path: Path) -> None:
    """Write boxes to a file that `read_moving` reads; atomic.

    Raises:
        OutputError: If it cannot be written.
    """
    write_json({"boxes": [_row(box) for box in boxes]}, path)


def _row(box: MovingBox) -> dict[str, Any]:
    row: dict[str, Any] = {
        "centre": box.centre.tolist(),
        "size": list(box.size),
        "rotation": box.rotation.tolist(),
    }
    row |= {k: t for k, t in (("start", box.start), ("end", box.end)) if math.isfinite(t)}
    return row | ({"name": box.name} if box.name else {})


def _box(row: object, *, where: str) -> MovingBox:
    if not isinstance(row, dict):
        raise FileFormatError(f"{where}: expected an object with centre and size, got something.")
    values = cast("dict[str, object]", row)
    strange = sorted(set(values) - set(_KEYS))
    if strange:
        raise FileFormatError(
            f"{where}: expected keys of {', '.join(_KEYS)}, got {quoted(strange[0])}."
        )
    if "time" in values and ("start" in values or "end" in values):
        raise FileFormatError(f"{where}: expected a time, or a start and an end, got both.")
    name = values.get("name", "")
    if not isinstance(name, str):
        raise FileFormatError(f"{where}: expected a name, got {quoted(name)}.")
    start, end = (values.get(key, values.get("time")) for key in ("start", "end"))
    size = _numbers(values.get("size"), 3, where=f"{where}: size")
    with made_from(where):
        return MovingBox(
            centre=torch.tensor(
                _numbers(values.get("centre"), 3, where=f"{where}: centre"), dtype=torch.float64
            ),
            size=(size[0], size[1], size[2]),
            rotation=torch.tensor(
                _numbers(values.get("rotation", _UPRIGHT), 4, where=f"{where}: rotation"),
                dtype=torch.float64,
            ),
            start=-math.inf if start is None else json_number(start, where=f"{where}: start"),
            end=math.inf if end is None else json_number(end, where=f"{where}: end"),
            name=name,
        )


def _numbers(value: object, count: int, *, where: str) -> list[float]:
    return json_matrix([value], where=where, shapes=((1, count),))[0].tolist()
