"""Captures whose poses are tables of numbers beside photographs (LLFF, Replica, ScanNet, IDR)."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from splatseg.core import Capture, PointCloud
from splatseg.errors import InputError, MissingFileError
from splatseg.io.arrays import open_npz, read_npy
from splatseg.io.captures.build import build_capture
from splatseg.io.captures.colmap_model import points_beside
from splatseg.io.captures.points import point_cloud, read_ply_points
from splatseg.io.captures.raw_views import Intrinsics, RawView, inverse_pose
from splatseg.io.foreign import expect, is_file
from splatseg.io.images import find_images, image_size
from splatseg.io.ply import read_ply_vertices, vertex_positions
from splatseg.io.schema import MAX_SIDE, check_array, read_structured
from splatseg.io.text_numbers import read_numbers

LLFF_FILE = "poses_bounds.npy"
REPLICA_FILE = "traj_w_c.txt"
SEQUENCE = "Sequence_1"
"""The walk that is read of a scene of Replica which has several, as Semantic-NeRF does."""

TRAIN_EVERY = 5
"""Frames 0, 5, 10, ... of Replica are training views, those half-way between them test views."""

SCANNET_INTRINSICS = Path("intrinsic/intrinsic_color.txt")
EVERY = 20
"""Of a scan of ScanNet exported whole, every 20th frame is taken, as OpenGaussian does."""

_LLFF_FOLDERS = ("images", "images_2", "images_4", "images_8", ".")
_TEST = TRAIN_EVERY // 2
_WIDTH, _HEIGHT = 640, 480
_MILLIMETRE = 0.001
_CAMERA_FILE = "cam_params.json"
_MAX_DIGITS = 9
# A principal point this far from the middle, as a share of the image, is of another size.
_OFF_CENTRE = 0.1


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
    path = folder / LLFF_FILE
    rows = check_array(path, "rows", read_npy(path), ("n", 17)).astype(np.float64)
    images = next((found for name in _LLFF_FOLDERS if (found := find_images(folder / name))), ())
    what = f"one row a photograph, got {len(rows)} rows for {len(images)} photographs, and rows do "
    what += "not say of which photograph they are"
    expect(len(images) == len(rows), path, what, error=InputError)
    raw: list[RawView] = []
    for i, (image, row) in enumerate(zip(images, rows, strict=True)):
        down, right, backwards, centre, (height, width, focal) = row[:15].reshape(3, 5).T
        sound = 1 <= height <= MAX_SIDE and 1 <= width <= MAX_SIDE
        got = f"{height:g} and {width:g}"
        expect(sound, f"{path}: row {i} ({image.name})", f"a height and width, got {got}")
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, down, -backwards])
        pose[:3, 3] = -pose[:3, :3] @ centre
        lens = _pinhole(focal, focal, width / 2, height / 2, (round(width), round(height)))
        raw.append(RawView(image=image, relative=image.name, intrinsics=lens, cam_from_world=pose))
    return build_capture(folder, raw, format="llff", points=points_beside(folder), strict=strict)


def find_replica(folder: Path, sequence_name: str = SEQUENCE) -> Path | None:
    """The folder of the poses of a sequence, or of one of a scene; None where none is.

    Args:
        folder: A sequence, or a scene.
        sequence_name: Which of a scene's sequences is meant.
    """
    for sequence in (folder, folder / sequence_name):
        if (sequence / REPLICA_FILE).is_file() and (sequence / "rgb").is_dir():
            return sequence
    return None


def read_replica(folder: Path, *, strict: bool = False) -> Capture:
    """Read a sequence of Replica as Semantic-NeRF rendered it; see `read_capture`.

    Row N of traj_w_c.txt holds the 16 numbers of world_from_cam, row by row, with OpenCV axes, of
    ``rgb/rgb_N.png``; ``depth/depth_N.png`` is in millimetres. The layout has no intrinsics: the
    field of view is 90 degrees across, 320 pixels of focal length at 640x480. A
    ``cam_params.json`` (w, h, fx, fy, cx, cy in ``camera``, as NICE-SLAM's Replica has) in
    the sequence or the scene tells of another camera. Frames 0, 5, 10, ... are training views and
    frames 2, 7, 12, ... test views, as in Semantic-NeRF; the others are ``unused``.

    Raises:
        MissingFileError: If there are no poses, or photographs are missing.
        InputError: If a row is no pose, or the photographs have other proportions.
    """
    sequence = find_replica(folder)
    if sequence is None:
        raise MissingFileError(
            f"{folder}: expected {REPLICA_FILE} and a folder rgb, there or in {SEQUENCE}, got none."
        )
    path = sequence / REPLICA_FILE
    camera = _replica_camera(sequence)
    depths = (sequence / "depth").is_dir()
    raw = [
        RawView(
            image=sequence / "rgb" / f"rgb_{i}.png",
            relative=f"rgb/rgb_{i}.png",
            intrinsics=camera,
            cam_from_world=inverse_pose(row.reshape(4, 4), where=f"{path}: row {i + 1}"),
            split={0: "train", _TEST: "test"}.get(i % TRAIN_EVERY, "unused"),
            depth=sequence / "depth" / f"depth_{i}.png" if depths else None,
            depth_unit=_MILLIMETRE if depths else None,
        )
        for i, row in enumerate(read_numbers(path, columns=16))
    ]
    note = (
        f"frames 0, {TRAIN_EVERY}, {2 * TRAIN_EVERY}, ... are training views and {_TEST}, "
        f"{_TEST + TRAIN_EVERY}, ... test views, as in Semantic-NeRF"
    )
    return build_capture(
        sequence,
        raw,
        format="replica",
        points=points_beside(sequence),
        notes=[note],
        metres_per_unit=1.0,
        strict=strict,
    )


_Number = Annotated[float, Meta(ge=0, le=MAX_SIDE)]


@dataclass(frozen=True, slots=True)
class _Camera:
    w: _Number
    h: _Number
    fx: _Number
    fy: _Number
    cx: _Number
    cy: _Number


@dataclass(frozen=True, slots=True)
class _CameraFile:
    camera: _Camera


def _replica_camera(sequence: Path) -> Intrinsics:
    for path in (sequence / _CAMERA_FILE, sequence.parent / _CAMERA_FILE):
        if path.is_file():
            one = read_structured(path, _CameraFile).camera
            return _pinhole(one.fx, one.fy, one.cx, one.cy, (round(one.w), round(one.h)))
    focal = _WIDTH / 2
    return _pinhole(focal, focal, focal, _HEIGHT / 2, (_WIDTH, _HEIGHT))


def find_scannet(folder: Path) -> bool:
    """Whether a folder is a scan that SensReader exported."""
    return (folder / SCANNET_INTRINSICS).is_file() and (folder / "pose").is_dir()


def read_scannet(folder: Path, *, strict: bool = False) -> Capture:
    """Read a scan of ScanNet as its SensReader exports it; see `read_capture`.

    ``pose/N.txt`` holds the 4 x 4 world_from_cam with OpenCV axes of ``color/N.jpg``;
    frames whose pose is infinite (the tracker was lost) are left out. ``intrinsic_color.txt``
    is of the photographs as they were exported. ``depth/N.png``, where it is there, is in
    millimetres. Of frames numbered without a gap every 20th is taken, of others all.
    Start points are the vertices of ``SCENE_vh_clean_2.ply``, else of its labelled twin.

    Raises:
        MissingFileError: If intrinsics, poses or photographs are missing.
        InputError: If a file holds something else.
    """
    what = f"{SCANNET_INTRINSICS} and a folder pose, got none"
    expect(find_scannet(folder), folder, what, error=MissingFileError)
    numbered = sorted(
        (int(path.stem), path)
        for path in (folder / "pose").glob("*.txt")
        if path.stem.isascii() and path.stem.isdigit() and len(path.stem) <= _MAX_DIGITS
    )
    chosen = _chosen([number for number, _ in numbered])
    notes = [] if len(chosen) == len(numbered) else [f"every {EVERY}th frame was taken"]
    raw: list[RawView] = []
    lost = 0
    for number, path in numbered:
        pose = read_numbers(path, columns=4, rows=4) if number in chosen else np.eye(4)
        if number not in chosen or np.isinf(pose).any():
            lost += number in chosen
            continue
        tried = [folder / "color" / f"{path.stem}{suffix}" for suffix in (".jpg", ".png")]
        image = next((one for one in tried if is_file(one)), tried[0])
        depth = folder / "depth" / f"{path.stem}.png"
        there = is_file(depth)
        raw.append(
            RawView(
                image=image,
                relative=f"color/{image.name}",
                intrinsics=_scannet_camera(folder / SCANNET_INTRINSICS, image),
                cam_from_world=inverse_pose(pose, where=str(path)),
                depth=depth if there else None,
                depth_unit=_MILLIMETRE if there else None,
            )
        )
    if lost:
        notes.append(
            f"left out: {lost} {'frame' if lost == 1 else 'frames'} whose pose is infinite"
        )
    return build_capture(
        folder,
        raw,
        format="scannet",
        points=_scannet_points(folder),
        notes=notes,
        metres_per_unit=1.0,
        up=(0.0, 0.0, 1.0),
        strict=strict,
    )


def labelled_mesh(folder: Path) -> Path | None:
    """``SCENE_vh_clean_2.labels.ply`` of a scan, or None."""
    return _mesh(folder, "_vh_clean_2.labels.ply")


def _mesh(folder: Path, end: str) -> Path | None:
    named = folder / f"{folder.resolve().name}{end}"
    return named if named.is_file() else next(iter(sorted(folder.glob(f"*{end}"))), None)


def _scannet_points(folder: Path) -> PointCloud | None:
    mesh, labelled = _mesh(folder, "_vh_clean_2.ply"), labelled_mesh(folder)
    if mesh is not None:
        return read_ply_points(mesh)
    if labelled is not None:
        # Its colours are those of labels, not of the scene.
        return point_cloud(vertex_positions(labelled, read_ply_vertices(labelled)), None)
    return points_beside(folder)


def _chosen(numbers: Sequence[int]) -> set[int]:
    """Frames to take: every 20th of a scan that was exported whole."""
    whole = len(numbers) > EVERY and numbers[-1] - numbers[0] + 1 == len(numbers)
    return {n for n in numbers if not whole or n % EVERY == 0}


def _scannet_camera(path: Path, image: Path) -> Intrinsics:
    """The lens, held against the photograph: the file does not tell which size it is meant for."""
    matrix = read_numbers(path, columns=4, rows=4)
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    if is_file(image):
        width, height = image_size(image)
        off = max(abs(cx / width - 0.5), abs(cy / height - 0.5))
        if not off <= _OFF_CENTRE:
            raise InputError(
                f"{path}: expected the principal point near the middle of {image.name} of "
                f"{width}x{height} pixels, got ({cx:g}, {cy:g}); was it exported at another size?"
            )
    return _pinhole(fx, fy, cx, cy, None)


def _pinhole(
    fx: float, fy: float, cx: float, cy: float, size: tuple[int, int] | None
) -> Intrinsics:
    return Intrinsics(focal=(float(fx), float(fy)), centre=(float(cx), float(cy)), size=size)


IDR_FILES = ("cameras_sphere.npz", "cameras.npz")
_IMAGE_FOLDERS = ("images", "image")
_MASK_FOLDERS = ("masks", "mask")
_SCALES = (1.0, 0.5, 0.25, 0.125, 2.0)
# A principal point this far from the middle, as a share of the image, is no match.
_IDR_OFF_CENTRE = 0.15

_MAX_ENTRY = 1e15
"""Of a projection; pixels times scene units are far below."""


def find_idr(folder: Path) -> Path | None:
    """The file of projection matrices of an IDR capture, or None."""
    return next((folder / name for name in IDR_FILES if (folder / name).is_file()), None)


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
        raise MissingFileError(f"{folder}: expected {' or '.join(IDR_FILES)}, got neither.")
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
        lens = _pinhole(fx, fy, cx, cy, (width, height))
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
    what = "one world_mat a photograph, or photographs numbered as they are from the first on, got "
    what += f"{len(matrices)} for {len(images)} photographs"
    expect(told and min(numbers) == min(matrices), path, what, error=InputError)
    return dict(zip(images, numbers, strict=True))


def _missing(folder: Path, index: int) -> RawView:
    """A photograph that only its matrix tells of; its size is not known and not needed."""
    return RawView(
        image=folder / _IMAGE_FOLDERS[0] / f"world_mat_{index}",
        relative=f"world_mat_{index}",
        intrinsics=_pinhole(1, 1, 0.5, 0.5, (1, 1)),
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
    if errors[best] > _IDR_OFF_CENTRE:
        centre = points.mean(axis=0)
        raise InputError(
            f"{path}: expected principal points near the middle of photographs of "
            f"{sizes[0][0]}x{sizes[0][1]} at a scale of {', '.join(f'{s:g}' for s in _SCALES)}, "
            f"got ({centre[0]:.0f}, {centre[1]:.0f})."
        )
    return _SCALES[best]
