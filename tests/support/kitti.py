"""Tiny recordings in the layouts of KITTI's data sets, written by hand."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

DRIVE = "2013_05_28_drive_0003_sync"
WIDTH, HEIGHT = 16, 8

# Camera axes (x right, y down, z ahead) to those of a car (x ahead, y left, z up).
CAR_FROM_CAMERA = np.array([[0.0, 0, 1, 2], [-1, 0, 0, 0.5], [0, -1, 0, -1], [0, 0, 0, 1]])
# The laser is above the left camera, with the car's axes.
LASER_FROM_CAMERA = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, -0.4], [0, 0, 0, 1]])
# Rows of points of the lasers that look sideways: at the laser, in its axes.
LASER_FROM_SICK = np.array([[1.0, 0, 0, -1], [0, 1, 0, 0], [0, 0, 1, 0.2], [0, 0, 0, 1]])

FISHEYE = """%YAML:1.0
---
model_type: MEI
camera_name: fisheye
image_width: 16
image_height: 16
mirror_parameters:
   xi: 2.2
distortion_parameters:
   k1: 0.01
   k2: 1.6
   p1: 0.0004
   p2: -0.0002
projection_parameters:
   gamma1: 40.0
   gamma2: 41.0
   u0: 7.5
   v0: 7.25
"""


def numbers(values: Any) -> str:
    return " ".join(f"{value:.12g}" for value in np.asarray(values, np.float64).ravel())


def write(path: Path, content: str | bytes) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def picture(path: Path, width: int = WIDTH, height: int = HEIGHT, pixels: Any = None) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    blank = np.full((height, width, 3), 90, np.uint8)
    Image.fromarray(blank if pixels is None else pixels).save(path)
    return path


def write_bin(path: Path, rows: Any) -> Path:
    return write(path, np.asarray(rows, "<f4").tobytes())


def car_pose(frame: int) -> np.ndarray:
    """At (frame, 3, 1) in the world, looking along +y."""
    pose = np.eye(4)
    pose[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    pose[:3, 3] = frame, 3, 1
    return pose


def stored_matrix(name: str, values: Any) -> str:
    """A matrix as OpenCV stores it."""
    rows = np.asarray(values, np.float64)
    return (
        f'<{name} type_id="opencv-matrix"><rows>{rows.shape[0]}</rows><cols>{rows.shape[1]}</cols>'
        f"<dt>f</dt><data>{numbers(rows)} </data></{name}>\n"
    )


CUBE = 0.5 * np.array([[x, y, z] for x in (1, -1) for y in (1, -1) for z in (1, -1)])
"""Vertices of all boxes of KITTI-360; lengths are those of the transform."""


def stored_box(number: int, transform: Any, timestamp: int, /, **changes: str) -> str:
    """An object of data_3d_bboxes."""
    texts = {
        "index": str(number), "label": "car", "semanticId_orig": "13", "semanticId": "13",
        "instanceId": "7", "category": "car", "timestamp": str(timestamp),
        "dynamic": str(int(timestamp >= 0)), "start_frame": "0", "end_frame": "6",
    }  # fmt: skip
    matrices = {"transform": stored_matrix("transform", transform)}
    matrices["vertices"] = stored_matrix("vertices", CUBE)
    matrices["faces"] = stored_matrix("faces", [[0, 2, 1], [2, 3, 1]])
    words = {name: f"<{name}>{text}</{name}>\n" for name, text in texts.items()} | matrices
    body = "".join((words | changes).values())
    return f"<object{number}>\n{body}</object{number}>\n"


def write_boxes(
    root: Path, *boxes: str, drive: str = DRIVE, split: str = "train", head: str = ""
) -> Path:
    """A file of boxes."""
    content = f'<?xml version="1.0"?>\n{head}<opencv_storage>\n<version>1</version>\n'
    path = root / "data_3d_bboxes" / split / f"{drive}.xml"
    return write(path, content + "".join(boxes) + "</opencv_storage>\n")


def write_calibration(root: Path) -> None:
    folder = root / "calibration"
    right = CAR_FROM_CAMERA.copy()
    right[1, 3] -= 0.6
    rows = {"image_00": CAR_FROM_CAMERA, "image_01": right, "image_02": right, "image_03": right}
    write(
        folder / "calib_cam_to_pose.txt",
        "".join(f"{name}: {numbers(m[:3])}\n" for name, m in rows.items()),
    )
    lines = ["calib_time: 10-Dec-2013 09:56:32"]
    for number, base in (("00", 0.0), ("01", -6.0)):
        lines += [
            f"S_00_{number}: 20 10",
            f"R_rect_{number}: {numbers(np.eye(3))}",
            f"S_rect_{number}: {WIDTH}.0 {HEIGHT}.0",
            f"P_rect_{number}: {numbers([[10, 0, 7.5, base], [0, 11, 3.5, 0], [0, 0, 1, 0]])}",
        ]
    write(folder / "perspective.txt", "\n".join(lines) + "\n")
    write(folder / "image_02.yaml", FISHEYE)
    write(folder / "calib_cam_to_velo.txt", numbers(LASER_FROM_CAMERA[:3]) + "\n")
    write(folder / "calib_sick_to_velo.txt", numbers(LASER_FROM_SICK[:3]) + "\n")


def write_poses(root: Path, poses: Mapping[int, np.ndarray], drive: str = DRIVE) -> Path:
    rows = [f"{frame} {numbers(pose[:3])}" for frame, pose in poses.items()]
    return write(root / "data_poses" / drive / "poses.txt", "\n".join(rows) + "\n")


def write_drive(root: Path, *, frames: int = 6, drive: str = DRIVE) -> Path:
    """Frames 0 to `frames` - 1 with stereo photographs, all but the first with a pose."""
    write_calibration(root)
    write_poses(root, {frame: car_pose(frame) for frame in range(1, frames)}, drive)
    for frame in range(frames):
        for camera in ("image_00", "image_01"):
            picture(root / "data_2d_raw" / drive / camera / "data_rect" / f"{frame:010d}.png")
    return root
