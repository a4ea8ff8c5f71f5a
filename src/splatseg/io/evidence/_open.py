"""Finds evidence by name and tells its kind."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, cast

from splatseg.core import ClassTable
from splatseg.core.boundary import boundary
from splatseg.core.json_values import id_of_key
from splatseg.errors import InputError, MissingFileError, RangeError
from splatseg.io.arrays import npz_names
from splatseg.io.captures import read_metadata
from splatseg.io.depths import DEPTH_NAME
from splatseg.io.evidence._base import (
    HEADER_FILE,
    MAX_FILE_ID,
    Evidence,
    EvidenceKind,
    picture_files,
    view_files,
)
from splatseg.io.evidence._features import (
    BASIS_FILE,
    QUANTISATION_FILE,
    DepthEvidence,
    open_features,
)
from splatseg.io.evidence._labels import LABEL_NAMES, IdRule, LabelEvidence, Palette, is_soft
from splatseg.io.evidence._masks import MaskEvidence, holds_mask_rows, holds_masks, mask_folders
from splatseg.io.evidence._segments import SEGMENTS_FILE, TRACKS_FILE, open_tables
from splatseg.io.foreign import expect
from splatseg.io.json_files import check_version, read_json, read_json_value
from splatseg.io.label_tables import LabelTable, label_table, training_table
from splatseg.io.schema import structured
from splatseg.io.tables import class_table

FORMAT = "splatseg-evidence"
VERSION = 2
"""Highest version of the folders written; all versions up to it are read."""

_FEATURES_VERSION = 2  # files of features may hold several blocks and a class token

# Folders of a capture that hold what a model saw, as opposed to photographs and truth.
_PREFIXES = ("labels_", "masks_", "features_", "depth_")
_SUFFIX = "_reference"
# Maps of a capture whose ids are not classes, and the table in metadata.json that names them.
_TRUTH_TABLES = {"instance": "instances", "part": "parts", "depth": ""}


def written_version(kind: EvidenceKind) -> int:
    """The version of new folders: the lowest that has what they may hold."""
    return _FEATURES_VERSION if kind == "features" else 1


@boundary
def open_evidence(
    folder: Path | str,
    *,
    zero_is_class: bool = False,
    void: int | None = None,
    kind: EvidenceKind | None = None,
    suffix: str = "",
    classes: str | None = None,
    depth_unit: float | None = None,
    unfinished: Literal["refuse", "allow"] = "refuse",
) -> Evidence:
    """Open a folder of evidence, ours or recorded by others; no view is read yet.

    Names of ids come from its evidence.json, else from the metadata.json of the capture that
    the folder lies in. Label maps are PNG files, else ``.npy`` or npz files of ids or of scores
    (soft maps: probabilities or logits a class), whose highest class counts: its id is its
    channel plus 1, as with `zero_is_class`.

    Args:
        folder: The folder.
        zero_is_class: Of label maps whose 0 is a real class: every id grows by 1 in memory,
            and `Evidence.source_ids` tells the ids of the files.
        void: A further id of label maps that means none, such as 255.
        suffix: What stands between the name of a view and the ending of its file, such as
            ``_pred``; files without it are of no view.
        classes: Names of the ids of label maps, instead of those that the folder tells: a
            table by name or file, see `label_table`. It says what 0 means, and
            gives pictures of colours their ids.
        depth_unit: Metres of one step of depth maps that are images or ``.npy`` files; None says
            that those are relative. An npz tells its kind itself.
        kind: What it holds, where its files could be two things; None looks at them. A folder
            of folders of PNGs is label maps unless SAM's metadata.csv or this says masks; PNGs
            and ``.npy`` files are depth maps only where this says so.
        unfinished: Whether evidence may be opened whose views are not all there, because
            `splatseg see` was stopped.

    Raises:
        MissingFileError: If there is no such folder.
        InputError: If it holds no evidence, or unfinished evidence.
        FileFormatError: If a table in it is broken, or of a later version.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise MissingFileError(f"{folder}: there is no such folder of evidence.")
    header = _header(folder)
    if void is not None and not 0 <= void <= MAX_FILE_ID:
        raise InputError(f"void: expected an id in [0, {MAX_FILE_ID}], got {void}.")
    if zero_is_class and void == 0:
        raise InputError("void: expected another id than 0, which zero_is_class makes a class.")
    rule = IdRule(zero_is_class=zero_is_class, void=void)
    maps, arrays = picture_files(folder, suffix), view_files(folder, suffix + ".npz")
    objects = view_files(folder, suffix + ".json")
    if not maps and (kind is None or kind == "labels"):
        maps = _label_arrays(folder, suffix, arrays)
    if unfinished == "refuse":
        _check_finished(folder, header, views=max(len(maps), len(arrays), len(objects)))
    if kind is not None and header.get("kind", kind) != kind:
        raise InputError(f"{folder}: expected evidence of {kind}, got {header['kind']}.")
    found: str | None = kind or header.get("kind") or _kind(folder, maps, objects, arrays)
    if depth_unit is not None and found != "depth":
        raise InputError(f"depth_unit: goes with depth maps, {folder} has none.")
    if found == "depth":
        others = maps or view_files(folder, suffix + ".npy")
        _check_unit(folder, arrays, depth_unit)
        return DepthEvidence(folder=folder, files=arrays or others, unit=depth_unit)
    if found in ("labels", "panoptic", "tracked"):
        soft = bool(maps) and is_soft(next(iter(maps.values())))
        table = _named_table(classes, soft=soft)
        labels = LabelEvidence(
            folder=folder,
            files=maps,
            table=_classes(folder, header) if table is None else table.classes,
            rule=_rule(rule, table, soft=soft),
            palette=None if table is None else Palette(table.classes),
            channels=None if table is None else len(table.classes.rows),
            recorded=_recorded_ids(folder, header),
        )
        tracked = found == "tracked"
        return labels if found == "labels" else open_tables(labels, tracked=tracked)
    if classes is not None:
        raise InputError(f"classes: goes with label maps, {folder} has none.")
    if found == "masks":
        stacks = objects or arrays or view_files(folder, suffix + ".npy")
        files = stacks or mask_folders(folder, marked_by="*.png")
        return MaskEvidence(folder=folder, files=files)
    if found == "features":
        return open_features(folder, arrays)
    raise InputError(
        f"{folder}: expected evidence (PNG label maps, JSON masks, npz features or depths, one a "
        "view), got a folder of something else."
    )


def _check_unit(folder: Path, arrays: Mapping[str, Path], unit: float | None) -> None:
    if unit is not None and not (math.isfinite(unit) and unit > 0):
        raise RangeError(f"depth_unit: expected a number of metres above 0, got {unit:g}.")
    if unit is not None and arrays:
        raise InputError(
            f"depth_unit: goes with images and .npy files, got {folder}, whose npz files tell it."
        )


def _label_arrays(folder: Path, suffix: str, arrays: Mapping[str, Path]) -> Mapping[str, Path]:
    """Files of arrays that are label maps: ids or scores."""
    plain = view_files(folder, suffix + ".npy")
    if plain or not arrays:
        return plain
    names = npz_names(next(iter(arrays.values())))
    return arrays if any(name in names for name in LABEL_NAMES) else {}


def _named_table(classes: str | None, *, soft: bool) -> LabelTable | None:
    """The table that was asked for; of a soft map that with a class a channel, counted from 0."""
    if classes is None or not soft:
        return None if classes is None else label_table(classes)
    table = training_table(classes) or label_table(classes)
    if any(row.id == 0 for row in table.classes.rows):
        return table
    rows = tuple(replace(row, id=row.id - 1) for row in table.classes.rows)
    return replace(table, classes=ClassTable(rows=rows))


def _rule(rule: IdRule, table: LabelTable | None, *, soft: bool) -> IdRule:
    """What 0 and other ids mean: what was said, else what the table or a soft map says."""
    void = rule.void
    if void is None and table is not None:
        # A channel of a soft map can be that of nothing, of whatever other id none can.
        void = table.void if not soft else table.void_channel
    zero = rule.zero_is_class or soft or (table is not None and table.zero_is_class)
    return IdRule(zero_is_class=zero, void=void)


@boundary
def evidence_header(folder: Path | str) -> dict[str, Any] | None:
    """The evidence.json of a folder that splatseg wrote, None where there is none.

    ``metadata`` tells how it was made; ``metadata.complete`` is false while views are missing
    because the work was stopped.

    Raises:
        FileFormatError: If it is broken, or of a later version.
    """
    return _header(Path(folder)) or None


@boundary
def find_evidence(folders: Iterable[Path], name: str | None, *, option: str = "evidence") -> Path:
    """The folder of evidence of this name: in a scene's ``evidence``, or in a capture.

    Args:
        folders: Folders of scenes and captures, the one to prefer first.
        name: The folder's name, such as ``labels_semantic``. None takes the only one.
        option: What names it, for messages.

    Raises:
        InputError: If there is none, or no name and not just one; the message lists those that
            are there.
    """
    folders = tuple(folders)
    names = evidence_names(folders)
    known = ", ".join(names) or "there is none; `splatseg see` makes some"
    if name is None:
        if len(names) != 1:
            raise InputError(f"{option}: expected a name ({known}), got none.")
        name = names[0]
    for parent in folders:
        for folder in (parent / "evidence" / name, parent / name):
            if folder.is_dir():
                return folder
    raise InputError(f"{option}: expected one of those at hand ({known}), got {name!r}.")


@boundary
def evidence_names(folders: Iterable[Path]) -> tuple[str, ...]:
    """Names of the evidence of scenes and captures, sorted.

    Of a scene these are the folders in ``evidence``. Of a capture they are the folders called
    labels_..., masks_..., features_..., depth_... or ..._reference; truth and photographs are
    not evidence.
    """
    names: set[str] = set()
    for folder in folders:
        if (folder / "evidence").is_dir():
            names |= {p.name for p in (folder / "evidence").iterdir() if p.is_dir()}
        if folder.is_dir():
            names |= {
                p.name
                for p in folder.iterdir()
                if p.is_dir() and (p.name.startswith(_PREFIXES) or p.name.endswith(_SUFFIX))
            }
    return tuple(sorted(name for name in names if not name.startswith(".")))


def _header(folder: Path) -> dict[str, Any]:
    path = folder / HEADER_FILE
    if not path.is_file():
        return {}
    header = read_json(path)
    check_version(path, header, format=FORMAT, version=VERSION, what="evidence")
    return header


def _check_finished(folder: Path, header: Mapping[str, Any], *, views: int) -> None:
    metadata = header.get("metadata")
    if isinstance(metadata, dict) and cast(dict[str, Any], metadata).get("complete") is False:
        raise InputError(
            f"{folder}: expected all its views, got {views} of work that was stopped; give the "
            "same `splatseg see` again."
        )


def _kind(
    folder: Path, maps: Mapping[str, Path], objects: Mapping[str, Path], arrays: Mapping[str, Path]
) -> str | None:
    """The kind that files without a header show; the first one must hold what its kind has."""
    if maps and mask_folders(folder, marked_by="metadata.csv"):
        return "masks"
    if maps and holds_masks(next(iter(maps.values()))):
        return "masks"
    if maps:
        if (folder / SEGMENTS_FILE).is_file():
            return "panoptic"
        return "tracked" if (folder / TRACKS_FILE).is_file() else "labels"
    if objects and holds_mask_rows(read_json_value(next(iter(objects.values())))):
        return "masks"
    if (folder / QUANTISATION_FILE).is_file() or (folder / BASIS_FILE).is_file():
        return "features" if arrays else None
    if not arrays:
        return None
    first = next(iter(arrays.values()))
    names = npz_names(first)
    if "features" in names:
        return "features"
    return "masks" if holds_masks(first) else "depth" if DEPTH_NAME in names else None


def _classes(folder: Path, header: dict[str, Any]) -> ClassTable | None:
    if header.get("classes") is not None:
        return class_table(header["classes"], where=str(folder / HEADER_FILE))
    metadata = read_metadata(folder.absolute().parent)
    if folder.name in _TRUTH_TABLES:
        return metadata.tables.get(_TRUTH_TABLES[folder.name])
    return metadata.classes


def _recorded_ids(folder: Path, header: dict[str, Any]) -> dict[int, int] | None:
    recorded = header.get("source_ids")
    if recorded is None:
        return None
    where = f"{folder / HEADER_FILE}: source_ids"
    ids = {
        id_of_key(key): id for key, id in structured(recorded, dict[str, int], where=where).items()
    }
    expect(None not in ids, where, "integers by integer", recorded)
    return {key: id for key, id in ids.items() if key is not None}
