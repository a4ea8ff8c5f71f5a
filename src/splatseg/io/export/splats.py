"""Labels in splat files: as columns of a PLY file with a table beside it, or a file an object.

An export replaces only what an export wrote.
"""

import re
import unicodedata
import warnings
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, cast

import torch
from torch import Tensor

from splatseg._check import check_choice
from splatseg.core import UNLABELLED, Gaussians, Labels, Selection
from splatseg.core.boundary import boundary
from splatseg.errors import FileFormatError, InputError, ShapeError
from splatseg.io.atomic import (
    atomic_file,
    atomic_folder,
    check_utf8,
    check_writable,
    is_vacant,
    sweep,
)
from splatseg.io.export.objects import MADE_BY, ObjectRow, object_content
from splatseg.io.foreign import expect
from splatseg.io.json_files import read_json, write_json
from splatseg.io.splats import SplatWarning, WritableFormat, write_splats


@boundary
def check_replaceable(path: Path, record: str) -> None:
    """Refuse a target that holds something other than an earlier export.

    Args:
        path: The folder to write.
        record: Name of the JSON file in it that says who made it.

    Raises:
        InputError: If it is a file, has no folder to be in, or holds other files.
    """
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: expected a folder to write to, got a file.")
    check_parent(path)
    what = "a new or empty folder or one that an earlier export made, got one with other files; "
    what += "choose another"
    ours = not path.is_dir() or is_vacant(path) or is_ours(path / record)
    expect(ours, path, what, error=InputError)


@boundary
def check_parent(path: Path) -> None:
    """Raise `InputError` unless `path` can be written: its folder is there, and lets us.

    What processes that were killed were writing there is cleared.
    """
    check_utf8(path)
    parent = path.absolute().parent
    if not parent.is_dir():
        raise InputError(f"{path}: expected an existing folder to write in.")
    check_writable(parent)
    sweep(parent)


def is_ours(path: Path) -> bool:
    """Whether a JSON file says that an export wrote it."""
    if not path.is_file():
        return False
    try:
        content = read_json(path)
    except FileFormatError:
        return False
    # Version 0.1 wrote tables of columns without the word.
    return content.get("made_by") == MADE_BY or {"gaussians", "columns"} <= set(content)


@contextmanager
def retold(temporary: Path, final: Path) -> Generator[None]:
    """Repeat each `SplatWarning` of the block with `final` in the place of `temporary`."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", SplatWarning)
        yield
    for warning in caught:
        text = str(warning.message).replace(str(temporary), str(final))
        warnings.warn(text, warning.category, stacklevel=4)


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
    if gaussians.chunks is not None:
        labelled = labelled.in_chunks(gaussians.chunks)  # no column that they read has changed
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
    what = "no file or a table of an earlier export, for what the ids mean; choose another name "
    what += f"than {path.name}"
    expect(not beside.exists() or is_ours(beside), beside, what, error=InputError)
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
    files = [f"{object_stem(row, digits=digits)}.{_ENDINGS[format]}" for row in rows]
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


def object_stem(row: ObjectRow, *, digits: int = 3) -> str:
    """A file name of ASCII letters, digits and hyphens that sorts by id."""
    plain = unicodedata.normalize("NFKD", row.name).encode("ascii", "ignore").decode().lower()
    words = re.sub(r"[^a-z0-9]+", "-", plain)[:_LONGEST_NAME].strip("-")
    return f"{row.id:0{digits}d}" + (f"_{words}" if words else "")
