"""Reads IDR captures: cameras_sphere.npz, photographs and object masks (DTU as IDR ships it)."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatseg.core import Capture
from splatseg.errors import InputError, MissingFileError
from splatseg.io.captures.build import build_capture
from splatseg.io.captures.colmap_model import points_beside
from splatseg.io.captures.raw_views import Intrinsics, RawView
from splatseg.io.images import find_images, image_size
from splatseg.io.npz import open_npz
from splatseg.io.schema import check_array

FILES = ("cameras_sphere.npz", "cameras.npz")
_IMAGE_FOLDERS = ("images", "image")
_MASK_FOLDERS = ("masks", "mask")
_SCALES = (1.0, 0.5, 0.25, 0.125, 2.0)
# A principal point this far from the middle, as a share of the image, is no match.
_OFF_CENTRE = 0.15

_MAX_ENTRY = 1e15
"""Of a projection; pixels times scene units are far below."""


def find_idr(folder: Path) -> Path | None:
    """The file of projection matrices of an IDR capture, or None."""
    return next((folder / name for name in FILES if (folder / name).is_file()), None)


def read_idr(folder: Path, *, strict: bool = False) -> Capture:
    """Read an IDR capture; see `read_capture`.

    ``world_mat_i`` holds the 3 x 4 projection P = K [R | t] of the photograph i by name, in
    the world's own units (``scale_mat_i``, the region of interest, is not applied). The layout
    does not say for which image size K is meant: of 1, 1/2, 1/4, 1/8 and 2 the scale is taken
    that brings the principal points closest to the middle of the photographs. An object mask of
    the same stem in ``masks`` or ``mask`` becomes the view's mask.

    Where there are fewer photographs than matrices, the numbers at the end of their names tell
    which are missing, if the first photograph is there to show where numbers begin.

    Raises:
        MissingFileError: If there is no such file, or photographs are missing.
        InputError: If a matrix is no projection, no scale fits the photographs, or it cannot be
            told which photographs are missing.
    """
    path = find_idr(folder)
    if path is None:
        raise MissingFileError(f"{folder}: expected {' or '.join(FILES)}, got neither.")
    matrices = _matrices(path)
    images = next((found for name in _IMAGE_FOLDERS if (found := find_images(folder / name))), ())
    of_images = _matrices_of(images, matrices, path)
    if not images:
        raise InputError(f"{path}: expected photographs with poses, got none.")
    masks = {mask.stem: mask for name in _MASK_FOLDERS for mask in find_images(folder / name)}
    parts = [
        decompose(p, where=f"{path}: world_mat of {i.name}")
        for i, p in ((image, matrices[of_images[image]]) for image in images)
    ]
    sizes = [image_size(image) for image in images]
    scale = _scale([k for k, _ in parts], sizes, path)
    raw: list[RawView] = []
    for image, (k, pose), (width, height) in zip(images, parts, sizes, strict=True):
        fx, fy, cx, cy = (float(k[at]) * scale for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
        lens = Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)
        mask, name = masks.get(image.stem), image.name
        raw.append(
            RawView(image=image, relative=name, intrinsics=lens, cam_from_world=pose, mask=mask)
        )
    used = set(of_images.values())
    raw += [_missing(folder, index) for index in matrices if index not in used]
    notes = [] if scale == 1 else [f"intrinsics were scaled by {scale:g} to fit the photographs"]
    return build_capture(
        folder, raw, format="idr", points=points_beside(folder), notes=notes, strict=strict
    )


def decompose(
    projection: NDArray[np.float64], *, where: str
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """K (3 x 3, K[2, 2] = 1) and cam_from_world (4 x 4) of a projection K [R | t].

    K is upper triangular with a positive diagonal: the RQ factorisation of the left 3 x 3,
    whose overall sign is chosen so that R is a rotation and not a reflection.

    Raises:
        InputError: If it is singular, not finite, or skewed by more than a pixel in a thousand.
    """
    left = projection[:3, :3]
    if not np.abs(projection).max() < _MAX_ENTRY or abs(np.linalg.det(left)) < 1e-12:
        raise InputError(f"{where}: expected a projection matrix, got a singular or infinite one.")
    sign = np.sign(np.linalg.det(left))
    flip = np.eye(3)[::-1]
    q, r = np.linalg.qr((flip @ (sign * left)).T)
    k, rotation = flip @ r.T @ flip, flip @ q.T
    signs = np.diag(np.sign(np.diag(k)))
    k, rotation = k @ signs, signs @ rotation
    if not k[2, 2] > 0 or not np.linalg.matrix_rank(k) == 3:
        raise InputError(f"{where}: expected a projection matrix, got a singular one.")
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = np.linalg.solve(k, sign * projection[:3, 3])
    k = k / k[2, 2]
    if abs(k[0, 1]) > 1e-3 * k[0, 0]:
        raise InputError(f"{where}: expected square pixels, got a skew of {k[0, 1]:g}.")
    return k, pose


def _matrices_of(
    images: Sequence[Path], matrices: Mapping[int, NDArray[np.float64]], path: Path
) -> dict[Path, int]:
    """The number of each photograph's matrix: by order, or by its name where some are missing."""
    if len(images) == len(matrices):
        return dict(zip(images, matrices, strict=True))
    ends = [re.search(r"(\d+)$", image.stem) for image in images]
    numbers = [int(found[1]) for found in ends if found]
    told = len(set(numbers)) == len(images) > 0 and set(numbers) < set(matrices)
    # Names that begin at 1 could be those of matrices that begin at 0.
    if not told or min(numbers) != min(matrices):
        raise InputError(
            f"{path}: expected one world_mat a photograph, or photographs numbered as they are "
            f"from the first on, got {len(matrices)} for {len(images)} photographs."
        )
    return dict(zip(images, numbers, strict=True))


def _missing(folder: Path, index: int) -> RawView:
    """A photograph that only its matrix tells of; its size is not known and not needed."""
    return RawView(
        image=folder / _IMAGE_FOLDERS[0] / f"world_mat_{index}",
        relative=f"world_mat_{index}",
        intrinsics=Intrinsics(fx=1, fy=1, cx=0.5, cy=0.5, width=1, height=1),
        cam_from_world=np.eye(4),
    )


def _matrices(path: Path) -> dict[int, NDArray[np.float64]]:
    with open_npz(path) as archive:
        names = sorted(
            (int(found[1]), key)
            for key in archive.names
            if (found := re.fullmatch(r"world_mat_([0-9]{1,9})", key))
        )
        matrices = {index: archive.array(key) for index, key in names}
    for index, matrix in matrices.items():
        rows = 3 if len(matrix.shape) == 2 and len(matrix) == 3 else 4
        check_array(path, f"world_mat_{index}", matrix, (rows, 4))
    return {index: matrix.astype(np.float64) for index, matrix in matrices.items()}


def _scale(ks: list[NDArray[np.float64]], sizes: list[tuple[int, int]], path: Path) -> float:
    points = np.array([(k[0, 2], k[1, 2]) for k in ks])
    centres = np.array(sizes) / 2
    errors = [float(np.abs(points * s / centres - 1).mean()) for s in _SCALES]
    best = int(np.argmin(errors))
    if errors[best] > _OFF_CENTRE:
        centre = points.mean(axis=0)
        raise InputError(
            f"{path}: expected principal points near the middle of photographs of "
            f"{sizes[0][0]}x{sizes[0][1]} at a scale of {', '.join(f'{s:g}' for s in _SCALES)}, "
            f"got ({centre[0]:.0f}, {centre[1]:.0f})."
        )
    return _SCALES[best]
