"""Views of a scene as cameras/transforms.json: nerfstudio's layout with a few keys more.

Intrinsics that all frames share stand at the top. Every number is a float64 in full. Besides
nerfstudio's keys a frame has its view's ``name``, its ``split``, and where its files lie below
the capture (``source_file_path`` and so on), so that they are found again when it moved.
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

from splatseg.core import Camera, View
from splatseg.core.scene import view_name_fault
from splatseg.errors import FileFormatError, quoted
from splatseg.io.captures.nerfstudio import (
    LENS_KEYS,
    MILLIMETRE,
    frame_matrix,
    lens_of,
    number,
    size_of,
)
from splatseg.io.captures.raw_views import checked_pose, opencv_from_opengl
from splatseg.io.foreign import made_from

_MODEL_NAMES = {
    "pinhole": "PINHOLE",
    "opencv": "OPENCV",
    "fisheye": "OPENCV_FISHEYE",
    "mei": "MEI",
    "thin_prism_fisheye": "THIN_PRISM_FISHEYE",
}
_SIZES = ("camera_model", "w", "h", "fl_x", "fl_y", "cx", "cy")
_LENS = (*_SIZES, "xi", *LENS_KEYS["opencv"], "sx1", "sy1")
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_FILES = {"image": "file_path", "mask": "mask_path", "depth": "depth_file_path"}


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
    frames = content.get("frames")
    if not isinstance(frames, list):
        raise FileFormatError(f"{path}: expected a list of frames, got none.")
    return tuple(
        _view(content, frame, folder=folder, source=source, where=f"{path}: frames[{i}]")
        for i, frame in enumerate(cast(list[object], frames))
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
    frame |= {
        "camera_model": _MODEL_NAMES[camera.model],
        "w": camera.width,
        "h": camera.height,
    }
    frame |= {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    frame |= dict(zip(LENS_KEYS.get(camera.model, ()), camera.distortion, strict=True))
    frame["transform_matrix"] = (world_from_cam @ _FLIP).tolist()
    return frame


def _view(
    content: Mapping[str, Any],
    frame: object,
    *,
    folder: Path,
    source: Path | None,
    where: str,
) -> View:
    if not isinstance(frame, dict):
        raise FileFormatError(f"{where}: expected an object, got {type(frame).__name__}.")
    entry = cast(dict[str, Any], frame)
    merged = {**content, **entry}
    name, split = entry.get("name"), entry.get("split")
    if not isinstance(name, str) or not isinstance(split, str):
        raise FileFormatError(
            f"{where}: expected a name and a split, got {quoted(name)} and {quoted(split)}."
        )
    fault = view_name_fault(name)
    if fault is not None:
        raise FileFormatError(f"{where}: {fault}.")
    files = {
        field: _resolve(entry, key, folder=folder, source=source) for field, key in _FILES.items()
    }
    with made_from(where):
        return View(
            name=name,
            split=split,
            camera=_camera(merged, entry, where=where),
            image=files["image"],
            mask=files["mask"],
            depth=files["depth"],
            depth_unit=number(merged, "depth_unit_scale_factor", MILLIMETRE, where=where)
            if files["depth"]
            else None,
        )


def _resolve(
    frame: Mapping[str, Any], key: str, *, folder: Path, source: Path | None
) -> Path | None:
    name, below = frame.get(key), frame.get(f"source_{key}")
    if source is not None and isinstance(below, str):
        return source / below
    if not isinstance(name, str):
        return None
    return Path(os.path.normpath(folder / name))


def _camera(merged: Mapping[str, Any], frame: Mapping[str, Any], *, where: str) -> Camera:
    model, distortion = lens_of(merged, where=where)
    pinhole = merged.get("camera_model") == _MODEL_NAMES["pinhole"]
    matrix = frame_matrix(frame, where=where)
    pose = checked_pose(opencv_from_opengl(matrix), where=where)
    width, height = size_of(merged, where=where)
    with made_from(where):
        return Camera(
            width=width,
            height=height,
            fx=number(merged, "fl_x", None, where=where),
            fy=number(merged, "fl_y", None, where=where),
            cx=number(merged, "cx", None, where=where),
            cy=number(merged, "cy", None, where=where),
            cam_from_world=torch.from_numpy(pose),
            model="pinhole" if pinhole else model,
            distortion=() if pinhole else distortion,
        )
