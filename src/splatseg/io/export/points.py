"""Labelled point clouds as PLY and LAS, and labels of laser scans in the order of their files."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_choice, check_finite, check_shape
from splatseg.core import UNLABELLED, Gaussians, PointLabels, Scan
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, RangeError, import_package
from splatseg.io.atomic import atomic_file, atomic_folder, path_inside
from splatseg.io.export.objects import MADE_BY
from splatseg.io.export.splats import check_replaceable
from splatseg.io.json_files import write_json
from splatseg.io.ply import ply_header

FIRST_USER_CLASS = 64
"""LAS 1.4 gives the classifications 0 to 63 a meaning of their own (2 ground, 7 noise, which
programs drop); 64 to 255 are the user's."""

NEVER_CLASSIFIED = 0
_LAST_CLASS = 255
_POINT_FORMAT = 7
_STEPS = 2**30

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
    arrays = _arrays(columns or {}, len(gaussians))
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
    arrays = _arrays(columns, len(points))
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


def _arrays(columns: Mapping[str, Tensor], count: int) -> dict[str, NDArray[Any]]:
    """Columns of `count` rows, int32 or float32."""
    found: dict[str, NDArray[Any]] = {}
    for name, column in columns.items():
        array = column.detach().cpu().numpy()
        if array.shape != (count,):
            raise InputError(f"columns[{name!r}]: expected {count} values, got {array.shape}.")
        if array.dtype.kind not in "iub":
            found[name] = array.astype(np.float32)
            continue
        wide = array.astype(np.int64)
        if len(wide) and not -(2**31) <= wide.min() <= wide.max() < 2**31:
            raise InputError(f"columns[{name!r}]: expected ids of 32 bit, got larger ones.")
        found[name] = wide.astype(np.int32)
    return found


def _write_ply(
    path: Path,
    points: NDArray[Any],
    colours: NDArray[np.float64] | None,
    columns: Mapping[str, NDArray[Any]],
) -> None:
    table: dict[str, NDArray[Any]] = dict(zip("xyz", points.T, strict=True))
    if colours is not None:
        bytes_ = np.floor(colours * 255 + 0.5).astype(np.uint8)
        table |= zip(("red", "green", "blue"), bytes_.T, strict=True)
    table |= columns
    fields = [(name, array.dtype.newbyteorder("<").str) for name, array in table.items()]
    rows = np.zeros(len(points), np.dtype(fields))
    for name, array in table.items():
        rows[name] = array
    with path.open("wb") as file:
        file.write(ply_header([("vertex", len(points), fields)]))
        file.write(rows.tobytes())


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
    what = f"{path}: {path.suffix[1:].upper()}"
    if path.suffix.lower() == ".laz":
        import_package("lazrs", what, "las")
    return import_package("laspy", what, "las")


ScanLabelForm = Literal["npz", "label", "ply", "las"]
"""npz: arrays ``semantic`` (int32, 0 none) and ``confidence`` (float32), a value for every value of
the scan's file. label: SemanticKITTI's, a uint32 a point. ply, las: points of the world with
columns ``class_id`` and ``confidence``."""

FORMS = get_args(ScanLabelForm)

RECORD = "labels.json"
_VOID = 0
_ARRAY = "labels.npz"
_MAX_LABEL = (1 << 16) - 1
"""The upper half of a number in a ``.label`` file is the instance."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanLabelCounts:
    """How many points have which label."""

    scans: int

    points: int

    unlabelled: int
    """Points about which nothing was said."""

    ids: Mapping[int, int]
    """How many points have each id, by id."""


@boundary
def write_scan_labels(
    found: Iterable[tuple[Scan, PointLabels]],
    folder: Path,
    *,
    form: ScanLabelForm = "npz",
    array_shape: tuple[int, ...] | None = None,
    about: Mapping[str, Any] | None = None,
) -> ScanLabelCounts:
    """Write a folder of labels, one file a scan; it appears whole or not at all.

    ``FOLDER/NAME.npz`` (``.label``, ``.ply``, ``.las``) is of the scan NAME, and
    ``FOLDER/labels.json`` says what the ids mean and how many points have each. Scans of one
    array become one file, ``labels.npz``, with arrays of its shape. A folder of an earlier export
    is replaced as a whole.

    Args:
        found: Scans with labels of their points, taken one at a time.
        folder: What to write.
        form: Of the files.
        array_shape: With npz: shape of the array that holds all scans, one after the other.
        about: Further members of labels.json.

    Returns:
        How many points have which label.

    Raises:
        InputError: If the folder holds something other than an earlier export, or an id has no
            place in a ``.label`` file.
        ShapeError: If there is not one label a point, or not the array's number of values.
        MissingPackageError: If laspy is not installed and LAS is asked for.
    """
    check_choice("form", form, FORMS)
    check_replaceable(folder, RECORD)
    counts: Counter[int] = Counter()
    scans = 0
    classified: dict[str, int] = {}
    whole: list[tuple[Tensor, Tensor]] = []
    with atomic_folder(folder) as temporary:
        for scan, labels in found:
            check_shape("labels", labels.ids, (len(scan),))
            ids, each = torch.unique(labels.ids, return_counts=True)
            counts.update(dict(zip(ids.tolist(), each.tolist(), strict=True)))
            scans += 1
            if form in ("ply", "las"):
                path = path_inside(temporary, f"{scan.name}.{form}")
                known = write_scan_points(scan.points, path, columns=_columns(labels))
                classified |= {str(id): value for id, value in known.items()}
                continue
            semantic = _in_file(scan.recorded_labels(labels.ids))
            if form == "label":
                _write_label(path_inside(temporary, f"{scan.name}.label"), semantic)
                continue
            confidence = _recorded(scan, labels.confidence)
            if array_shape is not None:
                whole.append((semantic, confidence))
                continue
            _write_arrays(path_inside(temporary, f"{scan.name}.npz"), semantic, confidence)
        if array_shape is not None and form == "npz":
            _write_whole(temporary / _ARRAY, whole, array_shape)
        total = ScanLabelCounts(
            scans=scans,
            points=counts.total(),
            unlabelled=counts.pop(UNLABELLED, 0),
            ids=dict(sorted(counts.items())),
        )
        content: dict[str, Any] = {
            "made_by": MADE_BY,
            "form": form,
            "scans": total.scans,
            "points": total.points,
            "unlabelled": total.unlabelled,
            "points_by_id": {str(id): count for id, count in total.ids.items()},
        }
        if classified:
            content["las_classification"] = classified
        write_json(content | dict(about or {}), temporary / RECORD)
    return total


def _columns(labels: PointLabels) -> dict[str, Tensor]:
    return {"class_id": _in_file(labels.ids), "confidence": labels.confidence.float()}


def _in_file(ids: Tensor) -> Tensor:
    return torch.where(ids == UNLABELLED, _VOID, ids).int()


def _recorded(scan: Scan, values: Tensor) -> Tensor:
    """Values in the order of the file, 0 where it has no point."""
    if scan.rows is None:
        return values.float()
    out = torch.zeros(len(scan.recorded_labels(torch.zeros(len(scan), dtype=torch.int32))))
    out[scan.rows] = values.float()
    return out


def _write_label(path: Path, semantic: Tensor) -> None:
    if len(semantic) and int(semantic.max()) > _MAX_LABEL:
        raise InputError(
            f"form: expected ids up to {_MAX_LABEL} for .label files, got {int(semantic.max())}."
        )
    path.write_bytes(semantic.numpy().astype("<u4").tobytes())


def _write_arrays(path: Path, semantic: Tensor, confidence: Tensor) -> None:
    arrays: dict[str, NDArray[Any]] = {
        "semantic": semantic.numpy().astype(np.int32),
        "confidence": confidence.numpy().astype(np.float32),
    }
    np.savez(path, **cast(dict[str, Any], arrays))


def _write_whole(
    path: Path, parts: list[tuple[Tensor, Tensor]], array_shape: tuple[int, ...]
) -> None:
    semantic = torch.cat([ids for ids, _ in parts] or [torch.zeros(0, dtype=torch.int32)])
    confidence = torch.cat([shares for _, shares in parts] or [torch.zeros(0)])
    check_shape("array_shape", semantic, (int(np.prod(array_shape)),))
    _write_arrays(path, semantic.reshape(array_shape), confidence.reshape(array_shape))
