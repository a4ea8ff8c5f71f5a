"""The table of objects as CSV, for spreadsheets, and as JSON, for programs."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from splatseg.core import UNLABELLED
from splatseg.core.boundary import boundary
from splatseg.core.rigid import quaternion_from_rotation
from splatseg.errors import InputError
from splatseg.io.atomic import atomic_file
from splatseg.io.csv_files import csv_text
from splatseg.io.export._objects import ObjectRow
from splatseg.io.json_files import write_json

MADE_BY = "splatseg export"
_DIGITS = 6


@boundary
def write_object_table(
    rows: Sequence[ObjectRow],
    path: Path,
    *,
    about: Mapping[str, Any] | None = None,
    files: Mapping[int, str] | None = None,
) -> None:
    """Write a table of objects; atomic. The ending, .csv or .json, gives the format.

    Args:
        rows: The objects.
        path: The file.
        about: Further members of the JSON: scene, layers, units. CSV has no place for them.
        files: Where each object's splats are, by id. CSV has an empty cell for one without.

    Raises:
        InputError: If the name ends otherwise.
        MissingFileError: If the folder of `path` does not exist.
    """
    files = files or {}
    match path.suffix.lower():
        case ".json":
            objects = [
                object_content(row) | ({"file": files[row.id]} if row.id in files else {})
                for row in rows
            ]
            write_json({"made_by": MADE_BY} | dict(about or {}) | {"objects": objects}, path)
        case ".csv":
            _write_csv(rows, path, files)
        case _:
            raise InputError(f"{path}: expected a table's name to end in .csv or .json.")


@boundary
def object_content(row: ObjectRow) -> dict[str, Any]:
    """A row as JSON: lengths in scene units, quaternion (w, x, y, z) world_from_box."""
    return {
        "id": row.id,
        "name": row.name,
        "class_id": None if row.class_id == UNLABELLED else row.class_id,
        "class": row.class_name,
        "gaussians": row.gaussians,
        "centroid": _rounded(row.centroid.tolist()),
        "box": {
            "centre": _rounded(row.box.centre.tolist()),
            "size": _rounded(row.box.size.tolist()),
            "rotation": _rounded(quaternion_from_rotation(row.box.rotation).tolist()),
        },
        "volume": _figure(row.box.volume),
        "colour": [round(255 * value) for value in row.colour.tolist()],
        "confidence": _figure(row.confidence),
        "evidence": None if row.evidence is None else _figure(row.evidence),
        "inferred": None if row.inferred is None else _figure(row.inferred),
    }


def _write_csv(rows: Sequence[ObjectRow], path: Path, files: Mapping[int, str]) -> None:
    text = csv_text(
        _HEADER, ([*_cells(object_content(row)), files.get(row.id, "")] for row in rows)
    )
    # The byte order mark is what makes spreadsheets read names as UTF-8.
    with atomic_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8-sig", newline="")


_HEADER = (
    "id", "name", "class_id", "class", "gaussians", "centroid_x", "centroid_y", "centroid_z",
    "box_x", "box_y", "box_z", "size_1", "size_2", "size_3", "rot_w", "rot_x", "rot_y", "rot_z",
    "volume", "red", "green", "blue", "confidence", "evidence", "inferred", "file",
)  # fmt: skip


def _cells(content: Mapping[str, Any]) -> list[Any]:
    box = content["box"]
    return [
        content["id"], content["name"], content["class_id"], content["class"],
        content["gaussians"], *content["centroid"],
        *box["centre"], *box["size"], *box["rotation"], content["volume"],
        *content["colour"], content["confidence"], content["evidence"], content["inferred"],
    ]  # fmt: skip


def _rounded(values: Sequence[float]) -> list[float]:
    return [_figure(value) for value in values]


def _figure(value: float) -> float:
    """Six significant digits: more than what is measured, and the same on every machine."""
    return float(f"{value:.{_DIGITS}g}") + 0.0  # the sum turns -0.0 into 0.0
