"""Reads LLFF captures: poses_bounds.npy and a folder of photographs."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatseg.core import Capture
from splatseg.errors import FileFormatError, InputError
from splatseg.io.arrays import read_npy
from splatseg.io.captures._points_beside import points_beside
from splatseg.io.captures.build import build_capture
from splatseg.io.captures.raw_views import MAX_SIDE, Intrinsics, RawView
from splatseg.io.images import find_images

FILE = "poses_bounds.npy"
_IMAGE_FOLDERS = ("images", "images_2", "images_4", "images_8", ".")


def read_llff(folder: Path, *, strict: bool = False) -> Capture:
    """Read an LLFF capture; see `read_capture`.

    A row of poses_bounds.npy is a 3 x 5 matrix, row-major, and the near and far bound. Its
    columns are the camera's axes down, right and backwards in the world, its centre, and
    (height, width, focal length) of the photograph as it was taken. Rows follow the
    photographs sorted by name. Photographs in ``images`` may be smaller than that: the
    intrinsics are scaled.

    Raises:
        MissingFileError: If poses_bounds.npy is missing.
        InputError: If it has not one row a photograph, or what it says cannot be.
    """
    rows = _rows(folder / FILE)
    images = next((found for name in _IMAGE_FOLDERS if (found := find_images(folder / name))), ())
    if len(images) != len(rows):
        raise InputError(
            f"{folder / FILE}: expected one row a photograph, got {len(rows)} rows for "
            f"{len(images)} photographs, and rows do not say of which photograph they are."
        )
    raw = [
        RawView(
            image=image,
            relative=image.name,
            intrinsics=_intrinsics(row, where=f"{folder / FILE}: row {i} ({image.name})"),
            cam_from_world=_cam_from_world(row),
        )
        for i, (image, row) in enumerate(zip(images, rows, strict=True))
    ]
    return build_capture(folder, raw, format="llff", points=points_beside(folder), strict=strict)


def _rows(path: Path) -> NDArray[np.float64]:
    rows = read_npy(path)
    if rows.ndim != 2 or rows.shape[1] != 17 or rows.dtype.kind not in "iuf":
        raise FileFormatError(f"{path}: expected numbers of shape (n, 17), got {rows.shape}.")
    return rows.astype(np.float64)


def _cam_from_world(row: NDArray[np.float64]) -> NDArray[np.float64]:
    down, right, backwards, centre = row[:15].reshape(3, 5).T[:4]
    rotation = np.stack([right, down, -backwards])
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ centre
    return pose


def _intrinsics(row: NDArray[np.float64], *, where: str) -> Intrinsics:
    height, width, focal = (float(v) for v in row[:15].reshape(3, 5)[:, 4])
    if not (1 <= height <= MAX_SIDE and 1 <= width <= MAX_SIDE):
        raise InputError(f"{where}: expected a height and width, got {height:g} and {width:g}.")
    return Intrinsics(
        fx=focal,
        fy=focal,
        cx=width / 2,
        cy=height / 2,
        width=round(width),
        height=round(height),
    )
