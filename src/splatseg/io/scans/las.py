"""LAS and LAZ files, read in pieces; needs laspy, and lazrs for LAZ.

ASPRS, LAS Specification 1.4 R15: classification 0 is "created, never classified", 1 is
"unclassified"; both are void. A dimension ``class_id`` (as `io.export.write_points` adds it)
counts instead of the classification where it is there; 0 is void in it.
"""

from collections.abc import Generator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from splatseg.errors import FileFormatError, MissingPackageError
from splatseg.io.foreign import reading
from splatseg.io.scans._las_sizes import check_las_sizes
from splatseg.io.scans._source import RawScan
from splatseg.io.scans.clouds import Piece, whole_ids

VOID = frozenset({0, 1})
CLASS_ID = "class_id"
_KIND = "a LAS file"


def las_points(path: Path) -> Piece:
    """Points of a LAS or LAZ file.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is damaged.
        MissingPackageError: If laspy, or for LAZ lazrs, is not installed.
    """
    with open_las(path) as reader:
        count = int(reader.header.point_count)
    return count, partial(_rows, path)


@contextmanager
def open_las(path: Path) -> Generator[Any]:
    """A reader of laspy, whose failures are ours.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If its header is damaged.
        MissingPackageError: If laspy, or for LAZ lazrs, is not installed.
    """
    laspy = laspy_for(path)
    check_las_sizes(path)
    with reading(path, _KIND), path.open("rb") as file:
        try:
            with laspy.open(file, closefd=False) as reader:
                yield reader
        except laspy.LaspyException as error:
            raise FileFormatError(
                f"{path}: expected {_KIND}, but it cannot be read ({error!s:.100})."
            ) from error


def laspy_for(path: Path) -> Any:
    """The module that reads LAS, with its decompressor where that is needed.

    Raises:
        MissingPackageError: If one is not installed.
    """
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


def _rows(path: Path, start: int, end: int) -> RawScan:
    with open_las(path) as reader:
        reader.seek(start)
        record = reader.read_points(end - start)
        if len(record) != end - start:
            raise FileFormatError(
                f"{path}: expected {reader.header.point_count} points, but the file ends early."
            )
        points = np.stack([np.asarray(record[axis], np.float64) for axis in "xyz"], axis=1)
        extra = CLASS_ID in record.point_format.extra_dimension_names
        values = np.asarray(record[CLASS_ID if extra else "classification"])
        intensity = np.asarray(record["intensity"])
    return RawScan(
        where=path,
        points=points,
        intensity=intensity,
        labels={"semantic": whole_ids(path, "semantic", values)},
        void=frozenset({0}) if extra else VOID,
    )
