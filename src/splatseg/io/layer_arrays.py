"""Arrays of a layer's file, checked before anything is made of them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg.errors import FileFormatError


def checked_array(
    path: Path,
    arrays: Mapping[str, NDArray[Any]],
    name: str,
    kind: str,
    shape: tuple[int | None, ...],
) -> NDArray[Any]:
    """An array of a layer after checking its type (exact, or its kind letter), shape, values."""
    array = arrays.get(name)
    if array is None:
        raise FileFormatError(f"{path}: expected an array {name!r}, which is not there.")
    fits = array.dtype.kind == kind if kind == "f" else array.dtype == np.dtype(kind)
    if (
        not fits
        or array.ndim != len(shape)
        or any(want not in (None, got) for want, got in zip(shape, array.shape, strict=True))
    ):
        wanted = ", ".join("any" if want is None else str(want) for want in shape)
        raise FileFormatError(
            f"{path}: expected {name!r} of type {kind} and shape ({wanted}), "
            f"got {array.dtype} of {array.shape}."
        )
    if kind.startswith("f"):
        bad = int(array.size - np.isfinite(array).sum())
        if bad:
            raise FileFormatError(
                f"{path}: expected finite {name!r}, got {bad} of {array.size} values that are NaN "
                "or infinite."
            )
    elif kind.startswith("i") and array.size and array.min() < 0:
        raise FileFormatError(f"{path}: expected {name!r} of 0 (none) or more, got {array.min()}.")
    return array
