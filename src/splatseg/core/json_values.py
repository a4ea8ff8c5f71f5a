"""Values that JSON holds, checked before they are kept or written."""

import math
from collections.abc import Mapping, Sequence
from typing import TypeAlias, cast

from splatseg.core.boundary import boundary
from splatseg.errors import InputError, quoted

JSON: TypeAlias = "bool | int | float | str | Sequence[JSON] | Mapping[str, JSON] | None"
"""What JSON has a word for; numbers are finite, keys are strings."""

MAX_DEPTH = 100
"""Groups in each other that a file may hold."""


_MAX_DIGITS = 18
"""Of an id, which has 64 bits at most."""


@boundary
def plain_json(name: str, value: object, *, max_depth: int = MAX_DEPTH) -> JSON:
    """A copy in the types that JSON gives back: dicts, and lists for tuples.

    Args:
        name: What the value is called; starts the message of an error.
        value: The value.
        max_depth: How many groups may lie in each other.

    Raises:
        InputError: If it holds a key that is no string, NaN, infinity, an object that JSON has no
            word for, or groups deeper than that.

    Example:
        >>> plain_json("options", {"sizes": (1, 2.5)})
        {'sizes': [1, 2.5]}
    """
    return _plain(name, value, max_depth, max_depth)


@boundary
def plain_object(name: str, value: object, *, max_depth: int = MAX_DEPTH) -> dict[str, JSON]:
    """A copy of a mapping as JSON holds it, see `plain_json`.

    Raises:
        InputError: Also if it is no mapping.
    """
    if not isinstance(value, Mapping):
        raise InputError(f"{name}: expected a mapping, got {type(value).__name__}.")
    values = cast("Mapping[object, object]", value)
    return cast("dict[str, JSON]", plain_json(name, values, max_depth=max_depth))


def id_of_key(key: object) -> int | None:
    """An id as JSON writes it as a key, in digits alone; None where it is something else."""
    text = str(key)
    digits = text.isascii() and text.isdigit() and len(text) <= _MAX_DIGITS
    return int(text) if digits and str(int(text)) == text else None


def _plain(name: str, value: object, depth: int, max_depth: int) -> JSON:
    if depth < 0:
        raise InputError(f"{name}: expected values at most {max_depth} deep, got deeper ones.")
    if isinstance(value, Mapping):
        entries: dict[str, JSON] = {}
        for key, entry in cast("Mapping[object, object]", value).items():
            if not isinstance(key, str):
                raise InputError(f"{name}: expected keys that are strings, got {quoted(key)}.")
            # Names are made where they may be needed: layers hold tables of many numbers.
            entries[key] = (
                cast("JSON", entry)
                if _is_scalar(entry)
                else _plain(f"{name}.{key}", entry, depth - 1, max_depth)
            )
        return entries
    if isinstance(value, (list, tuple)):
        items = cast("Sequence[object]", value)
        return [
            cast("JSON", entry)
            if _is_scalar(entry)
            else _plain(f"{name}[{i}]", entry, depth - 1, max_depth)
            for i, entry in enumerate(items)
        ]
    if _is_scalar(value):
        return cast("JSON", value)
    if isinstance(value, float):
        raise InputError(f"{name}: expected a finite number, got {value}.")
    raise InputError(
        f"{name}: expected a value that JSON holds, got one of type {type(value).__name__}."
    )


def _is_scalar(value: object) -> bool:
    """Whether JSON has a word for it that holds nothing else."""
    if isinstance(value, float):
        return math.isfinite(value)
    return value is None or isinstance(value, (str, int))
