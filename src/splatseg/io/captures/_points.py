"""Start points from PLY files: x y z and, where they are there, colours."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import PointCloud
from splatseg.core.sh import SH_C0
from splatseg.errors import FileFormatError, quoted
from splatseg.io.ply import read_ply_header, read_ply_tables


def point_cloud(points: NDArray[np.floating], colours: NDArray[np.uint8] | None) -> PointCloud:
    """A point cloud of NumPy arrays."""
    return PointCloud(
        points=torch.from_numpy(np.ascontiguousarray(points, np.float32)),
        colours=None if colours is None else torch.from_numpy(np.ascontiguousarray(colours)),
    )


def ply_holds_splats(path: Path) -> bool:
    """Whether a PLY file holds Gaussians (a column f_dc_0) and not bare points."""
    return any(
        one.name == "f_dc_0"
        for element in read_ply_header(path).elements
        for one in element.properties
    )


def read_ply_points(path: Path) -> PointCloud:
    """Points and colours of the element ``vertex`` of a PLY file, ASCII or binary.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is not a PLY of points, ends early, or holds NaN or infinity.
    """
    header = read_ply_header(path)
    if not header.elements or header.elements[0].name != "vertex":
        raise FileFormatError(f"{path}: expected a PLY whose first element is vertex.")
    names = [one.name for one in header.elements[0].properties if one.count_code is None]
    if not {"x", "y", "z"} <= set(names):
        raise FileFormatError(
            f"{path}: expected vertices with x, y and z, got {quoted(', '.join(names))}."
        )
    columns = read_ply_tables(path, header, ["vertex"])["vertex"].numbers
    points = np.stack([columns[axis] for axis in "xyz"], axis=1).astype(np.float64)
    if not np.isfinite(points).all():
        bad = int((~np.isfinite(points)).any(axis=1).sum())
        raise FileFormatError(f"{path}: {bad} of {len(points)} points are not finite.")
    return point_cloud(points, _colours(columns))


def _colours(columns: Mapping[str, NDArray[Any]]) -> NDArray[np.uint8] | None:
    for triple in (
        ("red", "green", "blue"),
        ("r", "g", "b"),
        ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ):
        if set(triple) <= set(columns):
            values = np.stack([columns[name] for name in triple], axis=1)
            if np.issubdtype(values.dtype, np.floating):
                values = np.clip(np.nan_to_num(values), 0, 1) * 255 + 0.5
            return np.clip(values, 0, 255).astype(np.uint8)
    if {"f_dc_0", "f_dc_1", "f_dc_2"} <= set(columns):
        sh = np.stack([columns[f"f_dc_{i}"] for i in range(3)], axis=1)
        return (np.clip(0.5 + SH_C0 * np.nan_to_num(sh), 0, 1) * 255 + 0.5).astype(np.uint8)
    return None
