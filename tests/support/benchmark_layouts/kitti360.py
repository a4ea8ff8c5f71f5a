"""A rendered street as a drive of KITTI-360: photographs, calibration, poses, scans and truth.

Frames count poses of the drive, from 2 on. The layout's test views are every second frame, and the
scene has its own; as only training views have recorded evidence, a frame is left out before a test
view of the scene that would become a training view. What the scene does not have (scans, a right
camera, fisheye cameras) lacks in the drive too.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from splatseg.core import View
from splatseg.io.scans import read_scans
from support.benchmark_layouts.rooms import surface_points
from support.benchmark_layouts.source import Source

DRIVE = "2013_05_28_drive_0009_sync"
FIRST_FRAME = 2
PERIOD = 0.1
"""Seconds from frame to frame."""

UNKNOWN_OBJECT = 44
IDS = {
    "road": 7, "sidewalk": 8, "parking": 9, "building": 11, "wall": 12, "fence": 13, "bridge": 15,
    "pole": 17, "traffic light": 19, "traffic sign": 20, "vegetation": 21, "terrain": 22,
    "sky": 23, "person": 24, "rider": 25, "car": 26, "truck": 27, "bus": 28, "motorcycle": 32,
    "bicycle": 33,
}  # fmt: skip
"""KITTI-360's ids of the classes of ours that it has; all others are unknown objects."""

_INSTANCES = 1000
_STEPS = 40
_DAY = datetime(2013, 5, 28, 8, 46, 2, tzinfo=UTC)


def _turned(axis: Sequence[float], degrees: float) -> NDArray[np.float64]:
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(degrees)
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k)


def _rigid(rotation: NDArray[Any], translation: Sequence[float]) -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation
    return pose


_AHEAD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""Axes of a car (x ahead, y left, z up) from those of a camera that looks ahead."""

CAR_FROM_CAMERA = _rigid(_turned((1, 2, 0.5), 1.3) @ _AHEAD, (1.57, 0.31, -0.12))
"""Of the left camera before its rectification."""

R_RECT = {"00": _turned((0.2, 1, 0.1), 0.6), "01": _turned((1, -0.4, 0.2), -0.4)}


@dataclass(frozen=True)
class _Frame:
    """One pose of the drive."""

    number: int
    left: View
    right: View | None


def write_kitti360(source: Source, folder: Path) -> None:
    """The whole drive."""
    frames = _frames(source)
    poses = {frame.number: _car_pose(frame.left) for frame in frames}
    rights = [frame for frame in frames if frame.right is not None]
    calibration = folder / "calibration"
    calibration.mkdir(parents=True)
    rows = {"image_00": CAR_FROM_CAMERA}
    if rights:
        world_from_right = rights[0].right.camera.world_from_cam.numpy()
        rectified = np.linalg.inv(poses[rights[0].number]) @ world_from_right
        rows["image_01"] = rectified @ _rigid(R_RECT["01"], (0, 0, 0))
    _write_rows(rows, calibration / "calib_cam_to_pose.txt")
    _write_perspective(frames[0], rows, calibration / "perspective.txt")
    _write_poses(poses, frames, folder / "data_poses" / DRIVE)
    for frame in _photographed(frames):
        _write_photographs(source, frame, folder)
    _write_scans(source, poses, folder)
    _write_points(source, frames, folder)


def _frames(source: Source) -> list[_Frame]:
    """Poses of the drive in their order, by the numbers in the views' names."""
    numbered: dict[int, dict[str, View]] = {}
    for view in source.views:
        found = re.fullmatch(r"[a-z]+_(\d+)(?:_([LR]))?", view.name)
        sides = numbered.setdefault(int(found[1]) if found else -1, {})
        if found is None or (found[2] or "L") in sides:
            return _unordered(source)
        sides[found[2] or "L"] = view
    return [
        _Frame(number=FIRST_FRAME + i, left=sides["L"], right=sides.get("R"))
        for i, sides in sorted(numbered.items())
        if "L" in sides
    ]


def _unordered(source: Source) -> list[_Frame]:
    """Views of no drive: a test view after each training view, as long as there are any."""
    train, tests = list(source.capture.train_views), list(source.capture.test_views)
    views: list[View] = []
    for i, view in enumerate(train):
        views += [view, *tests[i : i + 1]]
    return [_Frame(number=FIRST_FRAME + i, left=v, right=None) for i, v in enumerate(views)]


def _photographed(frames: Sequence[_Frame]) -> list[_Frame]:
    """Frames with photographs: held-out views of the scene come second, fourth and so on."""
    kept: list[_Frame] = []
    for frame in frames:
        if frame.left.split == "test" and len(kept) % 2 == 0:
            if not kept:
                continue
            kept.pop()
        kept.append(frame)
    return kept


def _car_pose(view: View) -> NDArray[np.float64]:
    rectified = _rigid(R_RECT["00"], (0, 0, 0))
    return view.camera.world_from_cam.numpy() @ rectified @ np.linalg.inv(CAR_FROM_CAMERA)


def _numbers(values: NDArray[Any]) -> str:
    return " ".join(f"{value:.15g}" for value in np.asarray(values).ravel())


def _write_rows(rows: Mapping[str, NDArray[np.float64]], path: Path) -> None:
    path.write_text("".join(f"{name}: {_numbers(m[:3])}\n" for name, m in rows.items()))


def _write_perspective(frame: _Frame, rows: Mapping[str, Any], path: Path) -> None:
    camera = frame.left.camera
    # KITTI counts pixels from the centre of the first.
    k = np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])
    lines = ["calib_time: 10-Dec-2013 09:56:32", "corner_dist: 1.100000e-01"]
    for name in rows:
        number = name[-2:]
        base = 0.0
        if name == "image_01" and frame.right is not None:
            base = float((frame.right.camera.centre - frame.left.camera.centre).norm())
        projection = np.hstack((k, np.array([[-camera.fx * base], [0], [0]])))
        lines += [
            f"S_rect_{number}: {camera.width:.6e} {camera.height:.6e}",
            f"R_rect_{number}: {_numbers(R_RECT[number])}",
            f"P_rect_{number}: {_numbers(projection)}",
        ]
    path.write_text("\n".join(lines) + "\n")


def _write_poses(
    poses: Mapping[int, NDArray[np.float64]], frames: Sequence[_Frame], folder: Path
) -> None:
    folder.mkdir(parents=True)
    rows = [f"{frame} {_numbers(pose[:3])}" for frame, pose in poses.items()]
    (folder / "poses.txt").write_text("\n".join(rows) + "\n")
    cameras = [f"{f.number} {_numbers(f.left.camera.world_from_cam.numpy())}" for f in frames]
    (folder / "cam0_to_world.txt").write_text("\n".join(cameras) + "\n")


def _write_photographs(source: Source, frame: _Frame, folder: Path) -> None:
    for camera, view in (("image_00", frame.left), ("image_01", frame.right)):
        if view is None:
            continue
        name = f"{frame.number:010d}.png"
        with Image.open(view.image) as image:
            _save(
                np.asarray(image.convert("RGB")),
                folder / "data_2d_raw" / DRIVE / camera / "data_rect" / name,
            )
        classes, instances = _kitti_ids(
            source, source.ids("semantic", view), source.ids("instance", view)
        )
        truth = folder / "data_2d_semantics" / "train" / DRIVE / camera
        _save(classes.astype(np.uint8), truth / "semantic" / name)
        _save(instances.astype(np.uint16), truth / "instance" / name)
        _save(np.full(classes.shape, 65535, np.uint16), truth / "confidence" / name)


def _kitti_ids(
    source: Source, semantic: NDArray[Any], instance: NDArray[Any]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Classes in KITTI-360's ids; instances as class times 1000 and a number, 0 for stuff."""
    rows = source.metadata["classes"]
    table = np.zeros(max(row["id"] for row in rows) + 1, np.int64)
    for row in rows:
        table[row["id"]] = IDS.get(row["name"], UNKNOWN_OBJECT)
    things = np.isin(semantic, [row["id"] for row in rows if row.get("isthing", True)])
    classes = table[semantic]
    numbers = np.where(things, instance.astype(np.int64) % _INSTANCES, 0)
    return classes, classes * _INSTANCES + numbers


def _write_scans(source: Source, poses: Mapping[int, NDArray[np.float64]], folder: Path) -> None:
    """The laser's files; its place on the car is that of the first scan."""
    if not (source.folder / "lidar.npz").is_file():
        return
    with np.load(source.folder / "lidar.npz") as archive:
        times, laser = archive["time"].astype(int), archive["lidar_to_world"].astype(np.float64)
    scans = read_scans(source.folder, format="lidar-npz")
    numbers = [FIRST_FRAME + int(time) for time in times]
    placed = next(i for i, number in enumerate(numbers) if number in poses)
    car_from_laser = np.linalg.inv(poses[numbers[placed]]) @ laser[placed]
    laser_from_camera = np.linalg.inv(car_from_laser) @ CAR_FROM_CAMERA
    calibration = folder / "calibration"
    (calibration / "calib_cam_to_velo.txt").write_text(_numbers(laser_from_camera[:3]) + "\n")
    (calibration / "calib_sick_to_velo.txt").write_text(_numbers(np.eye(4)[:3]) + "\n")
    sensor = folder / "data_3d_raw" / DRIVE / "velodyne_points"
    (sensor / "data").mkdir(parents=True)
    for name, number in zip(scans.scan_names, numbers, strict=True):
        if number not in poses:
            continue
        scan = scans.scan(name)
        back = np.linalg.inv(poses[number] @ car_from_laser)
        points = scan.points.numpy() @ back[:3, :3].T + back[:3, 3]
        kept = np.ones(len(points), np.bool_)
        intensity = np.zeros(len(points)) if scan.intensity is None else scan.intensity.numpy()
        if number - 1 in poses:
            previous = poses[number - 1] @ car_from_laser
            points, kept = rolled(points, back @ previous)
        rows = np.column_stack((points, intensity / 255))[kept].astype("<f4")
        (sensor / "data" / f"{number:010d}.bin").write_bytes(rows.tobytes())
    stamps = [_DAY + timedelta(seconds=PERIOD * i) for i in range(max(numbers) + 1)]
    lines = [f"{stamp:%Y-%m-%d %H:%M:%S.%f}000" for stamp in stamps]
    (sensor / "timestamps.txt").write_text("\n".join(lines) + "\n")


def rolled(
    points: NDArray[np.float64], motion: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Points as a scanner that turns while it drives measures them: what a reader undoes.

    Found by steps, each of which takes the share of a turn of the last place; a point that a step
    takes over the seam behind the scanner may have two places or none.

    Returns:
        The points, and which of them were found.
    """
    turn = _rotation_vector(motion[:3, :3])
    place = points.copy()
    for _ in range(_STEPS):
        share = (np.arctan2(place[:, 1], place[:, 0]) / (2 * np.pi))[:, None]
        moved = points - share * motion[:3, 3]
        place = _turned_back(moved, share * turn)
    share = (np.arctan2(place[:, 1], place[:, 0]) / (2 * np.pi))[:, None]
    again = _turned_back(place, -share * turn) + share * motion[:3, 3]
    return place, np.abs(again - points).max(axis=1) < 1e-6


def _rotation_vector(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    axis = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0],
                     rotation[1, 0] - rotation[0, 1]]) / 2  # fmt: skip
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, (np.trace(rotation) - 1) / 2)
    return axis if sine < 1e-12 else axis / sine * angle


def _turned_back(points: NDArray[np.float64], vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Each point turned by minus its own rotation vector, by Rodrigues' formula."""
    angle = np.linalg.norm(vectors, axis=1, keepdims=True)
    axis = -vectors / np.maximum(angle, 1e-15)
    along = (axis * points).sum(axis=1, keepdims=True)
    turned = points * np.cos(angle) + np.cross(axis, points) * np.sin(angle)
    return turned + axis * along * (1 - np.cos(angle))


def _write_points(source: Source, frames: Sequence[_Frame], folder: Path) -> None:
    """The accumulated points of one window: the scene's labelled surface points."""
    points = surface_points(source)
    classes, instances = _kitti_ids(
        source, points["semantic"].astype(np.int64), points["instance"].astype(np.int64)
    )
    window = f"{frames[0].number:010d}_{frames[-1].number:010d}"
    static = folder / "data_3d_semantics" / "train" / DRIVE / "static"
    write_window(
        static / f"{window}.ply", points["xyz"], points["rgb"], semantic=classes,
        instance=instances,
    )  # fmt: skip


def write_window(
    path: Path,
    xyz: NDArray[Any],
    rgb: NDArray[Any],
    *,
    semantic: NDArray[Any] | None = None,
    instance: NDArray[Any] | None = None,
    visible: NDArray[Any] | None = None,
    confidence: NDArray[Any] | None = None,
) -> None:
    """Accumulated points with KITTI-360's columns; those of the test windows without labels."""
    columns = [(axis, "<f4") for axis in "xyz"] + [(c, "u1") for c in ("red", "green", "blue")]
    if semantic is not None:
        columns += [("semantic", "<i4"), ("instance", "<i4")]
    columns.append(("visible", "u1"))
    if semantic is not None:
        columns.append(("confidence", "<f4"))
    rows = np.zeros(len(xyz), columns)
    for i in range(3):
        rows["xyz"[i]], rows[("red", "green", "blue")[i]] = xyz[:, i], rgb[:, i]
    rows["visible"] = 1 if visible is None else visible
    if semantic is not None:
        rows["semantic"], rows["instance"] = semantic, semantic * _INSTANCES
        rows["confidence"] = 1 if confidence is None else confidence
        if instance is not None:
            rows["instance"] = instance
    words = {"<f4": "float", "u1": "uchar", "<i4": "int"}
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(xyz)}"]
    head += [f"property {words[kind]} {name}" for name, kind in columns]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(("\n".join([*head, "end_header"]) + "\n").encode() + rows.tobytes())


def _save(pixels: NDArray[Any], path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, format="PNG", compress_level=1)
