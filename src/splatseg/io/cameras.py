"""Views of a scene as cameras/transforms.json: nerfstudio's layout with a few keys more.

Intrinsics that all frames share stand at the top. Every number is a float64 in full. Besides
nerfstudio's keys a frame has its view's ``name``, its ``split``, and where its files lie below
the capture (``source_file_path`` and so on), so that they are found again when it moved.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

from splatseg.core import Camera, View
from splatseg.core.scene import view_name_fault
from splatseg.errors import FileFormatError
from splatseg.io.captures.nerfstudio import LENS_KEYS, Frame, frame_matrix, frames_of, lens_of
from splatseg.io.captures.raw_views import checked_pose, opencv_from_opengl
from splatseg.io.foreign import derived_from, malformed

_MODEL_NAMES = {
    "pinhole": "PINHOLE",
    "opencv": "OPENCV",
    "fisheye": "OPENCV_FISHEYE",
    "mei": "MEI",
    "thin_prism_fisheye": "THIN_PRISM_FISHEYE",
}
_SIZES = ("w", "h", "fl_x", "fl_y", "cx", "cy")
_LENS = ("camera_model", *_SIZES, "xi", *LENS_KEYS["opencv"], "sx1", "sy1")
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_FILES = {"image": "file_path", "mask": "mask_path", "depth": "depth_file_path"}


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredFrame(Frame):
    """A view of a scene, which may have no photograph."""

    file_path: str | None = None  # pyright: ignore[reportIncompatibleVariableOverride]
    name: str
    split: str
    source_file_path: str | None = None
    source_mask_path: str | None = None
    source_depth_file_path: str | None = None


def cameras_content(views: Sequence[View], *, folder: Path, source: Path | None) -> dict[str, Any]:
    """The JSON object of cameras/transforms.json.

    Args:
        views: Views of the scene.
        folder: Where transforms.json will lie; paths are relative to it.
        source: The capture's folder; None where there is none.
    """
    frames = [_frame(view, folder=folder, source=source) for view in views]
    shared = {
        key: frames[0][key]
        for key in _LENS
        if frames and key in frames[0] and all(f.get(key) == frames[0][key] for f in frames)
    }
    rest = [{k: v for k, v in frame.items() if k not in shared} for frame in frames]
    return {**shared, "frames": rest}


def views_from_content(
    content: Mapping[str, Any], *, folder: Path, source: Path | None, path: Path
) -> tuple[View, ...]:
    """Views of cameras/transforms.json. Inverse of `cameras_content`.

    Files that are neither below `source` nor where they were keep their old place, so that a
    scene opens without its photographs.

    Args:
        content: The JSON object.
        folder: Where transforms.json lies.
        source: The capture's folder as it is now; None where it is not known.
        path: The file, for messages.

    Raises:
        FileFormatError: If an entry lacks or has the wrong type.
        InputError: If a pose or an intrinsic cannot be.
    """
    return tuple(
        _view(frame, folder=folder, source=source, where=f"{path}: frames[{i}]")
        for i, frame in enumerate(frames_of(content, StoredFrame, where=path))
    )


def source_paths(content: Mapping[str, Any]) -> list[str]:
    """Photographs of cameras/transforms.json as paths below the capture's folder."""
    frames = content.get("frames")
    entries = cast(list[object], frames) if isinstance(frames, list) else []
    return [
        str(cast(dict[str, Any], frame)["source_file_path"])
        for frame in entries
        if isinstance(frame, dict) and "source_file_path" in frame
    ]


def relative_path(path: Path, *, start: Path) -> str:
    """A path as seen from a folder, with slashes; absolute where no relative one exists."""
    try:
        return Path(os.path.relpath(path, start)).as_posix()
    except ValueError:
        # Two drives of Windows have no path between them.
        return path.absolute().as_posix()


def _frame(view: View, *, folder: Path, source: Path | None) -> dict[str, Any]:
    camera = view.camera
    world_from_cam = np.linalg.inv(camera.cam_from_world.detach().cpu().double().numpy())
    frame: dict[str, Any] = {"name": view.name, "split": view.split}
    for field, key in _FILES.items():
        file = cast(Path | None, getattr(view, field))
        if file is None:
            continue
        frame[key] = relative_path(file, start=folder)
        below = None if source is None else relative_path(file, start=source)
        if below is not None and not below.startswith(("../", "/")):
            frame[f"source_{key}"] = below
    if view.depth is not None and view.depth_unit is not None:
        frame["depth_unit_scale_factor"] = view.depth_unit
    frame |= {"camera_model": _MODEL_NAMES[camera.model], "w": camera.width, "h": camera.height}
    frame |= {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    frame |= dict(zip(LENS_KEYS.get(camera.model, ()), camera.distortion, strict=True))
    frame["transform_matrix"] = (world_from_cam @ _FLIP).tolist()
    return frame


def _view(frame: StoredFrame, *, folder: Path, source: Path | None, where: str) -> View:
    fault = view_name_fault(frame.name)
    if fault is not None:
        raise FileFormatError(f"{where}: {fault}.")
    image, mask, depth = (_resolve(frame, key, folder, source) for key in _FILES.values())
    with derived_from(where):
        return View(
            name=frame.name,
            split=frame.split,
            camera=_camera(frame, where=where),
            image=image,
            mask=mask,
            depth=depth,
            depth_unit=frame.depth_unit_scale_factor if depth else None,
        )


def _resolve(frame: StoredFrame, key: str, folder: Path, source: Path | None) -> Path | None:
    name, below = getattr(frame, key), getattr(frame, f"source_{key}")
    if source is not None and below is not None:
        return source / below
    return None if name is None else Path(os.path.normpath(folder / name))


def _camera(frame: StoredFrame, *, where: str) -> Camera:
    model, distortion = lens_of(frame, where=where)
    pinhole = frame.camera_model == _MODEL_NAMES["pinhole"]
    pose = checked_pose(opencv_from_opengl(frame_matrix(frame, where=where)), where=where)
    w, h, fx, fy, cx, cy = (_needed(frame, key, where) for key in _SIZES)
    with derived_from(where):
        return Camera(
            width=int(w),
            height=int(h),
            fx=fx,
            fy=fy,
            cx=cx,
            cy=cy,
            cam_from_world=torch.from_numpy(pose),
            model="pinhole" if pinhole else model,
            distortion=() if pinhole else distortion,
        )


def _needed(frame: StoredFrame, key: str, where: str) -> float:
    value = getattr(frame, key)
    if value is None:
        raise malformed(where, f"a number {key}, got none")
    return value
