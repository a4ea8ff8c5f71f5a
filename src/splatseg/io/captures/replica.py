"""Reads Replica as Semantic-NeRF rendered it: photographs, and a text of poses."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatseg.core import Capture
from splatseg.core.json_numbers import json_number
from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.captures._points_beside import points_beside
from splatseg.io.captures.build import build_capture
from splatseg.io.captures.raw_views import MAX_SIDE, Intrinsics, RawView
from splatseg.io.json_files import read_json
from splatseg.io.text_numbers import read_numbers

FILE = "traj_w_c.txt"
SEQUENCE = "Sequence_1"
"""The walk that is read of a scene which has several, as Semantic-NeRF does."""

TRAIN_EVERY = 5
_TEST = TRAIN_EVERY // 2
_WIDTH, _HEIGHT = 640, 480
_MILLIMETRE = 0.001
_CAMERA_FILE = "cam_params.json"


def find_replica(folder: Path, sequence_name: str = SEQUENCE) -> Path | None:
    """The folder of the poses of a sequence, or of one of a scene; None where none is.

    Args:
        folder: A sequence, or a scene.
        sequence_name: Which of a scene's sequences is meant.
    """
    for sequence in (folder, folder / sequence_name):
        if (sequence / FILE).is_file() and (sequence / "rgb").is_dir():
            return sequence
    return None


def read_replica(folder: Path, *, strict: bool = False) -> Capture:
    """Read a sequence; see `read_capture`.

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
            f"{folder}: expected {FILE} and a folder rgb, there or in {SEQUENCE}, got none."
        )
    path = sequence / FILE
    rows = read_numbers(path, columns=16)
    camera = _intrinsics(sequence)
    depths = (sequence / "depth").is_dir()
    raw = [
        RawView(
            image=sequence / "rgb" / f"rgb_{i}.png",
            relative=f"rgb/rgb_{i}.png",
            intrinsics=camera,
            cam_from_world=_cam_from_world(row, where=f"{path}: row {i + 1}"),
            split={0: "train", _TEST: "test"}.get(i % TRAIN_EVERY, "unused"),
            depth=sequence / "depth" / f"depth_{i}.png" if depths else None,
            depth_unit=_MILLIMETRE if depths else None,
        )
        for i, row in enumerate(rows)
    ]
    note = (
        f"frames 0, {TRAIN_EVERY}, {2 * TRAIN_EVERY}, ... are training views and {_TEST}, "
        f"{_TEST + TRAIN_EVERY}, ... test views, as in Semantic-NeRF"
    )
    capture = build_capture(
        sequence, raw, format="replica", points=points_beside(sequence), notes=[note], strict=strict
    )
    return replace(capture, metres_per_unit=capture.metres_per_unit or 1.0)


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


def _cam_from_world(row: NDArray[np.float64], *, where: str) -> NDArray[np.float64]:
    return inverse_pose(row.reshape(4, 4), where=where)


def _intrinsics(sequence: Path) -> Intrinsics:
    path = next(
        (p for p in (sequence / _CAMERA_FILE, sequence.parent / _CAMERA_FILE) if p.is_file()), None
    )
    if path is None:
        focal = _WIDTH / 2
        return Intrinsics(
            fx=focal, fy=focal, cx=focal, cy=_HEIGHT / 2, width=_WIDTH, height=_HEIGHT
        )
    content = read_json(path).get("camera")
    if not isinstance(content, dict):
        raise FileFormatError(f"{path}: expected an object camera, got none.")
    values = {
        key: json_number(content.get(key), where=f"{path}: camera.{key}", low=0, high=MAX_SIDE)
        for key in ("w", "h", "fx", "fy", "cx", "cy")
    }
    return Intrinsics(
        fx=values["fx"],
        fy=values["fy"],
        cx=values["cx"],
        cy=values["cy"],
        width=round(values["w"]),
        height=round(values["h"]),
    )
