"""Labelled point clouds: one point a Gaussian, as PLY and as LAS."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core import Gaussians
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, MissingPackageError, RangeError
from splatseg.io.atomic import atomic_file

FIRST_USER_CLASS = 64
"""LAS 1.4 gives the classifications 0 to 63 a meaning of their own (2 ground, 7 noise, which
programs drop); 64 to 255 are the user's."""

NEVER_CLASSIFIED = 0
_LAST_CLASS = 255
_POINT_FORMAT = 7
_STEPS = 2**30

_PLY_TYPES = {"f4": "float", "f8": "double", "i4": "int", "u1": "uchar"}
_DESCRIPTIONS = {
    "class_id": "class, 0 for none",
    "instance_id": "object, 0 for none",
    "confidence": "of the class, 0 to 1",
    "instance_confidence": "of the object, 0 to 1",
    "selected": "1 for selected",
    "selected_confidence": "probability of being selected",
}


@boundary
def write_points(
    gaussians: Gaussians, path: Path, *, columns: Mapping[str, Tensor] | None = None
) -> Mapping[int, int]:
    """Write the centres as a point cloud with colours and labels; atomic.

    ``.ply``: binary, ``x y z`` float, ``red green blue`` uchar, then the columns, int or
    float. ``.las`` and ``.laz``: LAS 1.4, point format 7, coordinates in scene units on steps
    of a power of ten below a billionth of the extent, colours with 16 bit, the columns as
    extra dimensions. A LAS file has one byte for the class, in which 0 to 63 are taken, so
    classification is 63 + class_id, and 0 for no class.

    Args:
        gaussians: Whose centres and mean colours are written.
        path: The file; its ending gives the format.
        columns: int32 or float32 by name, one row a Gaussian, see `label_columns`.

    Returns:
        The classification of each class id in a LAS file; empty for PLY, and where there are
        classes above 192, for which a byte has no place: then all points stay unclassified.

    Raises:
        InputError: If the name ends otherwise.
        RangeError: If a centre is not finite.
        MissingPackageError: If laspy is not installed and LAS is asked for.
        MissingFileError: If the folder of `path` does not exist.
    """
    arrays = {name: _plain(name, column) for name, column in (columns or {}).items()}
    for name, array in arrays.items():
        if array.shape != (len(gaussians),):
            raise InputError(
                f"columns[{name!r}]: expected {len(gaussians)} values, got {array.shape}."
            )
    points = gaussians.means.detach().cpu().double().numpy()
    if not np.isfinite(points).all():
        raise RangeError("means: expected finite values, got NaN or infinity.")
    colours = gaussians.colours.detach().cpu().double().clamp(0, 1).numpy()
    return _written(path, points.astype(np.float32), colours, arrays)


@boundary
def write_scan_points(
    points: Float[Tensor, "n 3"], path: Path, *, columns: Mapping[str, Tensor]
) -> Mapping[int, int]:
    """Write points of a scan with labels; atomic. As `write_points`, without colours.

    A PLY has ``x y z`` double, as coordinates of maps have more digits than float holds.

    Args:
        points: World, scene units.
        path: The file; its ending gives the format.
        columns: int32 or float32 by name, one row a point, see `label_columns`.

    Returns:
        The classification of each class id in a LAS file, see `write_points`.

    Raises:
        ShapeError: If the points are not (n, 3).
        RangeError: If a point is not finite.
        InputError: If the name ends otherwise, or a column has another number of rows.
        MissingPackageError: If laspy is not installed and LAS is asked for.
        MissingFileError: If the folder of `path` does not exist.
    """
    check_shape("points", points, (None, 3))
    check_finite("points", points)
    arrays = {name: _plain(name, column) for name, column in columns.items()}
    for name, array in arrays.items():
        if array.shape != (len(points),):
            raise InputError(
                f"columns[{name!r}]: expected {len(points)} values, got {array.shape}."
            )
    return _written(path, points.detach().cpu().double().numpy(), None, arrays)


def _written(
    path: Path,
    points: NDArray[Any],
    colours: NDArray[np.float64] | None,
    columns: Mapping[str, NDArray[Any]],
) -> Mapping[int, int]:
    match path.suffix.lower():
        case ".ply":
            with atomic_file(path) as temporary:
                _write_ply(temporary, points, colours, columns)
            return {}
        case ".las" | ".laz":
            return _write_las(path, points.astype(np.float64), colours, columns)
        case _:
            raise InputError(
                f"{path}: expected the name of a point cloud to end in .ply, .las or .laz."
            )


def _plain(name: str, column: Tensor) -> NDArray[Any]:
    array = column.detach().cpu().numpy()
    if array.dtype.kind in "iub":
        wide = array.astype(np.int64)
        if len(wide) and not -(2**31) <= wide.min() <= wide.max() < 2**31:
            raise InputError(f"columns[{name!r}]: expected ids of 32 bit, got larger ones.")
        return wide.astype(np.int32)
    return array.astype(np.float32)


def _write_ply(
    path: Path,
    points: NDArray[Any],
    colours: NDArray[np.float64] | None,
    columns: Mapping[str, NDArray[Any]],
) -> None:
    fields = [(axis, points.dtype.str[1:]) for axis in "xyz"]
    if colours is not None:
        fields += [(name, "u1") for name in ("red", "green", "blue")]
    fields += [(name, array.dtype.str[1:]) for name, array in columns.items()]
    table = np.zeros(len(points), np.dtype([(name, f"<{kind}") for name, kind in fields]))
    for k, axis in enumerate("xyz"):
        table[axis] = points[:, k]
    if colours is not None:
        bytes_ = np.floor(colours * 255 + 0.5).astype(np.uint8)
        for k, name in enumerate(("red", "green", "blue")):
            table[name] = bytes_[:, k]
    for name, array in columns.items():
        table[name] = array
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property {_PLY_TYPES[kind]} {name}" for name, kind in fields]
    with path.open("wb") as file:
        file.write("\n".join([*header, "end_header\n"]).encode("ascii"))
        file.write(table.tobytes())


def _write_las(
    path: Path,
    points: NDArray[np.float64],
    colours: NDArray[np.float64] | None,
    columns: Mapping[str, NDArray[Any]],
) -> Mapping[int, int]:
    laspy = _laspy(path)
    header = laspy.LasHeader(version="1.4", point_format=_POINT_FORMAT)
    header.generating_software = "splatseg"
    low = points.min(axis=0) if len(points) else np.zeros(3)
    extent = float((points - low).max()) if len(points) else 0.0
    # The same file on every day it is written; the field is what a capture's date would be.
    header.creation_date = None
    header.offsets = low
    header.scales = np.full(3, 10.0 ** math.ceil(math.log10(max(extent, 1e-6) / _STEPS)))
    for name, array in columns.items():
        header.add_extra_dim(
            laspy.ExtraBytesParams(
                name=name,
                type=np.int32 if array.dtype.kind == "i" else np.float32,
                description=_DESCRIPTIONS.get(name, ""),
            )
        )
    las = laspy.LasData(header)
    las.xyz = points
    if colours is not None:
        las.red, las.green, las.blue = np.floor(colours * 65535 + 0.5).astype(np.uint16).T
    las.return_number = las.number_of_returns = np.ones(len(points), np.uint8)
    classes = columns.get("class_id", np.zeros(len(points), np.int32))
    known = {int(id): int(id) + FIRST_USER_CLASS - 1 for id in np.unique(classes) if id > 0}
    if known and max(known.values()) > _LAST_CLASS:
        known = {}
    las.classification = np.where(
        (classes > 0) & bool(known), classes + FIRST_USER_CLASS - 1, NEVER_CLASSIFIED
    ).astype(np.uint8)
    for name, array in columns.items():
        las[name] = array
    with atomic_file(path) as temporary:
        las.write(str(temporary))
    return known


def _laspy(path: Path) -> Any:
    """The module that writes LAS, and for LAZ its compressor, or a word on how to get them."""
    missing = "laspy"
    try:
        import laspy

        if path.suffix.lower() == ".laz":
            missing = "lazrs"
            import lazrs  # noqa: F401  # pyright: ignore[reportUnusedImport]
    except ImportError as error:
        raise MissingPackageError(
            f"{path}: {path.suffix[1:].upper()} needs a package that is not installed "
            f"({missing}). Try: pip install 'splatseg[las]'."
        ) from error
    return laspy
