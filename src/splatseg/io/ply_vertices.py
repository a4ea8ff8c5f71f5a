"""Vertices of PLY files: the columns of the element ``vertex``, positions among them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg.errors import FileFormatError, quoted
from splatseg.io.ply import read_ply_header, read_ply_tables

Columns = Mapping[str, NDArray[Any]]


def ply_columns(path: Path) -> tuple[str, ...]:
    """Names of the columns of all elements of a PLY file, from its header alone.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If its header is not one of a PLY file.
    """
    elements = read_ply_header(path).elements
    return tuple(one.name for element in elements for one in element.properties)


def read_ply_vertices(path: Path) -> Columns:
    """Columns of numbers of the element ``vertex``, by name; x, y and z are among them.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no PLY whose first element is ``vertex`` with x, y and z, or it
            ends early.
    """
    header = read_ply_header(path)
    if not header.elements or header.elements[0].name != "vertex":
        raise FileFormatError(f"{path}: expected a PLY whose first element is vertex.")
    names = [one.name for one in header.elements[0].properties if one.count_code is None]
    if not {"x", "y", "z"} <= set(names):
        raise FileFormatError(
            f"{path}: expected vertices with x, y and z, got {quoted(', '.join(names))}."
        )
    return read_ply_tables(path, header, ["vertex"])["vertex"].numbers


def vertex_positions(path: Path, columns: Columns) -> NDArray[np.float64]:
    """Positions (n, 3) of what `read_ply_vertices` gives.

    Raises:
        FileFormatError: If one is NaN or infinite.
    """
    points = np.stack([columns[axis] for axis in "xyz"], axis=1).astype(np.float64)
    if not np.isfinite(points).all():
        bad = int((~np.isfinite(points)).any(axis=1).sum())
        raise FileFormatError(f"{path}: {bad} of {len(points)} points are not finite.")
    return points
