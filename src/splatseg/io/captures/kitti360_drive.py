"""A drive of KITTI-360: which folders it has, which frames are meant, calibration and poses.

    ROOT/calibration/perspective.txt, image_02.yaml, calib_cam_to_pose.txt, calib_cam_to_velo.txt
    ROOT/data_poses/DRIVE/poses.txt, cam0_to_world.txt
    ROOT/data_2d_raw/DRIVE/image_00/data_rect/0000000005.png
    ROOT/data_3d_raw/DRIVE/velodyne_points/data/0000000005.bin
    ROOT/data_3d_semantics/train/DRIVE/static/0000000002_0000000385.ply

A drive is named by its folder in any of these, or by ROOT where there is one drive. Frames are
named by a window behind it, ``.../DRIVE/0000000002_0000000385``, or by the file of accumulated
points of that name; a camera or a sensor by its folder, ``.../DRIVE/image_02``.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.captures.raw_views import checked_pose
from splatseg.io.foreign import is_folder, read_lines
from splatseg.io.keyed_numbers import keyed_matrix, read_keyed_numbers, rigid, shaped
from splatseg.io.text_numbers import read_numbers

PHOTOGRAPHS, SCANS, ACCUMULATED = "data_2d_raw", "data_3d_raw", "data_3d_semantics"
SEMANTICS, POSES = "data_2d_semantics", "data_poses"
VELODYNE, SICK = "velodyne_points", "sick_points"

_TOPS = (PHOTOGRAPHS, SCANS, ACCUMULATED, SEMANTICS, POSES)
_SPLITS = ("train", "test", "test1", "test2")
"""Folders between data_3d_semantics or data_2d_semantics and a drive."""

_WINDOW = re.compile(r"(\d{1,10})_(\d{1,10})(?:\.ply)?")
_DEEPEST = 6
"""Folders between ROOT and anything that names a drive."""

_PARTS = 3
"""A drive, a camera or sensor, and the folder of its files."""

_MAX_FRAME = 10**10 - 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Drive:
    """What a path of KITTI-360 names."""

    root: Path
    """The folder that has ``calibration`` and ``data_poses``."""

    name: str
    """Such as ``2013_05_28_drive_0009_sync``."""

    window: tuple[int, int] | None = None
    """First and last frame that are meant; None is all."""

    part: str | None = None
    """A folder of a camera or sensor that is named: ``image_02``, ``sick_points``, ``dynamic``."""

    top: str | None = None
    """Through which of the data set's folders it is named, such as ``data_3d_raw``."""

    @property
    def folder(self) -> Path:
        """Of its photographs, which stands for the drive."""
        return self.root / PHOTOGRAPHS / self.name

    def of(self, top: str, *parts: str) -> Path:
        """A folder or file of the drive in one of the data set's folders."""
        return self.root.joinpath(top, self.name, *parts)

    def split_folder(self, top: str, *parts: str) -> Path | None:
        """The same in ``train``, or a test split that has it; None where none does."""
        paths = (self.root.joinpath(top, split, self.name, *parts) for split in _SPLITS)
        return next((path for path in paths if is_folder(path)), None)

    def has(self, frame: int) -> bool:
        """Whether a frame is meant."""
        return self.window is None or self.window[0] <= frame <= self.window[1]

    @property
    def called(self) -> str:
        """As KITTI-360's evaluation calls a drive or a window of one: ``0009_0000000002_...``."""
        found = re.fullmatch(r"\d{4}_\d\d_\d\d_drive_(\d{4})_sync", self.name)
        name = found[1] if found else self.name
        return name if self.window is None else f"{name}_{window_name(self.window)}"


def window_name(window: tuple[int, int]) -> str:
    """As files of accumulated points are called."""
    return f"{window[0]:010d}_{window[1]:010d}"


def window_of(name: str) -> tuple[int, int] | None:
    """The frames that a name tells, or None."""
    found = _WINDOW.fullmatch(name)
    return None if found is None else (int(found[1]), int(found[2]))


def find_drive(path: Path) -> Drive | None:
    """What a path names, or None where it is none of KITTI-360's.

    Raises:
        InputError: If it is the data set's folder, with several drives.
    """
    whole = path.absolute()
    for root in (whole, *whole.parents)[: _DEEPEST + 1]:
        if any(is_folder(root / top) for top in _TOPS):
            return _named(root, whole.relative_to(root).parts, path)
    return None


def drive_at(path: Path) -> Drive:
    """What a path names.

    Raises:
        MissingFileError: If it is none of KITTI-360's.
        InputError: If it is the data set's folder, with several drives.
    """
    found = find_drive(path)
    if found is None:
        raise MissingFileError(
            f"{path}: expected a drive of KITTI-360, such as data_2d_raw/DRIVE beside calibration "
            "and data_poses, got none."
        )
    return found


def drives(root: Path) -> tuple[str, ...]:
    """Names of the drives of which a data set has anything."""
    folders = [root / PHOTOGRAPHS, root / SCANS, root / POSES]
    folders += [root / top / split for top in (ACCUMULATED, SEMANTICS) for split in _SPLITS]
    return tuple(
        sorted(
            {
                path.name
                for folder in folders
                if is_folder(folder)
                for path in folder.iterdir()
                if is_folder(path)
            }
        )
    )


def read_poses(drive: Drive) -> dict[int, NDArray[np.float64]]:
    """world_from_car of the frames that are meant, by number; cars that stand have none.

    ``poses.txt`` has the frame and 3 x 4 numbers a row; where it is missing, poses come from
    ``cam0_to_world.txt``, the frame and the 4 x 4 pose of the rectified left camera.

    Raises:
        MissingFileError: If there is neither.
        InputError: If a row is no frame and pose, or a frame comes twice.
    """
    path, cameras = drive.of(POSES, "poses.txt"), drive.of(POSES, "cam0_to_world.txt")
    if path.is_file():
        rows, shape = read_numbers(path, columns=13), (3, 4)
    elif cameras.is_file():
        path, rows, shape = cameras, read_numbers(cameras, columns=17), (4, 4)
    else:
        raise MissingFileError(
            f"{path}: expected the poses of the drive, got none; photographs and scans without "
            "poses are of no use."
        )
    car_from_camera = None if shape[0] == 3 else np.linalg.inv(camera_pose(drive, "image_00"))
    found: dict[int, NDArray[np.float64]] = {}
    for i, row in enumerate(rows):
        frame = row[0]
        if not (0 <= frame <= _MAX_FRAME and frame == int(frame)):
            raise FileFormatError(f"{path}: expected a frame first in row {i + 1}, got {frame:g}.")
        if int(frame) in found:
            raise FileFormatError(f"{path}: expected each frame once, got {int(frame)} twice.")
        if not drive.has(int(frame)):
            continue
        pose = row[1:].reshape(shape)
        pose = checked_pose(rigid(pose) if shape[0] == 3 else pose, where=f"{path}: row {i + 1}")
        found[int(frame)] = pose if car_from_camera is None else pose @ car_from_camera
    return found


def camera_pose(drive: Drive, camera: str) -> NDArray[np.float64]:
    """car_from_camera, 4 x 4; of a rectified camera after its rectification.

    Raises:
        MissingFileError: If a file of the calibration is missing.
        InputError: If it lacks the camera, or has no rotation.
    """
    path = drive.root / "calibration" / "calib_cam_to_pose.txt"
    matrix = rigid(keyed_matrix(calibration_rows(path), camera, (3, 4), path=path))
    pose = checked_pose(matrix, where=f"{path}: {camera}")
    if camera not in ("image_00", "image_01"):
        return pose
    perspective = drive.root / "calibration" / "perspective.txt"
    name = f"R_rect_{camera[-2:]}"
    rectified = np.eye(4)
    rectified[:3, :3] = keyed_matrix(calibration_rows(perspective), name, (3, 3), path=perspective)
    return pose @ np.linalg.inv(checked_pose(rectified, where=f"{perspective}: {name}"))


def velodyne_pose(drive: Drive) -> NDArray[np.float64]:
    """car_from_velodyne, 4 x 4: by the left camera, before its rectification.

    Raises:
        MissingFileError: If a file of the calibration is missing.
        InputError: If it has no rotation.
    """
    path = drive.root / "calibration" / "calib_cam_to_pose.txt"
    camera = rigid(keyed_matrix(calibration_rows(path), "image_00", (3, 4), path=path))
    velodyne_from_camera = read_rigid(drive.root / "calibration" / "calib_cam_to_velo.txt")
    return checked_pose(camera, where=f"{path}: image_00") @ np.linalg.inv(velodyne_from_camera)


def sick_pose(drive: Drive) -> NDArray[np.float64]:
    """velodyne_from_sick, 4 x 4.

    Raises:
        MissingFileError: If the calibration is missing.
        InputError: If it has no rotation.
    """
    return read_rigid(drive.root / "calibration" / "calib_sick_to_velo.txt")


def read_rigid(path: Path) -> NDArray[np.float64]:
    """A file of one 3 x 4 transform, in one row or three.

    Raises:
        MissingFileError: If there is no such file.
        InputError: If it has more or fewer numbers, or no rotation.
    """
    words = " ".join(read_lines(_calibration(path), "a 3 x 4 transform")).split()
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise FileFormatError(f"{path}: expected 3 x 4 numbers, got other words.") from error
    return checked_pose(rigid(shaped(values, (3, 4), where=str(path))), where=str(path))


def calibration_rows(path: Path) -> Mapping[str, NDArray[np.float64]]:
    """Rows of a file of the calibration, by name.

    Raises:
        MissingFileError: If it is missing.
        FileFormatError: If it is no text.
    """
    return read_keyed_numbers(_calibration(path))


def _calibration(path: Path) -> Path:
    if not path.is_file():
        raise MissingFileError(
            f"{path}: expected this file of KITTI-360's calibration, got none; it comes in an "
            "archive of its own."
        )
    return path


def _named(root: Path, parts: tuple[str, ...], path: Path) -> Drive | None:
    """What the folders below the data set's own one name; None where they are none of a drive."""
    left = list(parts)
    window = window_of(left[-1]) if left else None
    if window is not None:
        left.pop()
    top = left.pop(0) if left and left[0] in _TOPS else None
    if top in (ACCUMULATED, SEMANTICS) and left:
        left.pop(0)
    known = drives(root)
    if not left:
        if not known:
            return None
        name, *more = known
        if more:
            shown = ", ".join(known[:3]) + (", ..." if len(known) > 3 else "")
            raise InputError(
                f"{path}: expected one drive of KITTI-360, got {len(known)} ({shown}); name one, "
                f"such as {root / PHOTOGRAPHS / name}."
            )
        return Drive(root=root, name=name, window=window, top=top)
    if left[0] not in known or len(left) > _PARTS:
        return None
    part = left[1] if len(left) > 1 else None
    return Drive(root=root, name=left[0], window=window, part=part, top=top)
