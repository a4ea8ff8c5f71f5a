"""`LayerInfo` as a JSON object, and records of all earlier versions; ``docs/formats.md``.

Version 1 has a key for each field that says something; version 0 is in `layer_info_version_0`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, cast

from splatseg.core.boundary import boundary
from splatseg.core.json_values import JSON, id_of_key, plain_object
from splatseg.core.layer_info import InstanceFacts, LayerEdit, LayerInfo
from splatseg.core.layer_info_version_0 import layer_info_from_metadata
from splatseg.errors import FileFormatError, InputError, quoted

LAYER_INFO_VERSION = 1
"""Version of the records that are written; those up to it are read."""

_BY_ID = ("names", "source_ids", "class_of", "instances")
"""Tables whose keys are ids, which JSON writes as strings."""

_KNOWN = tuple(field.name for field in fields(LayerInfo))


@boundary
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


@boundary
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
        raise FileFormatError(f"{where}: expected a version of 1 or more, got {quoted(version)}.")
    if version > LAYER_INFO_VERSION:
        raise FileFormatError(
            f"{where}: expected a record of version {LAYER_INFO_VERSION} or less, got version "
            f"{quoted(version)}; a later splatseg wrote it."
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
        id = id_of_key(key)
        if id is None:
            raise InputError(f"{name}: expected ids of 0 or more as keys, got {quoted(key)}.")
        table[id] = entry
    return table


def _record(name: str, value: object, known: Sequence[str]) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise InputError(f"{name}: expected an object, got {type(value).__name__}.")
    record = dict(cast("Mapping[str, Any]", value))
    unknown = sorted(set(record) - set(known))
    if unknown:
        raise InputError(f"{name}: expected {', '.join(known)}, got {quoted(unknown[0])}.")
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
