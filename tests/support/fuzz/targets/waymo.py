"""Drives as Waymo and nuScenes publish them: components in Parquet, tables in JSON, points."""

import json
import struct
from pathlib import Path

from splatseg.errors import FileFormatError, InputError
from splatseg.io.captures import read_capture
from splatseg.io.moving import read_moving
from splatseg.io.scans import read_scans
from splatseg_bench.layouts.waymo import read_waymo_scenes
from support.fuzz.targets.base import Target, target
from support.waymo_files import CONTEXT, SCHEMAS, tiny_rows, write_segment
from support.waymo_tfrecord import framed, frames_of, write_tfrecord

_TOKENS = "sensor", "calibrated_sensor", "ego_pose", "sample_data", "sample", "scene", "lidarseg"


def _of_waymo(component: str) -> None:
    @target(f"waymo-{component}.parquet")
    def make(folder: Path) -> Target:
        write_segment(folder)

        def read() -> None:
            (scene,) = read_waymo_scenes(folder)
            for name in () if scene.semantic is None else scene.semantic.read:
                scene.semantic.read[name]()
            scans = read_scans(folder)
            for name in scans.scan_names:
                scans.scan(name)
            read_moving(folder)

        return Target(file=folder / component / f"{CONTEXT}.parquet", read=read)


for _component in SCHEMAS:
    _of_waymo(_component)


@target("waymo.tfrecord")
def tfrecord(folder: Path) -> Target:
    """Frames of version 1."""
    file = write_tfrecord(folder, tiny_rows())

    def read() -> None:
        read_capture(file)
        scans = read_scans(file)
        for name in scans.scan_names:
            scans.scan(name)
        read_moving(file)

    return Target(file=file, read=read)


@target("waymo-frame.tfrecord")
def frame(folder: Path) -> Target:
    """A frame whose checksums are those of its damaged bytes."""
    file, framed_file = folder / "frame", folder / "a.tfrecord"
    file.write_bytes(frames_of(tiny_rows())[0])

    def read() -> None:
        framed_file.write_bytes(framed(file.read_bytes()))
        try:
            read_scans(framed_file)
            read_moving(framed_file)
        except InputError as error:  # of another file than the one that is damaged
            raise FileFormatError(f"{file}: {error}") from error

    return Target(file=file, read=read)


def _nuscenes(folder: Path) -> None:
    rows = {
        "sensor": {"channel": "LIDAR_TOP", "modality": "lidar"},
        "calibrated_sensor": {"sensor_token": "sensor", "camera_intrinsic": []},
        "ego_pose": {"timestamp": 7},
        "sample_data": {
            "sample_token": "sample", "ego_pose_token": "ego_pose", "is_key_frame": True,
            "calibrated_sensor_token": "calibrated_sensor", "timestamp": 7,
            "filename": "samples/LIDAR_TOP/a.pcd.bin",
        },
        "sample": {"scene_token": "scene", "timestamp": 7},
        "scene": {"name": "scene-0061"},
        "lidarseg": {"sample_data_token": "sample_data", "filename": "lidarseg/v1.0-mini/a.bin"},
        "category": {"name": "car", "index": 1},
    }  # fmt: skip
    for name in ("calibrated_sensor", "ego_pose"):
        rows[name] |= {"translation": [1, 2, 0.5], "rotation": [1, 0, 0, 0]}
    for kind in ("v1.0-mini", "samples/LIDAR_TOP", "lidarseg/v1.0-mini"):
        (folder / kind).mkdir(parents=True)
    for name, row in rows.items():
        (folder / "v1.0-mini" / f"{name}.json").write_text(json.dumps([{"token": name, **row}]))
    points = struct.pack("<10f", 1, 2, 3, 4, 0, 5, 6, 7, 8, 1)
    (folder / "samples/LIDAR_TOP/a.pcd.bin").write_bytes(points)
    (folder / "lidarseg/v1.0-mini/a.bin").write_bytes(bytes([1, 0]))


def _of_nuscenes(name: str, file: str) -> None:
    @target(f"nuscenes-{name}")
    def make(folder: Path) -> Target:
        _nuscenes(folder)

        def read() -> None:
            scans = read_scans(folder, format="nuscenes")
            for scan in scans.scan_names:
                scans.scan(scan)

        return Target(file=folder / file, read=read)


for _name in (*_TOKENS, "category"):
    _of_nuscenes(f"{_name}.json", f"v1.0-mini/{_name}.json")
_of_nuscenes("points.bin", "samples/LIDAR_TOP/a.pcd.bin")
_of_nuscenes("labels.bin", "lidarseg/v1.0-mini/a.bin")
