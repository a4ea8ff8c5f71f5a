"""Start points of captures from PLY files, and metadata.json beside a capture."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import ClassTable, PointCloud
from splatseg.core.boundary import boundary
from splatseg.core.sh import SH_C0
from splatseg.errors import InputError
from splatseg.io.json_files import read_json
from splatseg.io.ply import read_ply_vertices
from splatseg.io.tables import class_table

_COLOURS = (
    ("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"),
)  # fmt: skip
_SH = ("f_dc_0", "f_dc_1", "f_dc_2")
_METRES = {"metres": 1.0, "meters": 1.0, "m": 1.0, "centimetres": 0.01, "cm": 0.01, "mm": 0.001}


@dataclass(frozen=True, slots=True, kw_only=True)
class Metadata:
    """What metadata.json says; None for what it leaves open."""

    classes: ClassTable | None = None
    tables: Mapping[str, ClassTable] = field(default_factory=dict[str, ClassTable])
    """Names of further kinds of ids: ``instances`` and ``parts``."""

    up: tuple[float, float, float] | None = None
    metres_per_unit: float | None = None


@boundary
def read_metadata(folder: Path) -> Metadata:
    """Metadata of a capture; all None where there is no metadata.json.

    Raises:
        FileFormatError: If metadata.json is there and broken, or its class table is.
    """
    path = folder / "metadata.json"
    if not path.is_file():
        return Metadata()
    content = read_json(path)
    tables = {
        name: class_table(content[name], where=str(path))
        for name in ("instances", "parts")
        if isinstance(content.get(name), list)
    }
    classes = class_table(content["classes"], where=str(path)) if "classes" in content else None
    return Metadata(
        tables=tables,
        classes=classes,
        up=_axis(str(content.get("up_axis"))),
        metres_per_unit=_METRES.get(str(content.get("units"))),
    )


def _axis(word: str) -> tuple[float, float, float] | None:
    """The direction of ``+z`` and the like."""
    if len(word) != 2 or word[0] not in "+-" or word[1] not in "xyz":
        return None
    sign = 1.0 if word[0] == "+" else -1.0
    return sign * (word[1] == "x"), sign * (word[1] == "y"), sign * (word[1] == "z")


def point_cloud(points: NDArray[np.floating], colours: NDArray[np.uint8] | None) -> PointCloud:
    """A point cloud of NumPy arrays; what is not finite in them stays, see `finite_points`."""
    with np.errstate(over="ignore"):
        narrow = np.ascontiguousarray(points, np.float32)
    return PointCloud(
        points=torch.from_numpy(narrow),
        colours=None if colours is None else torch.from_numpy(np.ascontiguousarray(colours)),
    )


def finite_points(
    points: PointCloud, *, where: Path, strict: bool
) -> tuple[PointCloud, tuple[str, ...]]:
    """Start points without those that are NaN or infinite, and a note that counts them.

    Raises:
        InputError: If all are, or any with `strict`; `where` starts the message.
    """
    kept = torch.isfinite(points.points).all(dim=1)
    lost = int((~kept).sum())
    if lost == 0:
        return points, ()
    if strict or lost == len(points):
        raise InputError(f"{where}: {lost} of {len(points)} start points are not finite.")
    colours = None if points.colours is None else points.colours[kept]
    note = f"{lost} of {len(points)} start points are not finite and are left out"
    return PointCloud(points=points.points[kept], colours=colours), (note,)


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
    for triple in _COLOURS:
        if set(triple) <= set(columns):
            values = np.stack([columns[name] for name in triple], axis=1)
            if np.issubdtype(values.dtype, np.floating):
                values = np.clip(np.nan_to_num(values), 0, 1) * 255 + 0.5
            return np.clip(values, 0, 255).astype(np.uint8)
    if set(_SH) <= set(columns):
        sh = np.stack([columns[name] for name in _SH], axis=1)
        return (np.clip(0.5 + SH_C0 * np.nan_to_num(sh), 0, 1) * 255 + 0.5).astype(np.uint8)
    return None
