"""Files that are nothing but numbers, so many a point: the length is all that can be checked."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatseg.errors import FileFormatError
from splatseg.io.foreign import read_bytes


def read_records(path: Path, columns: int) -> NDArray[np.float32]:
    """Rows of float32, little endian.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If its last row is cut short.
    """
    content = read_bytes(path, "points of float32")
    width = 4 * columns
    if len(content) % width:
        raise FileFormatError(
            f"{path}: expected points of {columns} float32, {width} bytes each, got "
            f"{len(content)} bytes; the file is cut short or of another format."
        )
    return np.frombuffer(content, "<f4").reshape(-1, columns).astype(np.float32)


def read_ids(path: Path, code: str, *, points: int) -> NDArray[np.int64]:
    """One whole number a point.

    Args:
        path: The file.
        code: NumPy's code of a number, such as ``<u4``.
        points: How many there must be.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If there are more or fewer.
    """
    width = np.dtype(code).itemsize
    content = read_bytes(path, "a label a point")
    if len(content) != width * points:
        count = f"{len(content) / width:g}"
        raise FileFormatError(f"{path}: expected {points} labels, one a point, got {count}.")
    return np.frombuffer(content, code).astype(np.int64)
