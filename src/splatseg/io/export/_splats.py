"""One splat file an object, and the table of them."""

import re
import unicodedata
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from splatseg._check import check_choice
from splatseg.core import UNLABELLED, Gaussians, Labels
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, ShapeError
from splatseg.io.atomic import atomic_folder
from splatseg.io.export._columns import holds_columns
from splatseg.io.export._folders import check_replaceable
from splatseg.io.export._objects import ObjectRow
from splatseg.io.export._tables import MADE_BY, object_content
from splatseg.io.export._warnings import retold
from splatseg.io.json_files import write_json
from splatseg.io.splats import WritableFormat, write_splats

OBJECTS_FILE = "objects.json"
UNLABELLED_STEM = "unlabelled"

_LONGEST_NAME = 40
_ENDINGS: dict[WritableFormat, str] = {
    "ply": "ply",
    "compressed.ply": "compressed.ply",
    "splat": "splat",
    "spz": "spz",
    "spz3": "spz",
    "sog": "sog",
}


@boundary
def write_object_splats(
    gaussians: Gaussians,
    labels: Labels,
    folder: Path,
    *,
    rows: Sequence[ObjectRow],
    format: WritableFormat = "ply",
    columns: Mapping[str, Tensor] | None = None,
    about: Mapping[str, Any] | None = None,
    unlabelled: bool = False,
) -> tuple[Path, ...]:
    """Write a folder of splat files, one an object; it appears whole or not at all.

    ``FOLDER/007_red-chair.ply`` holds the Gaussians with id 7, in the order and at the place
    that they have in the scene. ``FOLDER/objects.json`` has the rows, each with its `file`.
    A folder of an earlier export is replaced as a whole.

    Args:
        gaussians: The Gaussians of the scene.
        labels: The layer whose ids are objects.
        folder: What to write.
        rows: The objects that are wanted, see `objects_of`.
        format: Of the files.
        columns: Columns for PLY files, one row a Gaussian of the scene; other formats go
            without.
        about: Further members of objects.json.
        unlabelled: Also write the Gaussians without an id, as ``unlabelled.ply``.

    Returns:
        The files, in the order of `rows`.

    Raises:
        InputError: If the folder holds something other than an earlier export, or a row's
            object has no Gaussians.
        ShapeError: If the layer has not one row a Gaussian.
    """
    check_choice("format", format, _ENDINGS)
    if len(labels) != len(gaussians):
        raise ShapeError(f"labels: expected {len(gaussians)} rows, got {len(labels)}.")
    check_replaceable(folder, OBJECTS_FILE)
    if columns and holds_columns(folder, format):
        gaussians = gaussians.replace(extra=dict(gaussians.extra) | dict(columns))
    ids = labels.ids.cpu()
    digits = max([3, *(len(str(row.id)) for row in rows)])
    files = [f"{_stem(row, digits)}.{_ENDINGS[format]}" for row in rows]
    with atomic_folder(folder) as temporary, retold(temporary, folder):
        for row, file in zip(rows, files, strict=True):
            members = torch.nonzero(ids == row.id).squeeze(1)
            if not len(members):
                raise InputError(f"rows: the layer has no Gaussian with the id {row.id}.")
            write_splats(gaussians[members], temporary / file, format=format)
        content: dict[str, Any] = {"made_by": MADE_BY} | dict(about or {})
        content["objects"] = [
            object_content(row) | {"file": file} for row, file in zip(rows, files, strict=True)
        ]
        left = torch.nonzero(ids == UNLABELLED).squeeze(1)
        rest = f"{UNLABELLED_STEM}.{_ENDINGS[format]}" if unlabelled and len(left) else None
        if rest is not None:
            write_splats(gaussians[left], temporary / rest, format=format)
        content["unlabelled"] = {"gaussians": len(left), "file": rest}
        write_json(content, temporary / OBJECTS_FILE)
    return tuple(folder / file for file in files)


def _stem(row: ObjectRow, digits: int) -> str:
    """A file name of ASCII letters, digits and hyphens that sorts by id."""
    plain = unicodedata.normalize("NFKD", row.name).encode("ascii", "ignore").decode().lower()
    words = re.sub(r"[^a-z0-9]+", "-", plain)[:_LONGEST_NAME].strip("-")
    return f"{row.id:0{digits}d}" + (f"_{words}" if words else "")
