"""How a layer was made, what its ids are called, what was done to it since, and all that as JSON.

Version 1 of the JSON has a key for each field that says something; version 0, of splatseg 0.1, was
a flat dictionary of any keys. ``docs/formats.md`` has both.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, Literal, TypeVar, cast, get_args

from msgspec import Meta

from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.json_values import JSON, MAX_DEPTH, id_of_key, plain_object
from splatseg.core.options import Natural
from splatseg.errors import FileFormatError, InputError, RangeError, quoted

TreeLevel = Literal["group", "object", "part"]
"""Levels from the root down. A table with what stands on it is a group, a lamp on it an object,
the shade of the lamp a part."""

TREE_LEVELS: tuple[TreeLevel, ...] = get_args(TreeLevel)

LEARNED_BYTES = "learned_bytes"
"""Among the details of a layer: bytes of all that its method trained, kept in it or not."""

LOSS_CURVE = "loss_curve"
"""Among the details of a trained layer: steps, and the mean loss of the part that ends there."""

LayerEditName = Literal[
    "correct_confusion", "complete", "merge_panoptic", "sharpen", "attach", "merge", "decompose"
]
"""What this library does to layers, by the names of its functions."""

_MAX_DEPTH = MAX_DEPTH - 10
"""Files hold a record within other groups."""

T = TypeVar("T")


@boundary
def tree_level(text: str) -> TreeLevel | float:
    """A level by name, or a granularity, as people write them.

    Raises:
        InputError: If it is neither.

    Example:
        >>> tree_level("part"), tree_level("0.25")
        ('part', 0.25)
    """
    if text in TREE_LEVELS:
        return text
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value <= 1:
        raise InputError(
            f"level: expected {', '.join(TREE_LEVELS)} or a number from 0 to 1, got {text!r}."
        )
    return value


@dataclass(frozen=True, slots=True, kw_only=True)
class InstanceFacts:
    """What an instance was made of."""

    segments: Natural | None = None
    """Masks that it was joined from; None where that is not known."""

    views: Natural | None = None
    """Views that these come from."""

    stuff: bool = False
    """Whether it is no thing but all of a class, such as the floor."""

    details: Mapping[str, JSON] = field(default_factory=dict[str, JSON])
    """What only the method itself knows of it."""

    def __post_init__(self) -> None:
        _copy_json(self, "details")
        convert_fields(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerEdit:
    """One thing that was done to a layer after it was made."""

    name: str = ""
    """What was done: one of `LayerEditName`, or the word of another package for it."""

    details: Mapping[str, JSON] = field(default_factory=dict[str, JSON])
    """Its options and what it changed."""

    def __post_init__(self) -> None:
        _copy_json(self, "details")
        convert_fields(self)
        if not self.name:
            raise InputError("name: expected what was done to the layer, got an empty word.")


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerInfo:
    """What is known of a layer beside its rows. Every field may be left out.

    Mappings are copied, in the types that JSON gives back, so that a record equals what is read
    from a file that it was written to.

    Raises:
        InputError: If a field has another type, or holds what JSON has no word for.
        RangeError: If an id or a count is negative, or a granularity is outside [0, 1].

    Example:
        >>> info = LayerInfo(method="associate", names={3: "cup"})
        >>> info.with_edit("complete", {"inferred": 20}).edit("complete")
        {'inferred': 20}
    """

    method: str | None = None
    """Name of the method that made it; None where that is not known."""

    options: Mapping[str, JSON] = field(default_factory=dict[str, JSON])
    """The method's options."""

    evidence: str | None = None
    """Name of the evidence that it was made from."""

    views: tuple[str, ...] | None = None
    """Names of the views that it was made from; None where that is not known."""

    views_asked: str | None = None
    """Views that were requested: ``train``, ``all``, or names of views by comma."""

    seed: int | None = None
    """Seed of random choices; None where none was given."""

    versions: Mapping[str, str] = field(default_factory=dict[str, str])
    """Versions of the programs that made it, by their names."""

    names: Mapping[int, str] = field(default_factory=dict[int, str])
    """What ids are called."""

    source_ids: Mapping[int, int] | None = None
    """What ids are in the files of the evidence; None where they are the same there."""

    class_of: Mapping[int, Natural] = field(default_factory=dict[int, int])
    """The class of instances, by id; one whose class is not known has no entry."""

    instances: Mapping[int, InstanceFacts] = field(default_factory=dict[int, InstanceFacts])
    """What instances were made of, by id."""

    cut: TreeLevel | float | None = None
    """The level or granularity of the tree that these labels are a cut of; None where they are
    none."""

    view_correlation: Annotated[float, Meta(le=1)] | None = None
    """How much better the nearest view predicts the votes of a held-out view than other views do,
    at most 1; None where it was not measured."""

    head: Mapping[str, JSON] | None = None
    """With features: what reads them, as `lift.label_maps.ClassifierHead.to_json` (ids) or
    `lift.affinity.AffinityHead.to_json` (what belongs together) writes it."""

    edits: tuple[LayerEdit, ...] = ()
    """What was done to it since, the first first."""

    details: Mapping[str, JSON] = field(default_factory=dict[str, JSON])
    """What only the method itself knows, under names of its own."""

    def __post_init__(self) -> None:
        _copy_json(self, "options", "head", "details")
        convert_fields(self)
        object.__setattr__(self, "versions", dict(self.versions))
        for name in self.versions:
            if not isinstance(name, str):  # pyright: ignore[reportUnnecessaryIsInstance]
                raise InputError(f"versions: expected keys that are strings, got {quoted(name)}.")
        for name in _BY_ID:
            table: Mapping[object, object] | None = getattr(self, name)
            if table is None:
                continue
            object.__setattr__(self, name, dict(table))
            for id in table:
                if isinstance(id, bool) or not isinstance(id, int) or id < 0:
                    raise InputError(
                        f"{name}: expected ids of 0 or more as keys, got {quoted(id)}."
                    )
        if isinstance(self.cut, (int, float)) and not 0 <= self.cut <= 1:
            raise RangeError(f"cut: expected a granularity from 0 to 1, got {self.cut}.")

    def edit(self, name: LayerEditName) -> Mapping[str, JSON] | None:
        """Details of the last edit of this name; None where there was none."""
        found = [edit.details for edit in self.edits if edit.name == name]
        return found[-1] if found else None

    def with_edit(self, name: LayerEditName, details: Mapping[str, JSON]) -> "LayerInfo":
        """The record with one more edit, which is the last."""
        return replace(self, edits=(*self.edits, LayerEdit(name=name, details=details)))


def _copy_json(record: object, *names: str) -> None:
    """Replace mappings by copies in the types that JSON gives back."""
    for name in names:
        value = getattr(record, name)
        if value is not None or name == "details":
            copy = plain_object(name, value, max_depth=_MAX_DEPTH)
            object.__setattr__(record, name, copy)


LAYER_INFO_VERSION = 1
"""Version of the records that are written; those up to it are read."""

_BY_ID = ("names", "source_ids", "class_of", "instances")
"""Tables whose keys are ids, which JSON writes as strings."""

_KNOWN = tuple(one.name for one in fields(LayerInfo))


@boundary
def layer_info_to_json(info: LayerInfo) -> dict[str, JSON]:
    """The record in values that JSON holds. Inverse of `layer_info_from_json`.

    Example:
        >>> layer_info_to_json(LayerInfo(method="vote", names={3: "cup"}))
        {'version': 1, 'method': 'vote', 'names': {'3': 'cup'}}
    """
    record: dict[str, object] = {"version": LAYER_INFO_VERSION}
    record |= _said(info)
    for name in ("views", "source_ids"):  # nothing is not the same as not known
        if getattr(info, name) is not None:
            record[name] = getattr(info, name)
    if info.edits:
        record["edits"] = [{"name": edit.name, "details": edit.details} for edit in info.edits]
    if info.instances:
        facts = {id: dict(_said(one)) for id, one in info.instances.items()}
        record["instances"] = {
            id: {key: value for key, value in one.items() if value is not False}
            for id, one in facts.items()
        }
    for name in _BY_ID:
        if name in record:
            table = cast("Mapping[int, object]", record[name])
            record[name] = {str(id): value for id, value in table.items()}
    return plain_object("info", record)


def _said(record: LayerInfo | InstanceFacts) -> Iterator[tuple[str, object]]:
    """Fields that say something."""
    for one in fields(record):
        value = getattr(record, one.name)
        if value is not None and value not in ({}, ()):
            yield one.name, value


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
    others = {name: value for name, value in record.items() if name not in (*_KNOWN, "version")}
    try:
        info = LayerInfo(**{name: _value(name, record[name]) for name in _KNOWN if name in record})
        both = sorted(set(others) & set(info.details))
        if both:
            raise InputError(f"{both[0]}: expected it once, got it among the details as well.")
        return replace(info, details={**info.details, **others})
    except InputError as error:
        raise FileFormatError(f"{where}: {error}") from error


def _value(name: str, value: object) -> Any:
    """The value of a field from JSON; `LayerInfo` checks what is in it."""
    if name == "edits":
        if not isinstance(value, list):
            raise InputError(f"edits: expected a list, got {type(value).__name__}.")
        entries = enumerate(cast("list[object]", value))
        return tuple(_part(LayerEdit, entry, f"edits[{i}]") for i, entry in entries)
    if name not in _BY_ID:
        return value
    table: dict[int, Any] = {}
    for key, entry in _mapping(name, value).items():
        id = id_of_key(key)
        if id is None:
            raise InputError(f"{name}: expected ids of 0 or more as keys, got {quoted(key)}.")
        table[id] = entry
    if name == "instances":
        return {id: _part(InstanceFacts, one, f"instances[{id}]") for id, one in table.items()}
    return table


def _mapping(name: str, value: object) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise InputError(f"{name}: expected an object, got {type(value).__name__}.")
    return dict(cast("Mapping[str, Any]", value))


def _part(kind: type[T], value: object, name: str) -> T:
    """An edit or the facts of an instance from a JSON object."""
    record = _mapping(name, value)
    known = [one.name for one in fields(cast("Any", kind))]
    unknown = sorted(set(record) - set(known))
    if unknown:
        raise InputError(f"{name}: expected {', '.join(known)}, got {quoted(unknown[0])}.")
    try:
        return kind(**record)
    except InputError as error:
        raise InputError(f"{name}: {error}") from error


_TAKEN = (
    "method", "evidence", "views_asked", "options", "head", "seed", "views", "versions", "cut",
    "view_correlation", "names", "class_of", "source_ids",
)  # fmt: skip
"""Keys of version 0 that are fields now."""

_EDITS_OF_VERSION_0: dict[str, LayerEditName] = {
    "confusion": "correct_confusion",
    "completion": "complete",
    "panoptic": "merge_panoptic",
    "sharpened": "sharpen",
    "attached": "attach",
    "merged_ids": "merge",
}
"""Keys of version 0 that became edits, in the order in which these are usually done."""


@boundary
def layer_info_from_metadata(metadata: Mapping[str, Any], *, where: str) -> LayerInfo:
    """The record of a file of version 0, a flat object of any keys.

    Keys that splatseg wrote become fields and edits; all others, and those of its keys that hold
    another type than it wrote, were a method's own and become details.

    Raises:
        FileFormatError: If it holds what JSON has no word for, or is nested too deep.
    """
    details = dict(metadata)
    values: dict[str, Any] = {}
    for name in _TAKEN:
        if name in details and _fits(name, details[name]):
            values[name] = _value_of_version_0(name, details.pop(name))
    if details.get("view_correlation", 0) is None:
        del details["view_correlation"]
    edits = [
        (name, {"ids": details.pop(key)} if key == "merged_ids" else details.pop(key))
        for key, name in _EDITS_OF_VERSION_0.items()
        if isinstance(details.get(key), Mapping)
    ]
    try:
        if isinstance(details.get("instances"), list):
            _take_instances(values, details)
        made = tuple(LayerEdit(name=name, details=said) for name, said in edits)
        return LayerInfo(**values, edits=made, details=details)
    except InputError as error:
        raise FileFormatError(f"{where}: {error}") from error


def _fits(name: str, value: object) -> bool:
    try:
        LayerInfo(**{name: _value_of_version_0(name, value)})
    except InputError:
        return False
    return value is not None


def _value_of_version_0(name: str, value: object) -> Any:
    """Names may be numbers there, and ids digits."""
    found = _value(name, value)
    if name == "names":
        return {id: str(text) for id, text in found.items()}
    if name in ("class_of", "source_ids"):
        return {id: id_of_key(other) for id, other in found.items()}
    return found


def _take_instances(values: dict[str, Any], details: dict[str, Any]) -> None:
    """Rows of instances of version 0 to names, classes and facts by id; the last of an id counts.

    What is no such row stays among the details.
    """
    rows: dict[int, dict[str, Any]] = {}
    others: list[Any] = []
    for entry in cast("list[Any]", details.pop("instances")):
        id = cast("dict[str, Any]", entry).get("id") if isinstance(entry, Mapping) else None
        if isinstance(id, bool) or not isinstance(id, int) or id < 0:
            others.append(entry)
            continue
        if id in rows:
            others.append(rows[id])
        rows[id] = dict(cast("Mapping[str, Any]", entry))
    if others or not rows:
        details["instances"] = others
    if not rows:
        return
    names: dict[int, str] = {}
    classes: dict[int, int] = {}
    facts: dict[int, InstanceFacts] = {}
    for id, row in rows.items():
        own = {key: value for key, value in row.items() if key != "id"}
        if isinstance(own.get("name"), str):
            names[id] = own.pop("name")
        if _is_whole(own.get("class")):
            category = own.pop("class")
            if category > 0:  # 0 and less stood for none
                classes[id] = category
        known = {
            key: own.pop(key)
            for key in ("segments", "views")
            if _is_whole(own.get(key)) and own[key] >= 0
        }
        if isinstance(own.get("stuff"), bool):
            known["stuff"] = own.pop("stuff")
        facts[id] = InstanceFacts(**known, details=own)
    # The tables by id count where both say something.
    values["names"] = names | values.get("names", {})
    values["class_of"] = classes | values.get("class_of", {})
    values["instances"] = facts


def _is_whole(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)
