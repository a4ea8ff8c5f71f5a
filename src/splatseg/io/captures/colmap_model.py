"""A COLMAP model in memory, and what its camera models mean.

Camera models and their parameter order are those of COLMAP's ``sensor/models.h``; ids are what
the binary files hold.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from splatseg.core import CameraModel, PointCloud
from splatseg.errors import InputError, quoted
from splatseg.io.captures.raw_views import MAX_SIDE, Intrinsics

MODELS: dict[int, tuple[str, int]] = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}
"""Name and number of parameters by the id of the binary files."""

PARAMETER_COUNTS = dict(MODELS.values())
"""Number of parameters by name."""

_LENSES: dict[str, tuple[CameraModel, int]] = {
    "SIMPLE_PINHOLE": ("pinhole", 1),
    "PINHOLE": ("pinhole", 2),
    "SIMPLE_RADIAL": ("opencv", 1),
    "RADIAL": ("opencv", 1),
    "OPENCV": ("opencv", 2),
    "FULL_OPENCV": ("opencv", 2),
    "OPENCV_FISHEYE": ("fisheye", 2),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", 1),
    "RADIAL_FISHEYE": ("fisheye", 1),
    "SIMPLE_FISHEYE": ("fisheye", 1),
    "FISHEYE": ("fisheye", 2),
    "THIN_PRISM_FISHEYE": ("thin_prism_fisheye", 2),
}
# Our lens model and the number of focal lengths. The principal point follows them, then the
# distortion in OpenCV's order, of which the simpler models give the first values.


@dataclass(frozen=True, slots=True, kw_only=True)
class ColmapCamera:
    """One lens as COLMAP stores it."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class ColmapImage:
    """One registered photograph."""

    name: str
    camera_id: int
    cam_from_world: NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class ColmapRig:
    """Cameras that are mounted together: cam_from_rig by camera id."""

    cam_from_rig: dict[int, NDArray[np.float64]]


@dataclass(frozen=True, slots=True, kw_only=True)
class ColmapFrame:
    """One moment of a rig and the images taken at it."""

    rig_id: int
    rig_from_world: NDArray[np.float64]

    images: tuple[tuple[int, int], ...]
    """Pairs of camera id and image id."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ColmapModel:
    """A sparse model. Rigs and frames are empty in the older layout of three files."""

    cameras: dict[int, ColmapCamera]
    images: dict[int, ColmapImage]
    points: PointCloud | None
    rigs: dict[int, ColmapRig] = field(default_factory=dict[int, ColmapRig])
    frames: tuple[ColmapFrame, ...] = ()


def intrinsics_of(camera: ColmapCamera, *, where: str) -> Intrinsics:
    """The lens of a COLMAP camera as ours.

    SIMPLE_RADIAL and RADIAL are OpenCV's k1 and k2; the fisheye models are OpenCV's polynomial
    in the angle, theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8). Models
    that are not ours go through pycolmap, see `lens_by_pycolmap`.

    Raises:
        InputError: If the model is one that cannot be undistorted, or parameters lack.
        MissingPackageError: If it needs pycolmap, and that is not installed.
    """
    if camera.model not in PARAMETER_COUNTS:
        raise InputError(
            f"{where}: expected a camera model of COLMAP ({', '.join(PARAMETER_COUNTS)}), "
            f"got {quoted(camera.model)}."
        )
    expected, values = PARAMETER_COUNTS[camera.model], camera.parameters
    if len(values) != expected:
        raise InputError(
            f"{where}: expected {expected} parameters of a {camera.model} camera, "
            f"got {len(values)}."
        )
    if camera.model not in _LENSES:
        if not (1 <= camera.width <= MAX_SIDE and 1 <= camera.height <= MAX_SIDE):
            raise InputError(f"{where}: expected 1 to {MAX_SIDE} pixels a side, got others.")
        from splatseg.io.captures._pycolmap_lens import lens_by_pycolmap

        return lens_by_pycolmap(camera.model, camera.width, camera.height, values, where=where)
    model, focals = _LENSES[camera.model]
    cx, cy, *distortion = values[focals:]
    return Intrinsics(
        model=model,
        fx=values[0],
        fy=values[focals - 1],
        cx=cx,
        cy=cy,
        distortion=tuple(distortion),
        width=camera.width,
        height=camera.height,
    )


def rigid_matrix(values: tuple[float, ...]) -> NDArray[np.float64]:
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


def poses_of(model: ColmapModel, *, where: str) -> dict[int, NDArray[np.float64]]:
    """cam_from_world by image id; frames of rigs, where there are any, come before images.

    COLMAP does the same when it opens the newer layout:
    cam_from_world = cam_from_rig @ rig_from_world.

    Raises:
        InputError: If a frame names a rig, a camera or an image that the model does not have.
    """
    poses = {id: image.cam_from_world for id, image in model.images.items()}
    for frame in model.frames:
        rig = model.rigs.get(frame.rig_id)
        if rig is None:
            raise InputError(f"{where}: a frame names rig {frame.rig_id}, which is not there.")
        for camera_id, image_id in frame.images:
            if image_id not in poses:
                # An image of the frame that was not registered has no row of its own.
                continue
            if camera_id not in rig.cam_from_rig:
                raise InputError(
                    f"{where}: image {image_id} was taken by camera {camera_id}, whose place in "
                    f"rig {frame.rig_id} is not known."
                )
            poses[image_id] = rig.cam_from_rig[camera_id] @ frame.rig_from_world
    return poses
