"""Records of version 0: the flat dictionary that layers had before there was a `LayerInfo`.

Any method could choose its keys, and nothing checked what they hold. ``docs/formats.md`` says what
becomes of each.
"""

from collections.abc import Callable, Mapping
from typing import Any, cast

from splatseg.core.boundary import boundary
from splatseg.core.json_values import id_of_key
from splatseg.core.layer_info import InstanceFacts, LayerEdit, LayerEditName, LayerInfo
from splatseg.core.tree_levels import TREE_LEVELS
from splatseg.errors import FileFormatError, InputError

_EDITS_OF_VERSION_0: dict[str, LayerEditName] = {
    "confusion": "correct_confusion",
    "completion": "complete",
    "panoptic": "merge_panoptic",
    "sharpened": "sharpen",
    "attached": "attach",
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
    if found is None or any(id_of_key(key) is None for key in found):
        return None
    return {int(key): str(name) for key, name in found.items()}


def _classes(value: Any) -> dict[int, int] | None:
    found = _object(value)
    if found is None or any(id_of_key(key) is None for key in found):
        return None
    table = {int(key): id_of_key(entry) for key, entry in found.items()}
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
