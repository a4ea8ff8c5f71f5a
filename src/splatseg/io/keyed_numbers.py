"""Text files of named rows of numbers, ``NAME: 1 2 3``: calibrations of KITTI and KITTI-360."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatseg.errors import FileFormatError, quoted
from splatseg.io.foreign import read_lines

_EXPECTED = "a calibration of rows NAME: numbers"


def read_keyed_numbers(path: Path) -> dict[str, NDArray[np.float64]]:
    """Numbers by name; rows of other words, such as a date, are left out.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no text.
    """
    found: dict[str, NDArray[np.float64]] = {}
    for line in read_lines(path, _EXPECTED):
        name, colon, rest = line.partition(":")
        try:
            values = [float(word) for word in rest.split()]
        except ValueError:
            continue
        if colon and values:
            found[name.strip()] = np.array(values)
    return found


def keyed_matrix(
    rows: Mapping[str, NDArray[np.float64]], name: str, shape: tuple[int, int], *, path: Path
) -> NDArray[np.float64]:
    """One of them as a matrix.

    Raises:
        FileFormatError: If there is none of that name, it has more or fewer numbers, or one of
            them is NaN or infinite.
    """
    if name not in rows:
        known = quoted(", ".join(rows)) if rows else "nothing"
        raise FileFormatError(f"{path}: expected a row {name}, got {known}.")
    return shaped(rows[name], shape, where=f"{path}: {name}")


def shaped(
    values: NDArray[np.float64], shape: tuple[int, int], *, where: str
) -> NDArray[np.float64]:
    """A row of numbers as a matrix.

    Raises:
        FileFormatError: If it has more or fewer numbers, or one of them is NaN or infinite.
    """
    if values.size != shape[0] * shape[1]:
        raise FileFormatError(
            f"{where}: expected {shape[0]} x {shape[1]} numbers, got {values.size}."
        )
    if not np.isfinite(values).all():
        raise FileFormatError(f"{where}: expected finite numbers, got NaN or infinity.")
    return values.reshape(shape)


def rigid(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """The 4 x 4 transform of its first three rows (3 x 4)."""
    return np.vstack((rows, [0.0, 0.0, 0.0, 1.0]))
