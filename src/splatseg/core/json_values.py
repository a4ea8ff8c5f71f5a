"""Values of JSON: numbers that are finite and bounded, and values that JSON can hold."""

import math
from collections.abc import Mapping, Sequence
from typing import TypeAlias, TypeGuard, cast

import numpy as np
from numpy.typing import NDArray

from splatseg.core.boundary import boundary
from splatseg.errors import FileFormatError, InputError, quoted

MAX_NUMBER = 1e30
"""Size of a number that is read where nothing tighter is known: its square fits float64, itself
float32."""

MAX_INTEGER = 2**63 - 1


def is_json_number(value: object) -> TypeGuard[float]:
    """Whether a value of a JSON document is a number that is finite and at most `MAX_NUMBER`."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) <= MAX_NUMBER  # never so of NaN and infinity


def json_number(
    value: object, *, where: str, low: float = -MAX_NUMBER, high: float = MAX_NUMBER
) -> float:
    """A real number of a JSON document.

    Args:
        value: What the document holds.
        where: The file and the place in it; starts the message.
        low: The least that it may be.
        high: The most.

    Raises:
        FileFormatError: If it is no number, NaN, infinite or out of these bounds.

    Example:
        >>> json_number(3, where="file: fl_x")
        3.0
    """
    if not is_json_number(value) or not low <= value <= high:
        bounds = "" if (low, high) == (-MAX_NUMBER, MAX_NUMBER) else f" in [{low:g}, {high:g}]"
        raise FileFormatError(f"{where}: expected a finite number{bounds}, got {quoted(value)}.")
    return float(value)


def json_integer(value: object, *, where: str, low: int = 0, high: int = MAX_INTEGER) -> int:
    """A whole number of a JSON document, which may be written 3 or 3.0.

    Raises:
        FileFormatError: If it is no whole number, or out of these bounds.

    Example:
        >>> json_integer(3.0, where="file: w")
        3
    """
    if isinstance(value, float) and abs(value) < MAX_INTEGER and value.is_integer():
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        bounds = f"of at least {low}" if high == MAX_INTEGER else f"in [{low}, {high}]"
        raise FileFormatError(f"{where}: expected a whole number {bounds}, got {quoted(value)}.")
    return value


def _is_no_number(entry: object) -> bool:
    return entry is None or (isinstance(entry, float) and not math.isfinite(entry))


def json_matrix(
    value: object, *, where: str, shapes: tuple[tuple[int, int], ...], finite: bool = True
) -> NDArray[np.float64]:
    """A matrix of a JSON document, a list of rows.

    Args:
        value: What the document holds.
        where: The file and the place in it; starts the message.
        shapes: Numbers of rows and columns that it may have.
        finite: Whether entries must be. Without, what is not, and null, as which some programs
            write it, is NaN.

    Raises:
        FileFormatError: If it is no matrix of such a shape, or an entry no (finite) number.
    """
    rows = cast("list[object]", value) if isinstance(value, list) else []
    expected = " or ".join(f"{height} x {width}" for height, width in shapes)
    for height, width in shapes:
        if len(rows) == height and all(
            isinstance(row, list) and len(cast("list[object]", row)) == width for row in rows
        ):
            entries = [
                [
                    math.nan
                    if not finite and _is_no_number(entry)
                    else json_number(entry, where=where)
                    for entry in cast("list[object]", row)
                ]
                for row in rows
            ]
            return np.array(entries, np.float64)
    raise FileFormatError(f"{where}: expected {expected} numbers, got {quoted(value)}.")


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
