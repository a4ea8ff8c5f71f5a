"""A short generated drive along a street: photographs, laser scans and what machines saw.

What `splatseg.synthetic` writes of a street (photographs, poses, start points, truth, machine
labels) and beside it scans of a laser, in the layout of the rendered street of the shared data:
views named ``train_0000``, ``test_0003``, ``testnovel_0000``, depth in steps of 4 mm,
``lidar.npz``, and a class of the sky in the label maps.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from splatseg.core import View
from splatseg.core.rigid import Similarity
from splatseg.synthetic import SyntheticScene, cast, start_points, write_capture
from splatseg_bench.worlds import drive_cameras, street
from support.ply import write_ply

VIEWS = 12
WIDTH, HEIGHT = 96, 64
SCANS = 3
BEAMS, COLUMNS = 16, 90
LENGTH = 36.0
"""Of the road, metres; seven tenths of it are driven."""

SENSOR_HEIGHT = 1.73
"""Of the laser above the road, metres."""

MAX_RANGE = 80.0
DEPTH_UNIT = 0.004
RANGE_UNIT = 0.002


def drive_views(
    scene: SyntheticScene, count: int = VIEWS, *, width: int = WIDTH, height: int = HEIGHT
) -> tuple[View, ...]:
    """Views along the drive in its order, every sixth a test view, and one novel view beside it."""
    along = drive_cameras(scene, count, test_every=6, width=width, height=height)
    named = [replace(view, name=f"{view.split}_{i:04d}") for i, view in enumerate(along)]
    turn = math.radians(8)
    rotation = torch.tensor(
        [[math.cos(turn), -math.sin(turn), 0], [math.sin(turn), math.cos(turn), 0], [0, 0, 1]],
        dtype=torch.float64,
    )
    middle = along[count // 2].camera
    aside = middle.centre + 1.2 * middle.world_from_cam[:3, 0]
    beside = middle.moved(
        Similarity(rotation=rotation, translation=aside - rotation @ middle.centre)
    )
    return (*named, View(name="testnovel_0000", camera=beside, split="test_novel"))


def sensor_poses(views: Sequence[View], count: int = SCANS) -> np.ndarray:
    """Poses of the laser at some of the views, (count, 4, 4): x forward, y left, z up."""
    along = [view for view in views if view.split != "test_novel"]
    poses = []
    for index in np.linspace(0, len(along) - 1, count).round().astype(int):
        camera = along[index].camera
        forward = camera.world_from_cam[:2, 2].numpy()
        forward = forward / np.linalg.norm(forward)
        pose = np.eye(4)
        pose[:2, 0] = forward
        pose[:2, 1] = -forward[1], forward[0]
        pose[:2, 3] = camera.centre[:2].numpy()
        pose[2, 3] = SENSOR_HEIGHT
        poses.append(pose)
    return np.stack(poses)


def lidar_arrays(
    scene: SyntheticScene, poses: np.ndarray, *, beams: int = BEAMS, columns: int = COLUMNS
) -> dict[str, np.ndarray]:
    """What ``lidar.npz`` holds: ranges without noise and true ids, 0 where nothing came back."""
    elevation = np.deg2rad(np.linspace(2.0, -24.8, beams))
    azimuth = np.linspace(-math.pi, math.pi, columns, endpoint=False)
    e, a = np.meshgrid(elevation, azimuth, indexing="ij")
    local = np.stack((np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)), axis=-1)
    instance_of = np.array([p.instance for p in scene.primitives])
    class_of = np.array([scene.class_of(p.instance) for p in scene.primitives])
    ranges, semantic, instance = [], [], []
    for pose in poses:
        directions = torch.from_numpy(local.reshape(-1, 3) @ pose[:3, :3].T)
        distance, which = cast(scene, torch.from_numpy(pose[:3, 3].copy()), directions)
        found = (which >= 0) & (distance <= MAX_RANGE)
        steps = torch.where(found, distance / RANGE_UNIT, 0.0).round()
        solid = which.clamp_min(0).numpy()
        ranges.append(steps.numpy().astype(np.uint16).reshape(beams, columns))
        semantic.append(np.where(found, class_of[solid], 0).astype(np.uint8))
        instance.append(np.where(found, instance_of[solid], 0).astype(np.uint16))
    size = (len(poses), beams, columns)
    return {
        "range_2mm": np.stack(ranges),
        "semantic": np.stack(semantic).reshape(size),
        "instance": np.stack(instance).reshape(size),
        "lidar_to_world": poses,
        "time": np.arange(len(poses)) * ((VIEWS - 1) / max(len(poses) - 1, 1)),
        "elevation": elevation,
        "azimuth": azimuth,
    }


def write_drive(
    folder: Path,
    *,
    seed: int = 0,
    views: int = VIEWS,
    width: int = WIDTH,
    height: int = HEIGHT,
    scans: int = SCANS,
    beams: int = BEAMS,
    columns: int = COLUMNS,
    points: int = 3000,
    length: float = LENGTH,
) -> None:
    """Write the capture into a new folder; the same bytes at every call.

    Args:
        folder: Where to write.
        seed: Of the street and of what machines see.
        views: Views along the drive; every sixth is a test view, and one novel view comes on top.
        width: Pixels a row.
        height: Rows.
        scans: Laser scans along the drive.
        beams: Rows of a scan.
        columns: Rays of a beam.
        points: Start points, off by 1.2 cm.
        length: Of the road, metres, at least 30.
    """
    scene = street(seed, length=length)
    seen = drive_views(scene, views, width=width, height=height)
    truths = write_capture(scene, folder, views=seen, points=100, seed=seed)
    # Few places are seen three times by so small views: one view is enough here.
    cloud = start_points(seen, truths, count=points, min_views=1, seed=seed)
    columns_of = [("float", n, cloud.points[:, k].tolist()) for k, n in enumerate("xyz")]
    if cloud.colours is not None:
        names = ("red", "green", "blue")
        columns_of += [("uchar", n, cloud.colours[:, k].tolist()) for k, n in enumerate(names)]
    write_ply({"vertex": columns_of}, folder / "points3D.ply")
    for name, truth in truths.items():
        steps = (truth.depth[::2, ::2] / DEPTH_UNIT).round().numpy().astype(np.uint16)
        Image.fromarray(steps).save(folder / "depth" / f"{name}.png")
    arrays = lidar_arrays(scene, sensor_poses(seen, scans), beams=beams, columns=columns)
    np.savez_compressed(folder / "lidar.npz", allow_pickle=False, **arrays)
    sky = _describe(folder, scene, arrays)
    for kind in ("semantic", "labels_semantic"):
        for path in sorted((folder / kind).glob("*.png")):
            with Image.open(path) as opened:
                ids = np.array(opened)
            Image.fromarray(np.where(ids == 0, sky, ids).astype(np.uint8)).save(path)


def _describe(folder: Path, scene: SyntheticScene, arrays: dict[str, np.ndarray]) -> int:
    """Units, scans and the sky in metadata.json, times of views in transforms.json.

    Returns:
        The id of the sky.
    """
    path = folder / "metadata.json"
    content = json.loads(path.read_text())
    content["depth"]["unit_m"] = DEPTH_UNIT
    scans, beams, columns = arrays["range_2mm"].shape
    content["lidar"] = {"scans": scans, "beams": beams, "columns": columns}
    sky = 1 + max(row.id for row in scene.classes.rows)
    blue = [70, 130, 180]
    row = {"id": sky, "name": "sky", "isthing": False, "colour": blue, "synonyms": []}
    content["classes"].append(row | {"present": True})
    path.write_text(json.dumps(content, indent=1))
    path = folder / "transforms.json"
    content = json.loads(path.read_text())
    for index, frame in enumerate(content["frames"]):
        frame |= {"time": index, "side": "L"}
    path.write_text(json.dumps(content, indent=1))
    return sky
