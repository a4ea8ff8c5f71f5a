"""Reads nerfstudio's transforms.json: poses in OpenGL axes, intrinsics per file or frame."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from splatseg.core import CameraModel, Capture, PointCloud
from splatseg.core.json_numbers import json_matrix, json_number
from splatseg.errors import FileFormatError, MissingFileError, quoted
from splatseg.io.captures._nerfstudio_split import frame_splits
from splatseg.io.captures._points import ply_holds_splats, read_ply_points
from splatseg.io.captures._points_beside import points_beside
from splatseg.io.captures.build import build_capture
from splatseg.io.captures.raw_views import MAX_SIDE, Intrinsics, OfSize, RawView, opencv_from_opengl
from splatseg.io.foreign import is_file
from splatseg.io.json_files import read_json

FILE = "transforms.json"
MILLIMETRE = 0.001
"""Unit of depth maps where the file does not say: nerfstudio's default, in scene units."""

_MODELS: dict[str, CameraModel] = {
    "OPENCV": "opencv",
    "PINHOLE": "opencv",
    "SIMPLE_PINHOLE": "opencv",
    "SIMPLE_RADIAL": "opencv",
    "RADIAL": "opencv",
    "PERSPECTIVE": "opencv",
    "FULL_OPENCV": "opencv",
    "OPENCV_FISHEYE": "fisheye",
    "MEI": "mei",
    "THIN_PRISM_FISHEYE": "thin_prism_fisheye",
}
_FOCALS = (
    (("fl_x", "fl_y"), None),
    (("camera_angle_x", "camera_angle_y"), 1.0),
    (("x_fov", "y_fov"), math.pi / 180),
)
"""Keys of focal lengths in pixels, and of fields of view with their unit in radians; the first that
is there counts. Those in degrees are instant-ngp's."""

LENS_KEYS: dict[CameraModel, tuple[str, ...]] = {
    "opencv": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
    "mei": ("xi", "k1", "k2", "p1", "p2"),
    "thin_prism_fisheye": ("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
}
"""Keys of the distortion of a lens model, in the order of `Camera.distortion`."""


_OTHER_LENSES = ("ftheta_p0", "latlong", "equirectangular")
"""Keys by which instant-ngp knows lenses that a plane does not hold."""


def read_nerfstudio(folder: Path, *, file: str = FILE, strict: bool = False) -> Capture:
    """Read a capture with a transforms.json; see `read_capture`.

    Intrinsics stand at the top or in a frame, which wins: ``fl_x fl_y cx cy w h`` in pixels
    (or ``camera_angle_x`` in radians, or ``x_fov`` in degrees; without ``w h`` the photograph's
    size is taken),
    ``camera_model``, and distortion as OpenCV names it.
    ``transform_matrix`` is world_from_cam with OpenGL axes (x right, y up, z backwards).
    ``mask_path``, ``depth_file_path`` and ``split`` of a frame are taken over. Start points
    come from ``ply_file_path``, else from points3D.ply, sparse_pc.ply or points3D.bin beside
    it. A ply_file_path that holds Gaussians is the capture's splat file as well; one that is not
    there is noted.

    Raises:
        MissingFileError: If transforms.json, or a file that it names (ply_file_path with `strict`
            only), is missing.
        InputError: If it is broken, or what it says cannot be.
    """
    path = folder / file
    content = read_json(path)
    frames = _frames(content, path)
    splits = frame_splits(content, frames)
    raw = [
        _raw_view(content, frame, split, path=path, index=i)
        for i, (frame, split) in enumerate(zip(frames, splits, strict=True))
    ]
    points, splats, notes = _points(content, folder, strict=strict)
    return build_capture(
        folder, raw, format="nerfstudio", points=points, splats=splats, notes=notes, strict=strict
    )


def frame_matrix(frame: Mapping[str, Any], *, where: str) -> NDArray[np.float64]:
    """The 4 x 4 ``transform_matrix`` of a frame: world_from_cam, OpenGL axes; NaN stays NaN.

    Raises:
        FileFormatError: If it is no matrix of numbers of 4 x 4 or 3 x 4.
    """
    matrix = json_matrix(
        frame.get("transform_matrix"),
        where=f"{where}: transform_matrix",
        shapes=((4, 4), (3, 4)),
        finite=False,
    )
    return matrix if len(matrix) == 4 else np.concatenate([matrix, [[0.0, 0.0, 0.0, 1.0]]])


def cam_from_world_of(frame: Mapping[str, Any], *, where: str) -> NDArray[np.float64]:
    """cam_from_world with OpenCV axes of a frame, see `opencv_from_opengl`."""
    return opencv_from_opengl(frame_matrix(frame, where=where))


def number(source: Mapping[str, Any], key: str, default: float | None, *, where: str) -> float:
    """A number of a JSON object.

    Raises:
        FileFormatError: If it lacks and has no default, or is something else.
    """
    return json_number(source.get(key, default), where=f"{where}: {key}")


def lens_of(source: Mapping[str, Any], *, where: str) -> tuple[CameraModel, tuple[float, ...]]:
    """Lens model and distortion of a transforms.json or of one frame of it.

    Raises:
        FileFormatError: If the camera model is not one that can be undistorted.
    """
    for key in _OTHER_LENSES:
        if source.get(key) not in (None, False):
            raise FileFormatError(
                f"{where}: expected a lens that can be undistorted, got one with {key}."
            )
    default = "OPENCV_FISHEYE" if source.get("is_fisheye") is True else "OPENCV"
    name = source.get("camera_model", default)
    if not isinstance(name, str) or name not in _MODELS:
        known = ", ".join(sorted(_MODELS))
        raise FileFormatError(f"{where}: expected a camera_model of {known}, got {quoted(name)}.")
    model = _MODELS[name]
    return model, tuple(number(source, key, 0.0, where=where) for key in LENS_KEYS[model])


def _frames(content: Mapping[str, Any], path: Path) -> list[Mapping[str, Any]]:
    frames = content.get("frames")
    if not isinstance(frames, list):
        raise FileFormatError(f"{path}: expected a list of frames, got none.")
    for i, frame in enumerate(cast(list[object], frames)):
        if not isinstance(frame, dict) or not isinstance(
            cast(dict[str, Any], frame).get("file_path"), str
        ):
            raise FileFormatError(f"{path}: expected a file_path in frames[{i}], got none.")
    return cast(list[Mapping[str, Any]], frames)


def _raw_view(
    content: Mapping[str, Any],
    frame: Mapping[str, Any],
    split: str | None,
    *,
    path: Path,
    index: int,
) -> RawView:
    relative = str(frame["file_path"]).replace("\\", "/")
    where = f"{path}: frame {quoted(relative)}"
    merged = {**content, **frame}
    return RawView(
        image=path.parent / relative,
        relative=relative,
        intrinsics=intrinsics_of_frame(merged, where=where),
        cam_from_world=cam_from_world_of(frame, where=where),
        split=split,
        mask=_beside(path, frame.get("mask_path")),
        depth=_beside(path, frame.get("depth_file_path")),
        depth_unit=number(merged, "depth_unit_scale_factor", MILLIMETRE, where=where)
        if frame.get("depth_file_path")
        else None,
    )


def _beside(path: Path, name: object) -> Path | None:
    return path.parent / name.replace("\\", "/") if isinstance(name, str) and name else None


def intrinsics_of_frame(source: Mapping[str, Any], *, where: str) -> Intrinsics | OfSize:
    """The lens of a frame, or of a file that has one lens; by its size where that is not said.

    Args:
        source: The keys of the frame over those of the file.
        where: The file and the frame; starts the message.

    Raises:
        FileFormatError: If a focal length lacks, or the camera model is not one that can be
            undistorted.
    """
    model, distortion = lens_of(source, where=where)
    if "w" not in source or "h" not in source:

        def of_size(width: int, height: int) -> Intrinsics:
            found = intrinsics_of_frame({**source, "w": width, "h": height}, where=where)
            return found if isinstance(found, Intrinsics) else found(width, height)

        _focals(source, (1, 1), where=where)
        return of_size
    width, height = size_of(source, where=where)
    fx, fy = _focals(source, (width, height), where=where)
    return Intrinsics(
        model=model,
        fx=fx,
        fy=fy,
        cx=number(source, "cx", width / 2, where=where),
        cy=number(source, "cy", height / 2, where=where),
        distortion=distortion,
        width=width,
        height=height,
    )


def _focals(source: Mapping[str, Any], size: tuple[int, int], *, where: str) -> tuple[float, float]:
    """Focal lengths in pixels, from one of `_FOCALS`.

    Either axis stands for both where only it is said.
    """
    for keys, radians in _FOCALS:
        found: list[float] = []
        for key, side in zip(keys, size, strict=True):
            if key in source:
                value = number(source, key, None, where=where)
                found.append(value if radians is None else focal_of(value * radians, side))
        if found:
            return found[0], found[-1]
    raise FileFormatError(
        f"{where}: expected a focal length (fl_x, camera_angle_x or x_fov), got none."
    )


def size_of(source: Mapping[str, Any], *, where: str) -> tuple[int, int]:
    """Width and height in pixels, ``w`` and ``h``; parts of pixels are left out.

    Raises:
        FileFormatError: If they lack, or no picture can have them.
    """
    width, height = (
        int(json_number(source.get(key), where=f"{where}: {key}", low=1, high=MAX_SIDE))
        for key in ("w", "h")
    )
    return width, height


def focal_of(angle: float, size: float) -> float:
    """Focal length in pixels of a field of view in radians; 0 (refused later) if impossible.

    Example:
        >>> round(focal_of(math.pi / 2, 800), 6)
        400.0
    """
    tangent = math.tan(angle / 2) if math.isfinite(angle) else 0.0
    return 0.5 * size / tangent if tangent > 0 else 0.0


def _points(
    content: Mapping[str, Any], folder: Path, *, strict: bool
) -> tuple[PointCloud | None, Path | None, list[str]]:
    """Start points, the same as splats where they are some, and notes."""
    name = content.get("ply_file_path")
    if not isinstance(name, str) or not name:
        return points_beside(folder), None, []
    path = folder / name.replace("\\", "/")
    if is_file(path):
        return read_ply_points(path), path if ply_holds_splats(path) else None, []
    missing = f"the start points that it names are not there ({quoted(name)})"
    if strict:
        raise MissingFileError(f"{folder / FILE}: {missing}.")
    return None, None, [missing]
