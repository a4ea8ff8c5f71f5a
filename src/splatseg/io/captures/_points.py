"""Start points from PLY files: x y z and, where they are there, colours."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import PointCloud
from splatseg.core.sh import SH_C0
from splatseg.io.ply import ply_columns, read_ply_vertices


def point_cloud(points: NDArray[np.floating], colours: NDArray[np.uint8] | None) -> PointCloud:
    """A point cloud of NumPy arrays; what is not finite in them stays, see `build_capture`."""
    with np.errstate(over="ignore"):
        narrow = np.ascontiguousarray(points, np.float32)
    return PointCloud(
        points=torch.from_numpy(narrow),
        colours=None if colours is None else torch.from_numpy(np.ascontiguousarray(colours)),
    )


def ply_holds_splats(path: Path) -> bool:
    """Whether a PLY file holds Gaussians (a column f_dc_0) and not bare points."""
    return "f_dc_0" in ply_columns(path)


def read_ply_points(path: Path) -> PointCloud:
    """Points and colours of the element ``vertex`` of a PLY file, ASCII or binary.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is not a PLY of points, or ends early.
    """
    columns = read_ply_vertices(path)
    positions = np.stack([columns[axis] for axis in "xyz"], axis=1)
    return point_cloud(positions, vertex_colours(columns))


def vertex_colours(columns: Mapping[str, NDArray[Any]]) -> NDArray[np.uint8] | None:
    """Colours (n, 3) of vertices, from whichever columns hold them; None where none do."""
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
