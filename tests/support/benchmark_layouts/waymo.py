"""The Waymo Open Dataset's layout: a drive with cameras and a laser, a Parquet file a component."""

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from splatseg.core import View
from splatseg.io.captures.waymo import CAMERA_CLASSES, LIDAR_CLASSES
from support.benchmark_layouts.source import Source
from support.waymo_files import LENS, frame, image, write_component

OFFSET = np.array([3000.0, -7000.0, 0.0])
"""Of the world that is written from that of the scene: coordinates of a city."""

CAMERA_OF_SIDE = {"L": 1, "R": 3}
TOP = 1
DIVISOR = 1000

LIDAR_NAMES = {
    "traffic sign": "sign", "wall": "building", "fence": "building", "terrain": "walkable",
}  # fmt: skip
CAMERA_NAMES = {
    "traffic sign": "sign", "wall": "building", "fence": "building", "terrain": "ground",
}  # fmt: skip
"""Classes of ours by what Waymo calls them; those that it lacks are static in photographs, and
undefined in scans."""

# x forward, y left, z up from OpenCV's axes: x right, y down, z forward.
_OPENCV_FROM_WAYMO = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def _pose(yaw: float, pitch: float, roll: float, place: tuple[float, ...]) -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("ZYX", (yaw, pitch, roll)).as_matrix()
    pose[:3, 3] = place
    return pose


VEHICLE_FROM_FRONT = _pose(0.01, 0.02, -0.015, (1.54, 0.02, 2.1))
TOP_YAW = 2.57
VEHICLE_FROM_TOP = _pose(TOP_YAW, 0.0, 0.0, (1.43, 0.0, 2.18))


def write_waymo(source: Source, folder: Path) -> None:
    """One segment: frames of one or two cameras, scans of the top laser where there are any."""
    times = _times(source)
    poses = _write_cameras(source, folder, times)
    lidar = source.folder / "lidar.npz"
    if lidar.is_file():
        with np.load(lidar) as arrays:
            poses |= _write_lidar(source, folder, dict(arrays))
    rows = [
        frame(time) | {"world_from_vehicle.transform": poses[time].ravel().tolist()}
        for time in sorted(poses)
    ]
    write_component(folder, "vehicle_pose", rows)


def _times(source: Source) -> dict[str, tuple[int, int]]:
    """Frame and camera of each view."""
    content = json.loads((source.folder / "transforms.json").read_text(encoding="utf-8"))
    told = {Path(f["file_path"]).stem: f for f in content["frames"]}
    found: dict[str, tuple[int, int]] = {}
    for i, view in enumerate(source.views):
        one = told.get(view.name, {})
        found[view.name] = one.get("time", i), CAMERA_OF_SIDE[one.get("side", "L")]
    return found


def _moved(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    moved = pose.copy()
    moved[:3, 3] += OFFSET
    return moved


def _write_cameras(
    source: Source, folder: Path, times: Mapping[str, tuple[int, int]]
) -> dict[int, NDArray[np.float64]]:
    """Photographs, labels and lenses; gives the vehicle's pose in each frame."""
    extrinsics = {1: VEHICLE_FROM_FRONT}
    lenses: dict[int, View] = {}
    poses: dict[int, NDArray[np.float64]] = {}
    images: list[dict[str, Any]] = []
    labels: list[dict[str, Any]] = []
    for view in sorted(source.views, key=lambda view: times[view.name]):
        time, camera = times[view.name]
        lenses.setdefault(camera, view)
        pose = _moved(view.camera.world_from_cam.numpy() @ _OPENCV_FROM_WAYMO)
        if camera not in extrinsics:
            extrinsics[camera] = np.linalg.inv(poses[time]) @ pose
        vehicle = pose @ np.linalg.inv(extrinsics[camera])
        poses.setdefault(time, vehicle)
        images.append(
            frame(time, camera=camera)
            | {"image": _jpeg(view), "pose.transform": vehicle.ravel().tolist()}
        )
        labels.append(
            frame(time, camera=camera)
            | {"panoptic_label_divisor": DIVISOR, "panoptic_label": _panoptic(source, view)}
        )
    calibrations = []
    for camera, view in lenses.items():
        lens = view.camera
        numbers = [lens.fx, lens.fy, lens.cx, lens.cy, *([0.0] * 5)]
        calibrations.append(
            {f"intrinsic.{name}": v for name, v in zip(LENS, numbers, strict=True)}
            | {"key.camera_name": camera, "width": lens.width, "height": lens.height}
            | {"extrinsic.transform": extrinsics[camera].ravel().tolist()}
        )
    write_component(folder, "camera_image", images)
    write_component(folder, "camera_segmentation", labels)
    write_component(folder, "camera_calibration", calibrations)
    return poses


def _write_lidar(
    source: Source, folder: Path, arrays: Mapping[str, NDArray[Any]]
) -> dict[int, NDArray[np.float64]]:
    """Scans of the top laser; gives the vehicle's pose in their frames.

    Waymo's columns go from the back over the left to the front, each in the middle of its share of
    a turn, however the laser is turned on the vehicle. The source's may go the other way, and lie
    beside the middle: the vehicle turns by that.
    """
    azimuth = arrays["azimuth"].astype(np.float64)
    order = slice(None) if azimuth[0] > azimuth[-1] else slice(None, None, -1)
    azimuth = azimuth[order]
    half = azimuth[0] - (np.pi - np.pi / len(azimuth))
    straight = VEHICLE_FROM_TOP @ _pose(-TOP_YAW, 0.0, 0.0, (0.0, 0.0, 0.0))
    laser_from_vehicle = _pose(half, 0.0, 0.0, (0.0, 0.0, 0.0)) @ np.linalg.inv(straight)
    elevation = arrays["elevation"].astype(np.float64)
    ranges = arrays["range_2mm"].astype(np.float32) * np.float32(0.002)
    classes = class_ids(source, LIDAR_CLASSES, LIDAR_NAMES, other=0)
    poses: dict[int, NDArray[np.float64]] = {}
    rows: dict[str, list[dict[str, Any]]] = {
        "lidar": [],
        "lidar_pose": [],
        "lidar_segmentation": [],
    }
    for i, world_from_laser in enumerate(arrays["lidar_to_world"].astype(np.float64)):
        time = round(float(arrays["time"][i]))
        pose = _moved(world_from_laser @ laser_from_vehicle)
        poses[time] = pose
        one = ranges[i][:, order]
        values = np.zeros((*one.shape, 4), np.float32)
        values[..., 0] = np.where(one > 0, one, -1)
        if "intensity" in arrays:
            values[..., 1] = arrays["intensity"][i][:, order]
        values[..., 3] = -1
        moments = np.zeros((*one.shape, 6), np.float32)
        moments[..., :3] = Rotation.from_matrix(pose[:3, :3]).as_euler("ZYX")[::-1]
        moments[..., 3:] = pose[:3, 3]
        labels = np.stack(
            (arrays["instance"][i][:, order], classes[arrays["semantic"][i]][:, order]), -1
        )
        key = frame(time, laser=TOP)
        rows["lidar"].append(key | image(values))
        rows["lidar_pose"].append(key | image(moments))
        rows["lidar_segmentation"].append(key | image(labels.astype(np.int32)))
    for component, found in rows.items():
        write_component(folder, component, found)
    calibration = {
        "key.laser_name": TOP,
        "extrinsic.transform": VEHICLE_FROM_TOP.ravel().tolist(),
        "beam_inclination.min": float(elevation.min()),
        "beam_inclination.max": float(elevation.max()),
        "beam_inclination.values": elevation[::-1].tolist(),
    }
    write_component(folder, "lidar_calibration", [calibration])
    return poses


def class_ids(
    source: Source, table: Any, names: Mapping[str, str], *, other: int
) -> NDArray[np.int64]:
    """Waymo's class by class of the source; 0 stays 0."""
    known = {row.name: row.id for row in table.rows}
    rows = source.metadata["classes"]
    found = np.zeros(max(row["id"] for row in rows) + 1, np.int64)
    for row in rows:
        found[row["id"]] = known.get(names.get(row["name"], row["name"]), other)
    return found


def _panoptic(source: Source, view: View) -> bytes:
    static = CAMERA_CLASSES.by_name("static").id
    classes = class_ids(source, CAMERA_CLASSES, CAMERA_NAMES, other=static)
    ids = classes[source.ids("semantic", view)] * DIVISOR
    ids += np.where(ids > 0, source.ids("instance", view) % DIVISOR, 0)
    return encoded(Image.fromarray(ids.astype(np.uint16)), "PNG")


def _jpeg(view: View) -> bytes:
    assert view.image is not None
    if view.image.suffix.lower() in (".jpg", ".jpeg"):
        return view.image.read_bytes()
    with Image.open(view.image) as picture:
        return encoded(picture.convert("RGB"), "JPEG")


def encoded(picture: Image.Image, format: str) -> bytes:
    """The bytes of a picture's file."""
    stream = io.BytesIO()
    picture.save(stream, format=format)
    return stream.getvalue()
