"""Labelled meshes and point clouds: PLY files with columns of ids, and arrays of points.

ids are every column of whole numbers that is no colour: ``label`` of the vertices of ScanNet's
``_vh_clean_2.labels.ply``, ``object_id`` of the faces of Replica's ``mesh_semantic.ply``. A column
of floating-point numbers is one too where its name says label, class, instance, object, segment
or semantic.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Int64
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import UNLABELLED
from splatseg.core.boundary import boundary
from splatseg.core.scans import LabelledMesh, LabelledPoints
from splatseg.errors import FileFormatError, InputError, quoted
from splatseg.io.arrays import read_npz
from splatseg.io.foreign import derived_from, expect
from splatseg.io.ply import PlyLists, PlyTable, read_ply_header, read_ply_tables

_FACES = ("vertex_indices", "vertex_index")
_COLOURS = re.compile(r"(diffuse_|specular_|ambient_)?(red|green|blue|alpha)|[rgba]|intensity")
_LABELS = re.compile(r"label|class|instance|object|segment|semantic", re.IGNORECASE)
_NORMALS = ("nx", "ny", "nz")
_ARRAYS = ("semantic", "instance", "part")
_MAX_ID = 2**31 - 2


@boundary
def read_surface(
    path: Path, *, zero_is_class: bool = False, void: int | None = None
) -> LabelledMesh | LabelledPoints:
    """A labelled mesh, or labelled points where the file has no faces.

    Faces of more than three corners are cut into triangles that have the face's label.

    Args:
        path: A PLY file, ASCII or binary of either byte order, with x y z of ``vertex`` and, for a
            mesh, lists ``vertex_indices`` of ``face``; or an .npz with xyz (n x 3), ids under
            semantic, instance or part, and perhaps normal.
        zero_is_class: The id 0 is a class and not void: ids grow by 1.
        void: A further id that means void, such as 255. Negative ids always do.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is none of these, has no ids, or its values cannot be.
    """
    if path.suffix.lower() == ".npz":
        return _from_arrays(path, zero_is_class=zero_is_class, void=void)
    expect(path.suffix.lower() == ".ply", path, "labelled surfaces as .ply or .npz, got another")
    tables = read_ply_tables(path, read_ply_header(path), ["vertex", "face"])
    what = "a PLY file with vertices that have x, y and z"
    expect("vertex" in tables and {"x", "y", "z"} <= set(tables["vertex"].numbers), path, what)
    vertices = _positions(tables["vertex"], "xyz")
    labels = _labels(path, tables["vertex"], zero_is_class=zero_is_class, void=void)
    if "face" not in tables or not tables["face"].count:
        expect(labels, path, f"points with ids, got none{_seen(tables)}")
        normals = None
        if set(_NORMALS) <= set(tables["vertex"].numbers):
            normals = _positions(tables["vertex"], _NORMALS)
        with derived_from(path):
            return LabelledPoints(points=vertices, labels=labels, normals=normals)
    of_faces = _labels(path, tables["face"], zero_is_class=zero_is_class, void=void)
    expect(labels or of_faces, path, f"vertices or faces with ids, got neither{_seen(tables)}")
    faces, source = _triangles(path, tables["face"])
    with derived_from(path):
        return LabelledMesh(
            vertices=vertices,
            faces=faces,
            vertex_labels=labels,
            # A column of one name may stand in both elements.
            face_labels={
                name if name not in labels else f"face_{name}": ids[source]
                for name, ids in of_faces.items()
            },
        )


def _positions(table: PlyTable, names: str | tuple[str, ...]) -> Tensor:
    columns = [table.numbers[name].astype(np.float64) for name in names]
    return torch.from_numpy(np.stack(columns, axis=1))


def _seen(tables: Mapping[str, PlyTable]) -> str:
    names = [name for table in tables.values() for name in table.numbers]
    return f" among {quoted(', '.join(names))}" if names else ""


def _labels(
    path: Path, table: PlyTable, *, zero_is_class: bool, void: int | None
) -> dict[str, Tensor]:
    found: dict[str, Tensor] = {}
    for name, values in table.numbers.items():
        whole = values.dtype.kind in "iu" and not _COLOURS.fullmatch(name)
        if whole or (values.dtype.kind == "f" and _LABELS.search(name)):
            found[name] = ids_of(
                values, where=f"{path}: {quoted(name)}", zero_is_class=zero_is_class, void=void
            )
    return found


def ids_of(
    values: NDArray[Any], *, where: str, zero_is_class: bool = False, void: int | None = None
) -> Tensor:
    """Ids of memory of those of a file: 0, `void` and negative ones become -1.

    Args:
        values: Of the file, (n,).
        where: Starts the message.
        zero_is_class: 0 is a class: ids grow by 1.
        void: A further id that means void.

    Raises:
        FileFormatError: If one is no whole number, or too large.
    """
    whole = values.dtype.kind != "f" or (np.isfinite(values) & (values == np.floor(values))).all()
    expect(whole, where, "whole ids, got others")
    largest = float(values.max(initial=0))
    expect(largest <= _MAX_ID, where, f"ids up to {_MAX_ID}, got {largest:.0f}")
    ids = torch.from_numpy(values.astype(np.int64)).clamp_min(UNLABELLED)
    nothing = (ids < 0) | (ids == (UNLABELLED if void is None else void))
    ids = ids + 1 if zero_is_class else torch.where(ids == 0, UNLABELLED, ids)
    return torch.where(nothing, UNLABELLED, ids).to(torch.int32)


@boundary
def read_triangles(path: Path) -> Int64[Tensor, "m 3"] | None:
    """Triangles of a PLY file, polygons cut into some; None where it has no faces.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no PLY file, or its faces cannot be.
    """
    tables = read_ply_tables(path, read_ply_header(path), ["face"])
    if "face" not in tables or not tables["face"].count:
        return None
    return _triangles(path, tables["face"])[0]


def _triangles(path: Path, table: PlyTable) -> tuple[Tensor, Tensor]:
    """Corners of triangles, and the face that each was cut from."""
    lists = next((table.lists[name] for name in _FACES if name in table.lists), None)
    if lists is None or lists.values.dtype.kind not in "iu":
        raise FileFormatError(f"{path}: expected faces with a list of {' or '.join(_FACES)}.")
    corners = np.diff(lists.starts)
    fewest = int(corners.min(initial=3))
    expect(fewest >= 3, path, f"faces of at least 3 corners, got one of {fewest}")
    return _fans(lists, corners)


def _fans(lists: PlyLists, corners: NDArray[np.int64]) -> tuple[Tensor, Tensor]:
    """Face i with corners c0 c1 c2 c3 ... as the triangles c0 c1 c2, c0 c2 c3, ..."""
    source = np.repeat(np.arange(len(corners)), corners - 2)
    first = lists.starts[:-1][source]
    step = np.arange(len(source)) - np.repeat(np.cumsum(corners - 2) - (corners - 2), corners - 2)
    values = lists.values.astype(np.int64)
    faces = np.stack([values[first], values[first + step + 1], values[first + step + 2]], axis=1)
    return torch.from_numpy(faces), torch.from_numpy(source)


def _from_arrays(path: Path, *, zero_is_class: bool, void: int | None) -> LabelledPoints:
    names = [*_ARRAYS, "normal"]
    arrays = read_npz(path, ["xyz"], optional=names)
    labels: dict[str, Tensor] = {}
    for name in _ARRAYS:
        if name in arrays:
            values = arrays[name]
            if values.dtype.kind not in "iu" or values.ndim != 1:
                raise FileFormatError(
                    f"{path}: {name}: expected a row of whole ids, got {values.dtype} of shape "
                    f"{values.shape}."
                )
            labels[name] = ids_of(
                values, where=f"{path}: {name}", zero_is_class=zero_is_class, void=void
            )
    expect(labels, path, f"ids under {' or '.join(_ARRAYS)}, got none")
    with derived_from(path):
        try:
            normals = arrays.get("normal")
            return LabelledPoints(
                points=torch.from_numpy(arrays["xyz"].astype(np.float64)),
                labels=labels,
                normals=None if normals is None else torch.from_numpy(normals.astype(np.float64)),
            )
        except (TypeError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            raise FileFormatError(f"{path}: expected arrays of numbers, got others.") from error
