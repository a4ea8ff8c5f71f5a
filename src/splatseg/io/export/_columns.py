"""Labels as columns of a PLY file, and the table beside it that says what the ids mean."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, cast

import torch
from torch import Tensor

from splatseg.core import UNLABELLED, Gaussians, Labels, Selection
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.io.atomic import atomic_file
from splatseg.io.export._folders import check_parent, is_ours
from splatseg.io.export._tables import MADE_BY
from splatseg.io.export._warnings import retold
from splatseg.io.json_files import read_json, write_json
from splatseg.io.splats import WritableFormat, write_splats

NONE = 0
"""The id of no label, in files."""


@boundary
def label_columns(
    layer: Labels | Selection, kind: Literal["class", "instance"] = "class"
) -> dict[str, Tensor]:
    """A layer as columns: ``class_id`` (int32, 0 for none) and ``confidence`` (float32).

    Of kind ``instance`` they are ``instance_id`` and ``instance_confidence``. A selection is
    the column ``selected`` (int32, 1 or 0), and ``selected_confidence`` (float32, the probability
    that a Gaussian belongs to it) where it has one.
    """
    if isinstance(layer, Selection):
        columns = {"selected": layer.mask.to(torch.int32)}
        if layer.confidence is not None:
            columns["selected_confidence"] = layer.confidence.float()
        return columns
    confidence = "confidence" if kind == "class" else "instance_confidence"
    return {
        f"{kind}_id": torch.where(layer.ids == UNLABELLED, NONE, layer.ids).int(),
        confidence: layer.confidence.float(),
    }


@boundary
def write_labelled_splats(
    gaussians: Gaussians,
    path: Path,
    *,
    columns: Mapping[str, Tensor],
    table: Mapping[str, Any] | None = None,
    format: WritableFormat | None = None,
) -> Path | None:
    """Write Gaussians with columns, and the table of what they mean: both appear or neither.

    Args:
        gaussians: What to write; of columns with the same name those in `columns` count.
        path: The splat file. Only PLY holds columns.
        columns: By name, one row a Gaussian.
        table: Content of the JSON file beside it, None for no such file.
        format: The file's format, where its name does not say.

    Returns:
        The table's path, or None.

    Raises:
        InputError: If the format holds no columns, or the table would replace a file that no
            export wrote.
        MissingFileError: If the folder of `path` does not exist.
    """
    if columns and not holds_columns(path, format):
        raise InputError(
            f"{path}: labels need a .ply file, other formats drop them; `splatseg attach` finds "
            "them again."
        )
    check_parent(path)
    labelled = gaussians.replace(extra=dict(gaussians.extra) | dict(columns))
    if table is None:
        write_splats(labelled, path, format=format)
        return None
    beside = check_beside(path)
    with atomic_file(path) as temporary:
        with retold(temporary.parent, path.parent):
            write_splats(labelled, temporary, format=format)
        write_column_table(table, beside)
    return beside


@boundary
def check_beside(path: Path) -> Path:
    """Where the table of what columns mean goes: ``FILE.json`` beside ``FILE.ply``.

    Raises:
        InputError: If a file is there that no export wrote.
    """
    beside = path.with_suffix(".json")
    if beside.exists() and not is_ours(beside):
        raise InputError(
            f"{beside}: expected no file or a table of an earlier export, for what the ids mean; "
            f"choose another name than {path.name}."
        )
    return beside


@boundary
def column_table_of(path: Path) -> dict[str, Any]:
    """What the columns of a splat file mean, as the table beside it says; empty without one."""
    beside = path.with_suffix(".json")
    if not is_ours(beside):
        return {}
    columns = read_json(beside).get("columns")
    return dict(cast("Mapping[str, Any]", columns)) if isinstance(columns, Mapping) else {}


@boundary
def write_column_table(content: Mapping[str, Any], path: Path) -> None:
    """Write the table of what columns mean; atomic."""
    write_json({"made_by": MADE_BY} | dict(content), path)


def holds_columns(path: Path, format: WritableFormat | None) -> bool:
    """Whether a splat file has place for further columns."""
    name = path.name.lower()
    by_name = name.endswith(".ply") and not name.endswith(".compressed.ply")
    return by_name if format is None else format == "ply"
