"""Scans, calibrations, poses and truth of KITTI's data sets."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from splatseg.io.captures import read_capture
from splatseg.io.moving import read_moving
from splatseg.io.scans import read_scans
from splatseg_bench.layouts import read_benchmark
from support.benchmark_layouts.kitti360 import write_window
from support.fuzz.targets.base import Target, target
from support.kitti import (
    DRIVE,
    HEIGHT,
    WIDTH,
    numbers,
    picture,
    stored_box,
    write,
    write_bin,
    write_boxes,
    write_drive,
)

_POINTS = [[5, 0, 0, 0.25], [0, 1, 2, 1.0]]
_DATA = f"data_3d_raw/{DRIVE}"
_STATIC = f"data_3d_semantics/train/{DRIVE}/static/0000000001_0000000002.ply"
_MAPS = f"data_2d_semantics/train/{DRIVE}/image_00"


def _scanned(path: Path, format: str) -> Callable[[], object]:
    def read() -> object:
        scans = read_scans(path, format=format)
        return [scans.scan(name) for name in scans.scan_names]

    return read


def _drive(folder: Path) -> None:
    write_drive(folder, frames=3)
    for camera in ("image_02",):
        picture(folder / f"data_2d_raw/{DRIVE}/{camera}/data_rgb/0000000001.png", 16, 16)
    for sensor, rows in (("velodyne_points", _POINTS), ("sick_points", [[1, 2], [3, 4]])):
        for frame in range(3):
            write_bin(folder / _DATA / sensor / f"data/{frame:010d}.bin", rows)
        times = "".join(f"2013-05-28 08:46:0{i}.500000000\n" for i in range(3))
        write(folder / _DATA / sensor / "timestamps.txt", times)
    write_window(folder / _STATIC, np.eye(3), np.eye(3), semantic=np.array([7, 26, 34]))
    ids = np.full((HEIGHT, WIDTH), 7)
    for kind, code in (("semantic", "u1"), ("confidence", "u2"), ("instance", "u2")):
        picture(folder / _MAPS / kind / "0000000001.png", pixels=ids.astype(code))


def _truth(folder: Path) -> object:
    scenes = read_benchmark("kitti360", folder)
    return [
        read()
        for scene in scenes
        for maps in (scene.semantic, scene.instances)
        if maps is not None
        for read in maps.read.values()
    ]


def _of_kitti360(name: str, file: str, read: Callable[[Path], object]) -> None:
    @target(f"kitti360-{name}")
    def make(folder: Path) -> Target:
        _drive(folder)
        return Target(file=folder / file, read=lambda: read(folder))


for _file in ("perspective.txt", "calib_cam_to_pose.txt"):
    _of_kitti360(_file, f"calibration/{_file}", read_capture)
_of_kitti360("poses.txt", f"data_poses/{DRIVE}/poses.txt", read_capture)
_of_kitti360(
    "image_02.yaml",
    "calibration/image_02.yaml",
    lambda folder: read_capture(folder / "data_2d_raw" / DRIVE / "image_02"),
)
_of_kitti360(
    "calib_cam_to_velo.txt",
    "calibration/calib_cam_to_velo.txt",
    lambda folder: _scanned(folder, "kitti360")(),
)
_of_kitti360(
    "velodyne.bin",
    f"{_DATA}/velodyne_points/data/0000000001.bin",
    lambda folder: _scanned(folder, "kitti360")(),
)
_of_kitti360(
    "timestamps.txt",
    f"{_DATA}/velodyne_points/timestamps.txt",
    lambda folder: _scanned(folder, "kitti360-sick")(),
)
_of_kitti360(
    "sick.bin",
    f"{_DATA}/sick_points/data/0000000001.bin",
    lambda folder: _scanned(folder, "kitti360-sick")(),
)
_of_kitti360("window.ply", _STATIC, lambda folder: _scanned(folder, "kitti360-points")())
_of_kitti360("window-truth.ply", _STATIC, _truth)
for _kind in ("semantic", "confidence", "instance"):
    _of_kitti360(f"{_kind}.png", f"{_MAPS}/{_kind}/0000000001.png", _truth)


@target("kitti360-boxes.xml")
def boxes(folder: Path) -> Target:
    """A car that drives and one that stands."""
    _drive(folder)
    place = np.diag([4.0, 2.0, 1.5, 1.0])
    file = write_boxes(folder, stored_box(1, place, 1), stored_box(2, place, -1))
    return Target(file=file, read=lambda: read_moving(file))


def _of_sequence(name: str, file: str) -> None:
    @target(f"semantic-kitti-{name}")
    def make(folder: Path) -> Target:
        sequence = folder / "sequences/00"
        write(sequence / "calib.txt", f"Tr: {numbers(np.eye(4)[:3])}\n")
        write(sequence / "poses.txt", f"{numbers(np.eye(4)[:3])}\n" * 2)
        write(sequence / "times.txt", "0.0\n0.1\n")
        write_bin(sequence / "velodyne/000000.bin", _POINTS)
        write(sequence / "labels/000000.label", np.array([40, 10 + (3 << 16)], "<u4").tobytes())
        return Target(file=sequence / file, read=_scanned(folder, "semantic-kitti"))


for _file in ("calib.txt", "poses.txt", "times.txt"):
    _of_sequence(_file, _file)
_of_sequence("velodyne.bin", "velodyne/000000.bin")
_of_sequence("label", "labels/000000.label")


def _of_recording(name: str, file: str) -> None:
    @target(f"kitti-raw-{name}")
    def make(folder: Path) -> Target:
        calibration = f"R: {numbers(np.eye(3))}\nT: 1 2 3\n"
        write(folder / "calib_imu_to_velo.txt", calibration)
        drive = folder / "2011_09_26_drive_0001_sync"
        for frame in range(2):
            packet = f"49.{frame} 8.4 112 0.1 0.2 0.3 " + "0 " * 24
            write(drive / f"oxts/data/{frame:010d}.txt", packet)
            write_bin(drive / f"velodyne_points/data/{frame:010d}.bin", _POINTS)
        return Target(file=folder / file, read=_scanned(drive, "kitti-raw"))


_of_recording("calib_imu_to_velo.txt", "calib_imu_to_velo.txt")
_of_recording("oxts.txt", "2011_09_26_drive_0001_sync/oxts/data/0000000001.txt")
