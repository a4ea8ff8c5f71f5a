"""`LayerInfo` as a JSON object, and records of all earlier versions; ``docs/formats.md``.

Version 1 has a key for each field that says something. Version 0 has no version: it is the
dictionary that layers carried before there was a `LayerInfo`, whose keys any method could choose.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, cast

from splatseg.core.json_values import JSON, plain_object
from splatseg.core.layer_info import InstanceFacts, LayerEdit, LayerEditName, LayerInfo
from splatseg.core.tree_levels import TREE_LEVELS
from splatseg.errors import FileFormatError, InputError

LAYER_INFO_VERSION = 1
"""Version of the records that are written; those up to it are read."""

_BY_ID = ("names", "source_ids", "class_of", "instances")
"""Tables whose keys are ids, which JSON writes as strings."""

_KNOWN = tuple(field.name for field in fields(LayerInfo))

_EDITS_OF_VERSION_0: dict[str, LayerEditName] = {
    "confusion": "correct_confusion",
    "completion": "complete",
    "panoptic": "merge_panoptic",
    "sharpened": "sharpen",
    "attached": "attach",
}
"""Keys of version 0 that became edits, in the order in which these are usually done."""


def layer_info_to_json(info: LayerInfo) -> dict[str, JSON]:
    """The record in values that JSON holds. Inverse of `layer_info_from_json`.

    Example:
        >>> layer_info_to_json(LayerInfo(method="vote", names={3: "cup"}))
        {'version': 1, 'method': 'vote', 'names': {'3': 'cup'}}
    """
    record: dict[str, JSON] = {"version": LAYER_INFO_VERSION}
    for name in _KNOWN:
        value = getattr(info, name)
        match name:
            case "views":
                value = None if value is None else list(value)
            case "source_ids":
                value = None if value is None else {str(id): own for id, own in value.items()}
            case "names" | "class_of":
                value = {str(id): entry for id, entry in value.items()} or None
            case "instances":
                value = {str(id): _facts_to_json(facts) for id, facts in value.items()} or None
            case "edits":
                value = [_edit_to_json(edit) for edit in value] or None
            case "options" | "versions" | "details":
                value = dict(value) or None
            case _:
                pass
        if value is not None:
            record[name] = value
    return plain_object("info", record)


def layer_info_from_json(record: Mapping[str, Any], *, where: str) -> LayerInfo:
    """The record that a JSON object holds. Inverse of `layer_info_to_json`.

    An object without a version is one of version 0 (`layer_info_from_metadata`). Keys that this
    version does not know are kept among the details.

    Args:
        record: The object.
        where: Where it stands; starts the message of an error.

    Raises:
        FileFormatError: If it is of a later version, or a key holds another type than it should.
    """
    if "version" not in record:
        return layer_info_from_metadata(record, where=where)
    version: object = record["version"]
    if isinstance(version, bool) or not isinstance(version, int) or version < 1:
        raise FileFormatError(f"{where}: expected a version of 1 or more, got {version!r}.")
    if version > LAYER_INFO_VERSION:
        raise FileFormatError(
            f"{where}: expected a record of version {LAYER_INFO_VERSION} or less, got version "
            f"{version}; a later splatseg wrote it."
        )
    values = {name: value for name, value in record.items() if name in _KNOWN}
    others = {name: value for name, value in record.items() if name not in (*_KNOWN, "version")}
    try:
        for name in _BY_ID:
            if name in values:
                values[name] = _by_id(name, values[name])
        if "instances" in values:
            values["instances"] = {
                id: _facts_from_json(f"instances[{id}]", facts)
                for id, facts in values["instances"].items()
            }
        if "edits" in values:
            values["edits"] = _edits_from_json(values["edits"])
        info = LayerInfo(**values)
        both = sorted(set(others) & set(info.details))
        if both:
            raise InputError(f"{both[0]}: expected it once, got it among the details as well.")
        return replace(info, details={**info.details, **others})
    except InputError as error:
        raise FileFormatError(f"{where}: {error}") from error


def layer_info_from_metadata(metadata: Mapping[str, Any], *, where: str) -> LayerInfo:
    """The record of a file of version 0, a flat object of any keys.

    Keys that splatseg wrote become fields and edits; all others, and those of its keys that hold
    another type than it wrote, were a method's own and become details.

    Raises:
        FileFormatError: If it holds what JSON has no word for, or is nested too deep.
    """
    values: dict[str, Any] = {}
    details = dict(metadata)

    def take(key: str, read: Callable[[Any], Any]) -> None:
        """Move a key to the fields, where it can be read."""
        if key not in details:
            return
        found = read(details[key])
        if found is not None:
            values[key] = found
            del details[key]

    for key in ("method", "evidence", "views_asked"):
        take(key, _word)
    for key in ("options", "head"):
        take(key, _object)
    take("seed", _whole)
    take("views", _words)
    take("versions", _versions)
    take("cut", _cut)
    take("view_correlation", _correlation)
    take("names", _names)
    take("class_of", _classes)
    take("source_ids", _classes)
    if details.get("view_correlation", 0) is None:
        del details["view_correlation"]
    edits: list[tuple[str, Any]] = []
    for key, name in _EDITS_OF_VERSION_0.items():
        if isinstance(details.get(key), Mapping):
            edits.append((name, details.pop(key)))
    if isinstance(details.get("merged_ids"), Mapping):
        edits.append(("merge", {"ids": details.pop("merged_ids")}))
    try:
        rows, others = _rows_of_instances(details.get("instances"))
        if rows:
            _add_rows(values, rows)
            details["instances"] = others
            if not others:
                del details["instances"]
        made = tuple(LayerEdit(name=name, details=said) for name, said in edits)
        return LayerInfo(**values, edits=made, details=details)
    except InputError as error:
        raise FileFormatError(f"{where}: {error}") from error


def _facts_to_json(facts: InstanceFacts) -> dict[str, JSON]:
    record: dict[str, JSON] = {}
    if facts.segments is not None:
        record["segments"] = facts.segments
    if facts.views is not None:
        record["views"] = facts.views
    if facts.stuff:
        record["stuff"] = True
    if facts.details:
        record["details"] = dict(facts.details)
    return record


def _edit_to_json(edit: LayerEdit) -> dict[str, JSON]:
    return {"name": edit.name, "details": dict(edit.details)}


def _by_id(name: str, value: object) -> dict[int, Any]:
    if not isinstance(value, Mapping):
        raise InputError(f"{name}: expected an object, got {type(value).__name__}.")
    table: dict[int, Any] = {}
    for key, entry in cast("Mapping[object, object]", value).items():
        id = _id(key)
        if id is None:
            raise InputError(f"{name}: expected ids of 0 or more as keys, got {key!r}.")
        table[id] = entry
    return table


def _id(key: object) -> int | None:
    """An id as JSON writes it as a key, in digits alone; None where it is something else."""
    text = str(key)
    return int(text) if text.isascii() and text.isdigit() and str(int(text)) == text else None


def _record(name: str, value: object, known: Sequence[str]) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise InputError(f"{name}: expected an object, got {type(value).__name__}.")
    record = dict(cast("Mapping[str, Any]", value))
    unknown = sorted(set(record) - set(known))
    if unknown:
        raise InputError(f"{name}: expected {', '.join(known)}, got {unknown[0]!r}.")
    return record


def _facts_from_json(name: str, value: object) -> InstanceFacts:
    try:
        return InstanceFacts(**_record(name, value, ("segments", "views", "stuff", "details")))
    except InputError as error:
        raise InputError(f"{name}: {error}") from error


def _edits_from_json(value: object) -> tuple[LayerEdit, ...]:
    if not isinstance(value, list):
        raise InputError(f"edits: expected a list, got {type(value).__name__}.")
    edits: list[LayerEdit] = []
    for i, entry in enumerate(cast("list[object]", value)):
        record = _record(f"edits[{i}]", entry, ("name", "details"))
        if "name" not in record:
            raise InputError(f"edits[{i}]: expected a name, got none.")
        try:
            edits.append(LayerEdit(**record))
        except InputError as error:
            raise InputError(f"edits[{i}]: {error}") from error
    return tuple(edits)


def _word(value: Any) -> str | None:
    return value if isinstance(value, str) else None


def _object(value: Any) -> dict[str, Any] | None:
    return dict(cast("Mapping[str, Any]", value)) if isinstance(value, Mapping) else None


def _whole(value: Any) -> int | None:
    return value if isinstance(value, int) and not isinstance(value, bool) else None


def _words(value: Any) -> tuple[str, ...] | None:
    if not isinstance(value, list):
        return None
    words = cast("list[Any]", value)
    return tuple(words) if all(isinstance(word, str) for word in words) else None


def _versions(value: Any) -> dict[str, str] | None:
    found = _object(value)
    fits = found is not None and all(isinstance(text, str) for text in found.values())
    return found if fits else None


def _cut(value: Any) -> str | float | None:
    if isinstance(value, str):
        return value if value in TREE_LEVELS else None
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return value if number and 0 <= value <= 1 else None


def _correlation(value: Any) -> float | None:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return value if number and value <= 1 else None


def _names(value: Any) -> dict[int, str] | None:
    found = _object(value)
    if found is None or any(_id(key) is None for key in found):
        return None
    return {int(key): str(name) for key, name in found.items()}


def _classes(value: Any) -> dict[int, int] | None:
    found = _object(value)
    if found is None or any(_id(key) is None for key in found):
        return None
    table = {int(key): _id(entry) for key, entry in found.items()}
    known = {id: entry for id, entry in table.items() if entry is not None}
    return known if len(known) == len(table) else None


def _rows_of_instances(value: object) -> tuple[dict[int, dict[str, Any]], list[Any]]:
    """Rows of instances by id, the last where there are several; and what is no such row."""
    rows: dict[int, dict[str, Any]] = {}
    others: list[Any] = []
    for entry in cast("list[Any]", value) if isinstance(value, list) else []:
        row = _object(entry)
        id = None if row is None else _whole(row.get("id"))
        if row is None or id is None or id < 0:
            others.append(entry)
            continue
        if id in rows:
            others.append(rows[id])
        rows[id] = row
    return rows, others


def _add_rows(values: dict[str, Any], rows: Mapping[int, dict[str, Any]]) -> None:
    """Rows of instances of version 0 to names, classes and facts by id."""
    names: dict[int, str] = {}
    classes: dict[int, int] = {}
    facts: dict[int, InstanceFacts] = {}
    for id, row in rows.items():
        own = {key: value for key, value in row.items() if key != "id"}
        if isinstance(own.get("name"), str):
            names[id] = own.pop("name")
        category = _whole(own.get("class"))
        if category is not None:
            del own["class"]
            # 0 and less stood for none.
            if category > 0:
                classes[id] = category
        known: dict[str, Any] = {}
        for key in ("segments", "views"):
            count = _whole(own.get(key))
            if count is not None and count >= 0:
                known[key] = own.pop(key)
        if isinstance(own.get("stuff"), bool):
            known["stuff"] = own.pop("stuff")
        facts[id] = InstanceFacts(**known, details=own)
    # The tables by id count where both say something.
    values["names"] = names | values.get("names", {})
    values["class_of"] = classes | values.get("class_of", {})
    values["instances"] = facts
