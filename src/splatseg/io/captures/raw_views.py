"""What a layout says of a photograph: where it is, its lens and its pose, and the camera of it."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import Camera, CameraModel
from splatseg.core.json_values import MAX_NUMBER
from splatseg.errors import InputError, quoted
from splatseg.io.foreign import expect
from splatseg.io.images import same_shape
from splatseg.io.schema import MAX_SIDE

_ROTATION_TOLERANCE = 1e-3

# A matrix this close to a rotation is kept to the last bit; others are made exact.
_ROTATION_EXACT = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class Intrinsics:
    """What a layout says of a lens, in pixels of an image of a size."""

    model: CameraModel = "pinhole"
    focal: tuple[float, float]
    """Across and down."""

    centre: tuple[float, float]
    """The principal point."""

    distortion: tuple[float, ...] = ()

    size: tuple[int, int] | None
    """Width and height; None where the layout does not say: the photograph's own are meant."""


OfSize: TypeAlias = Callable[[int, int], Intrinsics]
"""Intrinsics of a photograph by its width and height, where the layout does not tell its size."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RawView:
    """One photograph as a layout describes it, unchecked."""

    image: Path
    """Where the photograph should be."""

    relative: str
    """The photograph's path as the layout writes it; names come from it."""

    intrinsics: Intrinsics | OfSize
    cam_from_world: NDArray[np.float64]
    """4 x 4, OpenCV axes."""

    copy_of: int = 1
    """Pixels of the photograph that the intrinsics are of for one of `image`, a smaller copy."""

    split: str | None = None
    mask: Path | None = None
    depth: Path | None = None
    depth_unit: float | None = None


def intrinsics_of_size(view: RawView, size: tuple[int, int]) -> Intrinsics:
    """The intrinsics of a view whose photograph has this size."""
    if isinstance(view.intrinsics, Intrinsics):
        return view.intrinsics
    return view.intrinsics(size[0] * view.copy_of, size[1] * view.copy_of)


def scaled_to(intrinsics: Intrinsics, size: tuple[int, int], *, where: str) -> Intrinsics:
    """Intrinsics in pixels of a photograph of another size but the same shape.

    A photograph made smaller has whole pixels, so its sides may differ by up to one pixel from
    a uniform scale; each axis is scaled by its own ratio.

    Raises:
        InputError: If no uniform scale leads from one size to the other.
    """
    if intrinsics.size is None or intrinsics.size == size:
        return replace(intrinsics, size=size)
    width, height = intrinsics.size
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        got = f"{quoted(width)}x{quoted(height)}"
        raise InputError(
            f"{where}: expected intrinsics of 1 to {MAX_SIDE} pixels a side, got {got}."
        )
    if not same_shape(width, height, *size):
        turned = same_shape(height, width, *size)
        hint = "; turned by its EXIF orientation, perhaps" if turned else ""
        raise InputError(
            f"{where}: expected a photograph of {width}x{height} pixels or a uniform scale of it, "
            f"as its intrinsics say, got {size[0]}x{size[1]}{hint}."
        )
    sx, sy = size[0] / width, size[1] / height
    (fx, fy), (cx, cy) = intrinsics.focal, intrinsics.centre
    return replace(intrinsics, size=size, focal=(fx * sx, fy * sy), centre=(cx * sx, cy * sy))


def checked_pose(pose: NDArray[np.float64], *, where: str) -> NDArray[np.float64]:
    """A rigid 4 x 4 transform, with its rotation made exact where digits were lost.

    Raises:
        InputError: If it is not 4 x 4, holds NaN or infinity, or does not rotate.
    """
    if pose.shape != (4, 4):
        raise InputError(f"{where}: expected a 4 x 4 pose, got shape {pose.shape}.")
    bad = int((~np.isfinite(pose)).sum())
    if bad:
        raise InputError(f"{where}: expected a finite pose, got {bad} values of 16 that are not.")
    if np.abs(pose).max() > MAX_NUMBER:
        raise InputError(f"{where}: expected a pose of numbers up to {MAX_NUMBER:g}, got more.")
    rotation = pose[:3, :3]
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    determinant = float(np.linalg.det(rotation))
    what = f"a rotation in its pose, got a matrix with |R R^T - I| = {error:.3g} and determinant "
    what += f"{determinant:.3g}"
    expect(error <= _ROTATION_TOLERANCE and determinant >= 0, where, what, error=InputError)
    if np.abs(pose[3] - [0, 0, 0, 1]).max() > _ROTATION_EXACT:
        raise InputError(f"{where}: expected a pose whose last row is 0 0 0 1, got {pose[3]}.")
    exact = pose.copy()
    exact[3] = (0, 0, 0, 1)
    if error > _ROTATION_EXACT:
        left, _, right = np.linalg.svd(rotation)
        exact[:3, :3] = left @ right
    return exact


def inverse_pose(world_from_cam: NDArray[np.float64], *, where: str) -> NDArray[np.float64]:
    """cam_from_world of a finite 4 x 4 pose of a camera with OpenCV axes.

    Raises:
        InputError: If it is singular or not finite.
    """
    if not np.isfinite(world_from_cam).all():
        raise InputError(f"{where}: expected a finite pose, got NaN or infinity.")
    try:
        return np.linalg.inv(world_from_cam).astype(np.float64)
    except np.linalg.LinAlgError as error:
        raise InputError(f"{where}: expected a pose, got a singular matrix.") from error


def opencv_from_opengl(world_from_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """cam_from_world with OpenCV axes from world_from_cam with OpenGL axes (y up, z back).

    One that is singular or not finite comes back as it is: no pose, which `checked_pose` refuses in
    its own words.
    """
    if not np.isfinite(world_from_cam).all():
        return world_from_cam
    try:
        return np.linalg.inv(world_from_cam @ np.diag([1.0, -1.0, -1.0, 1.0])).astype(np.float64)
    except np.linalg.LinAlgError:
        return world_from_cam


def pose_of_quaternion(values: Sequence[float]) -> NDArray[np.float64]:
    """4 x 4 transform of qw qx qy qz tx ty tz; a zero quaternion gives NaN, found later."""
    w, x, y, z = values[:4]
    length = math.hypot(w, x, y, z)
    w, x, y, z = (v / length if 0 < length < math.inf else float("nan") for v in (w, x, y, z))
    matrix = np.eye(4)
    matrix[:3, :3] = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    matrix[:3, 3] = values[4:7]
    return matrix


def camera_of(
    view: RawView, intrinsics: Intrinsics, size: tuple[int, int], *, where: str
) -> Camera:
    """The camera of a view whose photograph has this size.

    Raises:
        InputError: If its pose or its lens is one that no camera has; `where` starts the message.
    """
    (fx, fy), (cx, cy) = intrinsics.focal, intrinsics.centre
    for name, value in (("fx", fx), ("fy", fy)):
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"{where}: expected a positive focal length, got {name} = {value:g}.")
    rest = (cx, cy, *intrinsics.distortion)
    if not all(math.isfinite(value) for value in rest):
        raise InputError(f"{where}: expected finite intrinsics, got {rest}.")
    pose = checked_pose(view.cam_from_world, where=where)
    angular = intrinsics.model in ("fisheye", "thin_prism_fisheye")
    distorted = angular or any(intrinsics.distortion)
    return Camera(
        width=size[0],
        height=size[1],
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        cam_from_world=torch.from_numpy(pose),
        model=intrinsics.model if distorted else "pinhole",
        distortion=intrinsics.distortion if distorted else (),
    )
