"""Numbers of JSON files: finite, bounded and of the type that is meant, or one clear error.

JSON has numbers of any size, and Python reads NaN, Infinity and 1e999 as well. Everything that
takes a number out of a file takes it from here.
"""

import math
from typing import TypeGuard, cast

import numpy as np
from numpy.typing import NDArray

from splatseg.errors import FileFormatError, quoted

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
