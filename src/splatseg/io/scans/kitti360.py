"""Scans of KITTI-360: the turning laser, the two that look sideways, and accumulated points.

    data_3d_raw/DRIVE/velodyne_points/data/0000000005.bin    float32 x y z intensity, its own axes
    data_3d_raw/DRIVE/sick_points/data/0000000123.bin        float32, two a point; own numbers
    data_3d_semantics/train/DRIVE/static/0000000002_0000000385.ply    points of the world, labelled

`captures.kitti360` says how a drive, a window of frames and a sensor are named. All of it is in the
world of the poses, with z up.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from splatseg.errors import InputError, MissingFileError
from splatseg.io.captures.kitti360 import (
    ACCUMULATED,
    SCANS,
    SICK,
    VELODYNE,
    Drive,
    drive_at,
    find_drive,
    read_poses,
    sick_pose,
    static_windows,
    velodyne_pose,
)
from splatseg.io.foreign import expect
from splatseg.io.label_tables import label_table
from splatseg.io.scans._source import (
    RawScan,
    Scans,
    numbered_files,
    read_in_pieces,
    read_records,
    skipped,
)
from splatseg.io.scans.files import ply_pieces, positions, whole_ids
from splatseg.io.scans.kitti import read_points
from splatseg.io.text_numbers import read_times, time_at

_MAX_GAP = 3
"""Frames between two poses, beyond which nobody knows how the car went from one to the other."""

_INSTANCES = 1000
"""An instance is its class times this and a number; 0 of it is none."""


def find_velodyne(path: Path) -> bool:
    """Whether a path names a drive with scans of the turning laser, and nothing else of it."""
    return _has_sensor(path, VELODYNE)


def find_sick(path: Path) -> bool:
    """The same of the lasers that look sideways."""
    return _has_sensor(path, SICK)


def find_accumulated(path: Path) -> bool:
    """Whether a path names a drive with accumulated points."""
    drive = find_drive(path)
    if drive is None or drive.top not in (None, ACCUMULATED):
        return False
    return bool(static_windows(drive, part=_part(drive)))


def read_velodyne(path: Path) -> Scans:
    """Scans of the turning laser that have a pose; names are the frames'.

    The laser turns once a frame, and the car moves meanwhile: points are brought to where the car
    is at the frame's pose, as KITTI-360's own accumulation does it (`unrolled`).

    Raises:
        MissingFileError: If there are no scans, or poses or calibration lack.
        InputError: If one of these is broken, or no scan has a pose.
    """
    drive = drive_at(path)
    meant = {n: file for n, file in _files(drive, VELODYNE).items() if drive.has(int(n))}
    poses = read_poses(Drive(root=drive.root, name=drive.name))
    car_from_laser = velodyne_pose(drive)
    posed = _posed(drive, path, meant, [name for name in meant if int(name) in poses])
    times = read_times(drive.of(SCANS, VELODYNE, "timestamps.txt"))

    def read(name: str) -> RawScan:
        frame = int(name)
        points, intensity = read_points(meant[name])
        motion = _motion(poses, frame)
        if motion is not None:
            motion = np.linalg.inv(car_from_laser) @ motion @ car_from_laser
            points = unrolled(points, motion)
        return RawScan(
            where=meant[name],
            points=points,
            world_from_sensor=poses[frame] @ car_from_laser,
            intensity=intensity,
            time=time_at(times, frame),
        )

    notes = skipped(list(meant), posed)
    return Scans(path=path, format="kitti360", scan_names=posed, read=read, notes=notes)


def unrolled(
    points: NDArray[np.float64], current_from_previous: NDArray[np.float64]
) -> NDArray[np.float64]:
    r"""Points of a turning scanner where they were when it looked straight ahead.

    The scanner looks ahead at the moment of the frame's pose, and back half a turn before and
    after. With :math:`s = \operatorname{atan2}(y, x) / 2\pi` the share of a turn, a point moves
    by that share of the way back to the previous frame: its rotation vector and its translation
    are multiplied by s (KITTI-360's accumulation does so).

    Args:
        points: In the scanner's axes, n x 3.
        current_from_previous: The previous frame's pose as seen from this one's, 4 x 4.
    """
    share = np.arctan2(points[:, 1], points[:, 0])[:, None] / (2 * np.pi)
    whole = Rotation.from_matrix(current_from_previous[:3, :3]).as_rotvec()
    turned = Rotation.from_rotvec(share * whole).apply(points) if len(points) else points
    moved = turned + share * current_from_previous[:3, 3]
    # A ray without a return is at the sensor, and stays there.
    return np.where(points.any(axis=1, keepdims=True), moved, points)


def read_sick(path: Path) -> Scans:
    """Rows of points of the lasers that look sideways; names are their own numbers.

    They are measured between frames. Their pose is that of the turning laser at their time,
    between the two frames around it, then ``calib_sick_to_velo``; so ``timestamps.txt`` of both
    are needed. A row without frames on both sides that have poses is left out, and one between
    frames more than three apart.

    Raises:
        MissingFileError: If there are no rows, or times, poses or calibration lack.
        InputError: If one of these is broken, or no row lies between two posed frames.
    """
    drive = drive_at(path)
    files = _files(drive, SICK)
    clock, frames = (
        _needed_times(drive.of(SCANS, sensor, "timestamps.txt")) for sensor in (SICK, VELODYNE)
    )
    poses = {f: p for f, p in read_poses(drive).items() if np.isfinite(time_at(frames, f))}
    what = f"at least two frames with a pose and a time, got {len(poses)}"
    expect(len(poses) >= 2, path, what, error=InputError)
    numbers = sorted(poses, key=lambda frame: float(frames[frame]))
    moments = np.array([float(frames[frame]) for frame in numbers])
    where = drive.of(SCANS, VELODYNE, "timestamps.txt")
    expect((np.diff(moments) > 0).all(), where, "times of distinct frames, got one twice")
    car_from_laser = velodyne_pose(drive)
    laser = np.stack([poses[frame] @ car_from_laser for frame in numbers])
    turn = Slerp(moments, Rotation.from_matrix(laser[:, :3, :3]))
    own = sick_pose(drive)
    near = np.diff(numbers) <= _MAX_GAP

    def placed(name: str) -> bool:
        moment = time_at(clock, int(name))
        after = int(np.searchsorted(moments, moment))
        if not np.isfinite(moment) or after == len(moments):
            return False
        return bool(near[after - 1]) if after else moment == moments[0]

    def read(name: str) -> RawScan:
        moment = float(clock[int(name)])
        pose = np.eye(4)
        pose[:3, :3] = turn(moment).as_matrix()
        pose[:3, 3] = [np.interp(moment, moments, laser[:, axis, 3]) for axis in range(3)]
        across = read_records(files[name], 2).astype(np.float64)
        # Its first number runs to the right, its second up; it sees a plane.
        points = np.stack((np.zeros(len(across)), -across[:, 0], across[:, 1]), axis=1)
        return RawScan(where=files[name], points=points, world_from_sensor=pose @ own, time=moment)

    inside = _posed(drive, path, files, [name for name in files if placed(name)])
    notes = skipped(list(files), inside)
    return Scans(path=path, format="kitti360-sick", scan_names=inside, read=read, notes=notes)


def read_accumulated(path: Path) -> Scans:
    """Labelled points of windows, a million at a time; names are those of the windows.

    What stands is read (``static``), or what moved where the path names ``dynamic``. Labels are
    ``semantic`` in the ids of KITTI-360, ``instance`` where it is a thing, and ``visible``, which
    is 1 where a photograph shows the point.

    Raises:
        MissingFileError: If there are none.
        FileFormatError: If one is damaged.
    """
    drive = drive_at(path)
    windows = static_windows(drive, part=_part(drive))
    what = f"accumulated points, {ACCUMULATED}/train/{drive.name}/{_part(drive)}/START_END.ply, "
    what += "got none"
    expect(windows, path, what, error=MissingFileError)
    names, piece = read_in_pieces(windows.values(), ply_pieces)

    def read(name: str) -> RawScan:
        file, columns = piece(name)
        labels = accumulated_labels(file, columns)
        return RawScan(where=file, points=positions(columns), labels=labels)

    classes = label_table("kitti360").classes
    return Scans(path=path, format="kitti360-points", scan_names=names, read=read, classes=classes)


def accumulated_labels(
    path: Path, columns: Mapping[str, NDArray[Any]]
) -> dict[str, NDArray[np.int64]]:
    """Ids of accumulated points by what they tell, those columns that are there.

    Raises:
        FileFormatError: If an id is no whole number.
    """
    found = {
        name: whole_ids(path, name, columns[name])
        for name in ("semantic", "instance", "visible")
        if name in columns
    }
    if "instance" in found:
        ids = found["instance"]
        found["instance"] = np.where(ids % _INSTANCES == 0, 0, ids)
    return found


def _has_sensor(path: Path, sensor: str) -> bool:
    drive = find_drive(path)
    if drive is None or drive.part not in (None, sensor) or drive.top == ACCUMULATED:
        return False
    return drive.of(SCANS, sensor, "data").is_dir()


def _part(drive: Drive) -> str:
    return "dynamic" if drive.part == "dynamic" else "static"


def _files(drive: Drive, sensor: str) -> dict[str, Path]:
    folder = drive.of(SCANS, sensor, "data")
    files = numbered_files(folder, ".bin")
    if not files:
        raise MissingFileError(f"{folder}: expected scans, 0000000000.bin and so on, got none.")
    return files


def _posed(
    drive: Drive, path: Path, files: Mapping[str, Path], posed: Sequence[str]
) -> tuple[str, ...]:
    what = f"scans with poses, got {len(files)} scans{drive.frames_in_words} of which none has a "
    what += "pose"
    expect(posed, path, what, error=InputError)
    return tuple(posed)


def _motion(poses: Mapping[int, NDArray[np.float64]], frame: int) -> NDArray[np.float64] | None:
    """The previous frame's pose as seen from this one's; of the first by the next one."""
    if frame - 1 in poses:
        return np.linalg.inv(poses[frame]) @ poses[frame - 1]
    if frame == 0 and 1 in poses:
        return np.linalg.inv(poses[1]) @ poses[0]
    return None


def _needed_times(path: Path) -> NDArray[np.float64]:
    times = read_times(path)
    if times is None:
        raise MissingFileError(
            f"{path}: expected the times of scans, without which rows of points between frames "
            "have no pose, got none."
        )
    return times
