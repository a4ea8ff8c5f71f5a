"""Points in files of their own that are in the world already: PLY, NumPy, LAS; and range images.

A file of many points is read in pieces. PLY of binary rows is mapped, and read from the disk piece
by piece; ASCII and compressed archives are read at once. Labels are the column ``semantic``,
``class_id``, ``label``, ``class`` or ``classification``, and ``instance`` or ``instance_id``; 0 is
void. Other spellings are found as CloudCompare exports them, ``scalar_`` before the name. Arrays
are ``xyz`` or ``points`` (n x 3), ids ``semantic`` and ``instance``; an ``.npy`` is n x 3 or more,
of which the first three columns count.

LAS and LAZ need laspy, and lazrs for LAZ. ASPRS, LAS Specification 1.4 R15: classification 0 is
"created, never classified", 1 is "unclassified"; both are void. A dimension ``class_id`` (as
`io.export.write_points` adds it) counts instead where it is there; 0 is void in it.
"""

from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg.errors import MissingFileError, import_package
from splatseg.io.arrays import npz_names, read_npy, read_npz
from splatseg.io.captures import read_metadata
from splatseg.io.captures.raw_views import checked_pose
from splatseg.io.foreign import expect, malformed, reading
from splatseg.io.ply import read_ply_vertices
from splatseg.io.scans._las_sizes import check_las_sizes
from splatseg.io.scans._source import (
    LastResult,
    Piece,
    RawScan,
    Scans,
    read_in_pieces,
    refuse_twice,
)
from splatseg.io.schema import check_array

SUFFIXES = {".las": "las", ".laz": "las", ".ply": "ply", ".npz": "npz", ".npy": "npz"}
"""Formats by the endings of their files."""

_LABELS = {
    "semantic": ("semantic", "class_id", "label", "class", "classification"),
    "instance": ("instance", "instance_id"),
}
_SPELLINGS = ("", "scalar_")
_POSITIONS = ("xyz", "points")
_INTENSITIES = ("intensity", "remission", "reflectance")
_CLASS_ID = "class_id"
_LAS = "a LAS file"
_RANGE_FILE = "lidar.npz"
_RANGES = {"range_2mm": 0.002, "range": 1.0}
"""Metres a step of each array of ranges."""

_NEEDED = ("lidar_to_world", "elevation", "azimuth")
_IDS = ("semantic", "instance")


def find_files(path: Path) -> dict[str, tuple[Path, ...]]:
    """Files of points by format: the path itself, or what lies in the folder, by name."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    found: dict[str, tuple[Path, ...]] = {}
    for file in files:
        format = SUFFIXES.get(file.suffix.lower())
        if format is not None and file.is_file():
            found[format] = (*found.get(format, ()), file)
    return found


def read_files(path: Path, format: str) -> Scans:
    """Points of a file or of the files of a folder; nothing of them is read but headers.

    Raises:
        MissingFileError: If there is no such file.
        InputError: If one is damaged, or two are called alike but for their ending.
    """
    files = find_files(path).get(format, ())
    if not files:
        endings = " or ".join(end for end, name in SUFFIXES.items() if name == format)
        raise MissingFileError(f"{path}: expected {endings}, got none.")
    refuse_twice(path, [file.stem for file in files], "files of distinct names")
    openers = {"las": _las_points, "ply": _ply_points, "npz": _array_points}
    names, read = read_in_pieces(files, openers[format])
    folder = path if path.is_dir() else path.parent
    return Scans(
        path=path,
        format=format,
        scan_names=names,
        read=lambda name: read(name)[1],
        classes=None if format == "las" else read_metadata(folder).classes,
    )


def _ply_points(path: Path) -> Piece:
    count, columns = ply_pieces(path)

    def read(start: int, end: int) -> RawScan:
        there = columns(start, end)
        found = {key: _first(there, names) for key, names in _LABELS.items()}
        return RawScan(
            where=path,
            points=positions(there),
            intensity=_first(there, _INTENSITIES),
            labels={k: whole_ids(path, k, v) for k, v in found.items() if v is not None},
        )

    return count, read


def ply_pieces(path: Path) -> tuple[int, Callable[[int, int], Mapping[str, NDArray[Any]]]]:
    """How many points a PLY file has, and what reads all columns of a range of them.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no PLY whose first element is vertex with x, y and z, or it
            ends early.
    """
    columns = read_ply_vertices(path)
    return len(columns["x"]), lambda start, end: {
        name: values[start:end] for name, values in columns.items()
    }


def positions(columns: Mapping[str, NDArray[Any]]) -> NDArray[np.float64]:
    """Positions (n, 3) of columns x, y and z."""
    return np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1)


def _first(columns: Mapping[str, NDArray[Any]], names: tuple[str, ...]) -> NDArray[Any] | None:
    lower = {name.lower(): values for name, values in columns.items()}
    spelt = (before + name for name in names for before in _SPELLINGS)
    return next((lower[name] for name in spelt if name in lower), None)


def whole_ids(path: Path, key: str, values: NDArray[Any]) -> NDArray[np.int64]:
    """Ids that a file may have as floating-point numbers.

    Raises:
        FileFormatError: If one is no whole number.
    """
    if values.dtype.kind == "f":
        wrong = ~np.isfinite(values) | (values != np.floor(values)) | (np.abs(values) > 2**53)
        if wrong.any():
            got = float(values[np.argmax(wrong)])
            raise malformed(path, f"whole ids ({key}), got {got:g}")
    return values.astype(np.int64)


def _array_points(path: Path) -> Piece:
    """Points of an ``.npy`` or ``.npz``."""
    if path.suffix.lower() == ".npy":
        table = read_npy(path, mapped=True)
        enough = table.ndim == 2 and table.shape[1] >= 3 and table.dtype.kind in "iuf"
        got = f"{table.dtype} of shape {table.shape}"
        expect(enough, path, f"points of at least 3 columns, got {got}")
        return len(table), lambda start, end: RawScan(
            where=path, points=np.asarray(table[start:end, :3], np.float64)
        )
    name = next((name for name in _POSITIONS if name in npz_names(path)), _POSITIONS[0])
    arrays = read_npz(path, [name], optional=(*_IDS, "intensity"))
    points = check_array(path, name, arrays.pop(name), ("n", 3))
    for key, array in arrays.items():
        check_array(path, key, array, (len(points),), "iuf" if key == "intensity" else "iu")
    intensity = arrays.pop("intensity", None)
    return len(points), lambda start, end: RawScan(
        where=path,
        points=points[start:end],
        intensity=None if intensity is None else intensity[start:end],
        labels={key: array[start:end] for key, array in arrays.items()},
    )


def _las_points(path: Path) -> Piece:
    with _open_las(path) as reader:
        return int(reader.header.point_count), partial(_las_rows, path)


@contextmanager
def _open_las(path: Path) -> Generator[Any]:
    """A reader of laspy, whose failures are ours."""
    what = f"{path}: {path.suffix[1:].upper()}"
    laspy = import_package("laspy", what, "las")
    if path.suffix.lower() == ".laz":
        import_package("lazrs", what, "las")
    check_las_sizes(path)
    with reading(path, _LAS), path.open("rb") as file:
        try:
            with laspy.open(file, closefd=False, read_evlrs=False) as reader:
                yield reader
        except laspy.LaspyException as error:
            raise malformed(path, f"{_LAS}, but it cannot be read ({error!s:.100})") from error


def _las_rows(path: Path, start: int, end: int) -> RawScan:
    with _open_las(path) as reader:
        reader.seek(start)
        record = reader.read_points(end - start)
        what = f"{reader.header.point_count} points, but the file ends early"
        expect(len(record) == end - start, path, what)
        points = np.stack([np.asarray(record[axis], np.float64) for axis in "xyz"], axis=1)
        extra = _CLASS_ID in record.point_format.extra_dimension_names
        values = np.asarray(record[_CLASS_ID if extra else "classification"])
        intensity = np.asarray(record["intensity"])
    return RawScan(
        where=path,
        points=points,
        intensity=intensity,
        labels={"semantic": whole_ids(path, "semantic", values)},
        void=frozenset({0} if extra else {0, 1}),
    )


def find_range_images(path: Path) -> Path | None:
    """The archive of range images that a path is, or that lies in the folder, or None."""
    file = path / _RANGE_FILE if path.is_dir() else path
    if file.suffix.lower() != ".npz" or not file.is_file():
        return None
    names = npz_names(file)
    # Without poses or angles it is still one, of which the reader says what is missing.
    ranged = any(name in names for name in _RANGES) and "xyz" not in names
    return file if ranged else None


def read_range_images(path: Path) -> Scans:
    """Laser scans as range images in one archive: a rendered street's ``lidar.npz``.

        range_2mm       u16 (scans, rows, columns), 2 mm a step, 0 for no return; or range, metres
        lidar_to_world  (scans, 4, 4)
        elevation, azimuth   rad, of rows and columns; x = cos e cos a, y = cos e sin a, z = sin e
        semantic, instance, intensity, time   may lack

    The scans are written together, so the archive is unpacked once, and held while it is read from.
    Names count them from ``0000``.

    Raises:
        MissingFileError: If there is none.
        FileFormatError: If it is damaged, or its arrays do not belong together.
    """
    file = find_range_images(path)
    if file is None:
        raise MissingFileError(
            f"{path}: expected {_RANGE_FILE} with {' or '.join(_RANGES)}, {', '.join(_NEEDED)}, "
            "got none."
        )
    arrays = LastResult(partial(_range_arrays, file))
    shape = arrays()["range"].shape
    return Scans(
        path=file,
        format="lidar-npz",
        scan_names=tuple(f"{i:04d}" for i in range(shape[0])),
        read=lambda name: _range_image(file, arrays(), int(name)),
        classes=read_metadata(file.parent).classes,
        array_shape=shape,
    )


def _range_arrays(file: Path) -> Mapping[str, NDArray[Any]]:
    arrays = read_npz(file, _NEEDED, optional=(*_RANGES, *_IDS, "intensity", "time"))
    name = next(name for name in _RANGES if name in arrays)
    ranges = check_array(file, name, arrays[name], ("scans", "rows", "columns"))
    scans, rows, columns = ranges.shape
    shapes: dict[str, tuple[int, ...]] = {
        "lidar_to_world": (scans, 4, 4), "elevation": (rows,), "azimuth": (columns,),
        "time": (scans,),
    }  # fmt: skip
    for key in sorted(set(arrays) - set(_RANGES)):
        kinds = "iu" if key in _IDS else "iuf"
        check_array(file, key, arrays[key], shapes.get(key, ranges.shape), kinds)
    return {**arrays, "range": ranges, "step": np.array(_RANGES[name])}


def _range_image(file: Path, arrays: Mapping[str, NDArray[Any]], i: int) -> RawScan:
    where = f"{file}: scan {i}"
    pose = checked_pose(arrays["lidar_to_world"][i].astype(np.float64), where=where)
    ranges = arrays["range"][i].astype(np.float64) * float(arrays["step"])
    expect(not (ranges < 0).any(), where, f"ranges from 0 on, got {ranges.min(initial=0):g}")
    e = arrays["elevation"].astype(np.float64)[:, None]
    a = arrays["azimuth"].astype(np.float64)[None, :]
    points = directions(e, a) * ranges[..., None]
    return RawScan(
        where=where,
        points=points.reshape(-1, 3),
        world_from_sensor=pose,
        missing=(ranges == 0).reshape(-1),
        intensity=arrays["intensity"][i].reshape(-1) if "intensity" in arrays else None,
        labels={name: arrays[name][i].reshape(-1) for name in _IDS if name in arrays},
        time=float(arrays["time"][i]) if "time" in arrays else None,
    )


def directions(elevation: NDArray[np.float64], azimuth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit directions (rows, columns, 3) of elevations (rows, 1) and azimuths (1, columns)."""
    z = np.broadcast_to(np.sin(elevation), (len(elevation), azimuth.shape[1]))
    across = np.cos(elevation)
    return np.stack((across * np.cos(azimuth), across * np.sin(azimuth), z), axis=-1)
