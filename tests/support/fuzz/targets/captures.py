"""Posed photographs, in every tool's files."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from splatseg.io.captures import read_capture
from splatseg.io.captures.colmap import read_colmap_model
from splatseg.pose._doctor_files import read_for_doctor
from support.fuzz.targets.base import (
    GOLDEN,
    HEIGHT,
    WIDTH,
    Target,
    photographs,
    target,
)


def _frames(**more: Any) -> list[dict[str, Any]]:
    pose = np.diag([1.0, -1.0, -1.0, 1.0]).tolist()
    return [
        {"file_path": f"images/{i:03d}.png", "transform_matrix": pose, **more} for i in range(3)
    ]


def _capture(folder: Path, file: str, content: bytes) -> Target:
    photographs(folder)
    (folder / file).write_bytes(content)
    return Target(file=folder / file, read=lambda: read_capture(folder))


@target("transforms.json")
def nerfstudio(folder: Path) -> Target:
    """nerfstudio, with every key that is read."""
    lens = {"camera_model": "OPENCV", "w": WIDTH, "h": HEIGHT, "fl_x": 9.0, "fl_y": 9.0}
    lens |= {"cx": 4.0, "cy": 3.0, "k1": 0.01, "depth_unit_scale_factor": 0.001}
    frames = _frames(mask_path="mask.png", depth_file_path="mask.png", split="train")
    frames[0]["split"] = "test"
    Image.new("L", (WIDTH, HEIGHT), 255).save(folder / "mask.png")
    content = {**lens, "frames": frames, "train_filenames": ["images/001.png"]}
    content |= {"applied_transform": np.eye(4)[:3].tolist(), "ply_file_path": "points.ply"}
    (folder / "points.ply").write_bytes(_ascii_ply())
    return _capture(folder, "transforms.json", json.dumps(content).encode())


@target("transforms-without-sizes.json")
def without_sizes(folder: Path) -> Target:
    """What Blender and instant-ngp leave out, with photographs elsewhere than listed."""
    frames = _frames()
    for frame in frames:
        frame["file_path"] = "./" + frame["file_path"].removesuffix(".png")
    frames[0] |= {"x_fov": 50, "y_fov": 40, "mask_path": "images/001.png"}
    frames[1]["transform_matrix"] = [[None] * 4, *frames[1]["transform_matrix"][1:]]
    content = {"camera_angle_x": 0.8, "k1": 0.01, "ply_file_path": "p.ply", "frames": frames}
    (folder / "p.ply").write_bytes(_ascii_ply().replace(b"1 2 3", b"nan 2 3"))
    made = _capture(folder, "transforms.json", json.dumps(content).encode())
    (folder / "images").rename(folder / "images_4")
    return made


@target("transforms-elsewhere.json")
def elsewhere(folder: Path) -> Target:
    """Paths of another machine."""
    frames = _frames()
    for frame in frames:
        frame["file_path"] = "C:\\scene\\" + frame["file_path"].replace("/", "\\")
    content = {"w": WIDTH, "h": HEIGHT, "x_fov": 50, "frames": frames}
    return _capture(folder, "transforms.json", json.dumps(content).encode())


@target("doctor-transforms.json")
def doctor(folder: Path) -> Target:
    """A capture whose sizes contradict its photographs, as `splatseg doctor` reads it."""
    lens = {"camera_model": "OPENCV", "w": 3 * WIDTH, "h": HEIGHT, "fl_x": 9.0}
    content = {**lens, "frames": _frames(), "applied_transform": np.eye(4)[:3].tolist()}
    made = _capture(folder, "transforms.json", json.dumps(content).encode())
    return Target(file=made.file, read=lambda: read_for_doctor(folder))


@target("transforms_train.json")
def blender(folder: Path) -> Target:
    """NeRF-synthetic."""
    content = {"camera_angle_x": 0.8, "frames": _frames()}
    return _capture(folder, "transforms_train.json", json.dumps(content).encode())


@target("metadata.json")
def metadata(folder: Path) -> Target:
    """Beside a capture: classes, up, unit."""
    frames = {"camera_angle_x": 0.8, "frames": _frames()}
    (folder / "transforms_train.json").write_text(json.dumps(frames))
    rows = [{"id": 1, "name": "cup", "isthing": True, "colour": [1, 2, 3]}]
    content = {"classes": rows, "instances": rows, "up_axis": "+z", "units": "m"}
    return _capture(folder, "metadata.json", json.dumps(content).encode())


@target("poses_bounds.npy")
def llff(folder: Path) -> Target:
    """LLFF."""
    row = [0, 1, 0, 0, HEIGHT, 1, 0, 0, 0, WIDTH, 0, 0, -1, 0, 9, 0.1, 10]
    np.save(folder / "poses_bounds.npy", np.array([row] * 3, np.float64))
    return _capture(folder, "poses_bounds.npy", (folder / "poses_bounds.npy").read_bytes())


@target("cameras_sphere.npz")
def idr(folder: Path) -> Target:
    """IDR."""
    matrix = np.array([[9, 0, 4, 0], [0, 9, 3, 0], [0, 0, 1, 0], [0, 0, 0, 1]], np.float32)
    file = folder / "cameras_sphere.npz"
    np.savez(file, **{f"world_mat_{i}": matrix for i in range(3)})
    return _capture(folder, file.name, file.read_bytes())


def _colmap(name: str, kind: str, stem: str) -> None:
    @target(name)
    def make(folder: Path) -> Target:
        model = folder / "sparse"
        model.mkdir()
        for file in (GOLDEN / "colmap" / kind).iterdir():
            (model / file.name).write_bytes(file.read_bytes())
        return Target(file=model / f"{stem}.{kind}", read=lambda: read_colmap_model(model))


for _kind in ("bin", "txt"):
    for _stem in ("cameras", "images", "points3D", "rigs", "frames"):
        if (GOLDEN / "colmap" / _kind / f"{_stem}.{_kind}").is_file():
            _colmap(f"colmap-{_stem}.{_kind}", _kind, _stem)


@target("colmap-capture")
def colmap_capture(folder: Path) -> Target:
    """A whole capture by its cameras.bin, for what is made of the numbers."""
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    lens = struct.pack("<IiQQ4d", 1, 1, WIDTH, HEIGHT, 9, 9, 4, 3)
    (model / "cameras.bin").write_bytes(struct.pack("<Q", 1) + lens)
    images = struct.pack("<Q", 3)
    for i in range(3):
        images += struct.pack("<I7dI", i, 1, 0, 0, 0, 0, 0, 0, 1) + b"%03d.png\0" % i
        images += struct.pack("<Q", 0)
    (model / "images.bin").write_bytes(images)
    return _capture(folder, "sparse/0/cameras.bin", (model / "cameras.bin").read_bytes())


@target("colmap-beside-each-other")
def colmap_beside(folder: Path) -> Target:
    """Two models and a lens of thin prisms, of what convert.py of 3DGS starts from."""
    photographs(folder)
    (folder / "images").rename(folder / "input")
    for number in (0, 1):
        model = folder / "distorted" / "sparse" / str(number)
        model.mkdir(parents=True)
        lens = f"1 THIN_PRISM_FISHEYE {WIDTH} {HEIGHT} 9 9 4 3 .01 0 0 0 0 0 .001 0\n"
        (model / "cameras.txt").write_text(lens)
        rows = [f"{i + 1} 1 0 0 0 {i} 0 0 1 {i:03d}.jpg\n\n" for i in range(2 + number)]
        (model / "images.txt").write_text("".join(rows))
    return Target(file=folder / "distorted/sparse/1/images.txt", read=lambda: read_capture(folder))


@target("colmap-thin-prism")
def colmap_thin_prism(folder: Path) -> Target:
    """The lens of the same."""
    made = colmap_beside(folder)
    return Target(file=folder / "distorted/sparse/1/cameras.txt", read=made.read)


def _ascii_ply() -> bytes:
    head = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n"
    head += "property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n"
    return (head + "end_header\n0 0 1 255 0 0\n1 2 3 0 255 9\n").encode()


@target("points-ascii.ply")
def points_ascii(folder: Path) -> Target:
    """Start points as text."""
    (folder / "transforms_train.json").write_text(
        json.dumps({"camera_angle_x": 0.8, "frames": _frames()})
    )
    return _capture(folder, "points3D.ply", _ascii_ply())


@target("points-binary.ply")
def points_binary(folder: Path) -> Target:
    """Start points in binary."""
    head, _, _ = _ascii_ply().partition(b"0 0 1")
    body = struct.pack("<3f3B", 0, 0, 1, 255, 0, 0) + struct.pack("<3f3B", 1, 2, 3, 0, 255, 9)
    (folder / "transforms_train.json").write_text(
        json.dumps({"camera_angle_x": 0.8, "frames": _frames()})
    )
    return _capture(folder, "points3D.ply", head.replace(b"ascii", b"binary_little_endian") + body)
