"""KITTI-360: rectified stereo photographs of a drive, or one of its fisheye cameras; its poses.

    ROOT/calibration/perspective.txt, image_02.yaml, calib_cam_to_pose.txt, calib_cam_to_velo.txt
    ROOT/data_poses/DRIVE/poses.txt, cam0_to_world.txt
    ROOT/data_2d_raw/DRIVE/image_00/data_rect/0000000005.png
    ROOT/data_3d_raw/DRIVE/velodyne_points/data/0000000005.bin
    ROOT/data_3d_semantics/train/DRIVE/static/0000000002_0000000385.ply

A drive is named by its folder in any of these, or by ROOT where there is one drive. Frames are
named by a window behind it, ``.../DRIVE/0000000002_0000000385``, or by the file of accumulated
points of that name; a camera or a sensor by its folder, ``.../DRIVE/image_02``. Liao, Xie and
Geiger, KITTI-360, TPAMI 2022.
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatseg.core import Capture, PointCloud
from splatseg.errors import InputError, MissingFileError
from splatseg.io.captures.build import build_capture
from splatseg.io.captures.points import point_cloud, vertex_colours
from splatseg.io.captures.raw_views import Intrinsics, RawView, checked_pose, inverse_pose
from splatseg.io.foreign import expect, is_folder, malformed
from splatseg.io.images import find_images
from splatseg.io.ply import read_ply_vertices, vertex_positions
from splatseg.io.text_numbers import (
    keyed_matrix,
    read_keyed_numbers,
    read_matrix,
    read_numbers,
    rigid,
)

PHOTOGRAPHS, SCANS, ACCUMULATED = "data_2d_raw", "data_3d_raw", "data_3d_semantics"
SEMANTICS, POSES = "data_2d_semantics", "data_poses"
VELODYNE, SICK = "velodyne_points", "sick_points"

PERSPECTIVE = {"image_00": "data_rect", "image_01": "data_rect"}
FISHEYE = {"image_02": "data_rgb", "image_03": "data_rgb"}
"""Cameras by the folder of their photographs below their own."""

MAX_POINTS = 1_000_000
"""Start points that are taken of the accumulated ones, evenly."""

_TOPS = (PHOTOGRAPHS, SCANS, ACCUMULATED, SEMANTICS, POSES)
_SPLITS = ("train", "test", "test1", "test2")
"""Folders between data_3d_semantics or data_2d_semantics and a drive."""

_WINDOW = re.compile(r"(\d{1,10})_(\d{1,10})(?:\.ply)?")
_DEEPEST = 6
"""Folders between ROOT and anything that names a drive."""

_PARTS = 3
"""A drive, a camera or sensor, and the folder of its files."""

_MAX_FRAME = 10**10 - 1
_PIXEL_CENTRE = 0.5
"""KITTI counts pixels from the centre of the first; here it is at a half."""

_FISHEYE_KEYS = (
    "gamma1", "gamma2", "u0", "v0", "image_width", "image_height", "xi", "k1", "k2", "p1", "p2",
)  # fmt: skip


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

    def calibration(self, name: str) -> Path:
        """A file of the calibration.

        Raises:
            MissingFileError: If it is missing.
        """
        path = self.root / "calibration" / name
        what = "this file of KITTI-360's calibration, got none; it comes in an archive of its own"
        expect(path.is_file(), path, what, error=MissingFileError)
        return path

    def has(self, frame: int) -> bool:
        """Whether a frame is meant."""
        return self.window is None or self.window[0] <= frame <= self.window[1]

    @property
    def called(self) -> str:
        """As KITTI-360's evaluation calls a drive or a window of one: ``0009_0000000002_...``."""
        found = re.fullmatch(r"\d{4}_\d\d_\d\d_drive_(\d{4})_sync", self.name)
        name = found[1] if found else self.name
        return name if self.window is None else f"{name}_{window_name(self.window)}"

    @property
    def frames_in_words(self) -> str:
        """`` from 2 to 385`` of a window, nothing of all."""
        return "" if self.window is None else f" from {self.window[0]} to {self.window[1]}"


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
    folders = [root / top for top in (PHOTOGRAPHS, SCANS, POSES)]
    folders += [root / top / split for top in (ACCUMULATED, SEMANTICS) for split in _SPLITS]
    there = (path for folder in folders if is_folder(folder) for path in folder.iterdir())
    return tuple(sorted({path.name for path in there if is_folder(path)}))


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
    if not left and len(known) > 1:
        shown = ", ".join(known[:3]) + (", ..." if len(known) > 3 else "")
        raise InputError(
            f"{path}: expected one drive of KITTI-360, got {len(known)} ({shown}); name one, such "
            f"as {root / PHOTOGRAPHS / known[0]}."
        )
    names = left or list(known)
    if not names or names[0] not in known or len(left) > _PARTS:
        return None
    part = left[1] if len(left) > 1 else None
    return Drive(root=root, name=names[0], window=window, part=part, top=top)


def read_poses(drive: Drive) -> dict[int, NDArray[np.float64]]:
    """world_from_car of the frames that are meant, by number; cars that stand have none.

    ``poses.txt`` has the frame and 3 x 4 numbers a row; where it is missing, poses come from
    ``cam0_to_world.txt``, the frame and the 4 x 4 pose of the rectified left camera.

    Raises:
        MissingFileError: If there is neither.
        InputError: If a row is no frame and pose, or a frame comes twice.
    """
    path, of_camera = drive.of(POSES, "poses.txt"), drive.of(POSES, "cam0_to_world.txt")
    camera_from_car = None
    if not path.is_file():
        what = "the poses of the drive, got none; photographs and scans without poses are of no use"
        expect(of_camera.is_file(), path, what, error=MissingFileError)
        path, camera_from_car = of_camera, np.linalg.inv(camera_pose(drive, "image_00"))
    height = 3 if camera_from_car is None else 4
    found: dict[int, NDArray[np.float64]] = {}
    for i, (frame, *values) in enumerate(read_numbers(path, columns=1 + 4 * height), start=1):
        what = f"a frame first in row {i}, got {frame:g}"
        expect(0 <= frame <= _MAX_FRAME and frame == int(frame), path, what)
        expect(int(frame) not in found, path, f"each frame once, got {int(frame)} twice")
        if not drive.has(int(frame)):
            continue
        pose = np.array(values).reshape(height, 4)
        pose = checked_pose(rigid(pose) if height == 3 else pose, where=f"{path}: row {i}")
        found[int(frame)] = pose if camera_from_car is None else pose @ camera_from_car
    return found


def camera_pose(drive: Drive, camera: str) -> NDArray[np.float64]:
    """car_from_camera, 4 x 4; of a rectified camera after its rectification.

    Raises:
        MissingFileError: If a file of the calibration is missing.
        InputError: If it lacks the camera, or has no rotation.
    """
    pose = _car_from_camera(drive, camera)
    if camera not in PERSPECTIVE:
        return pose
    path, name = drive.calibration("perspective.txt"), f"R_rect_{camera[-2:]}"
    rectified = np.eye(4)
    rectified[:3, :3] = keyed_matrix(read_keyed_numbers(path), name, (3, 3), path=path)
    return pose @ np.linalg.inv(checked_pose(rectified, where=f"{path}: {name}"))


def velodyne_pose(drive: Drive) -> NDArray[np.float64]:
    """car_from_velodyne, 4 x 4: by the left camera, before its rectification.

    Raises:
        MissingFileError: If a file of the calibration is missing.
        InputError: If it has no rotation.
    """
    velodyne_from_camera = _transform(drive.calibration("calib_cam_to_velo.txt"))
    return _car_from_camera(drive, "image_00") @ np.linalg.inv(velodyne_from_camera)


def sick_pose(drive: Drive) -> NDArray[np.float64]:
    """velodyne_from_sick, 4 x 4.

    Raises:
        MissingFileError: If the calibration is missing.
        InputError: If it has no rotation.
    """
    return _transform(drive.calibration("calib_sick_to_velo.txt"))


def _car_from_camera(drive: Drive, camera: str) -> NDArray[np.float64]:
    path = drive.calibration("calib_cam_to_pose.txt")
    matrix = keyed_matrix(read_keyed_numbers(path), camera, (3, 4), path=path)
    return checked_pose(rigid(matrix), where=f"{path}: {camera}")


def _transform(path: Path) -> NDArray[np.float64]:
    return checked_pose(rigid(read_matrix(path, (3, 4), "a 3 x 4 transform")), where=str(path))


def find_kitti360(path: Path) -> bool:
    """Whether a path names a drive of KITTI-360, a window or a camera of one, with photographs.

    Raises:
        InputError: If it is the data set's folder, with several drives.
    """
    drive = find_drive(path)
    return drive is not None and is_folder(drive.folder)


def read_kitti360(path: Path, *, strict: bool = False) -> Capture:
    """Read the photographs of a drive that have poses; see `read_capture`.

    The rectified cameras ``image_00`` and ``image_01`` are read, those of them that are there, or
    the camera that the path names: ``image_02`` and ``image_03`` have the unified fisheye lens of
    ``calibration/image_0N.yaml``. Every second frame is a test view, with both its photographs.
    The world is that of the poses, with z up, in metres. Start points are those of
    ``data_3d_semantics/*/DRIVE/static`` whose windows share frames with what is read, a million
    at most.

    Args:
        path: A drive, a window of one (``.../DRIVE/0000000002_0000000385``, or the file of
            accumulated points of that name) or a camera (``.../DRIVE/image_02``).
        strict: Nothing that is listed can lack: photographs themselves are the list.

    Raises:
        MissingFileError: If there is no drive, or its photographs, poses or calibration lack.
        InputError: If a file is broken, or no photograph has a pose.
    """
    drive = drive_at(path)
    cameras = _cameras(drive)
    poses = read_poses(drive)
    images = {
        camera: {frame: file for frame, file in _numbered(drive, camera) if drive.has(frame)}
        for camera in cameras
    }
    frames = sorted({frame for files in images.values() for frame in files})
    posed = [frame for frame in frames if frame in poses]
    what = f"photographs with poses, got {len(frames)} frames{drive.frames_in_words} of which none "
    what += "has a pose"
    expect(posed, path, what, error=InputError)
    split = {frame: "test" if i % 2 else "train" for i, frame in enumerate(posed)}
    raw: list[RawView] = []
    for camera in cameras:
        intrinsics = _intrinsics(drive, camera)
        car_from_camera = camera_pose(drive, camera)
        raw += [
            RawView(
                image=file,
                relative=f"{camera}/{file.name}",
                intrinsics=intrinsics,
                cam_from_world=inverse_pose(poses[frame] @ car_from_camera, where=str(file)),
                split=split[frame],
            )
            for frame, file in images[camera].items()
            if frame in poses
        ]
    capture = build_capture(
        drive.folder,
        raw,
        format="kitti360",
        points=_start_points(drive, posed),
        notes=_notes(drive, cameras, left_out=len(frames) - len(posed)),
        strict=strict,
    )
    # The path of a window names it again, for what is read beside the photographs.
    named = drive.folder if drive.window is None else drive.folder / window_name(drive.window)
    return replace(capture, path=named, metres_per_unit=1.0, up=(0.0, 0.0, 1.0))


def static_windows(drive: Drive, *, part: str = "static") -> dict[tuple[int, int], Path]:
    """Files of accumulated points of a drive by their frames, those that are meant.

    Args:
        drive: All of it, or a window: then the file of that name, or those that share frames.
        part: ``static``, or ``dynamic`` with what moved.
    """
    folder = drive.split_folder(ACCUMULATED, part)
    files = sorted(folder.glob("*.ply")) if folder is not None else []
    found = {window: file for file in files if (window := window_of(file.name)) is not None}
    if drive.window is None or drive.window in found:
        return found if drive.window is None else {drive.window: found[drive.window]}
    first, last = drive.window
    return {w: file for w, file in found.items() if w[0] <= last and w[1] >= first}


def _cameras(drive: Drive) -> tuple[str, ...]:
    if drive.part in PERSPECTIVE | FISHEYE:
        return (str(drive.part),)
    found = tuple(c for c in PERSPECTIVE if is_folder(drive.of(PHOTOGRAPHS, c, PERSPECTIVE[c])))
    what = "image_00/data_rect or image_01/data_rect, got neither; name a fisheye camera, image_02 "
    what += "or image_03, to read that"
    expect(found, drive.folder, what, error=MissingFileError)
    return found


def _numbered(drive: Drive, camera: str) -> list[tuple[int, Path]]:
    files = find_images(drive.of(PHOTOGRAPHS, camera, (PERSPECTIVE | FISHEYE)[camera]))
    return [(int(file.stem), file) for file in files if re.fullmatch(r"[0-9]{1,10}", file.stem)]


def _notes(drive: Drive, cameras: tuple[str, ...], *, left_out: int) -> list[str]:
    notes = ["every second frame is a test view, as the paper of the mesh field has it"]
    if drive.window is not None:
        notes.append(f"frames {drive.window[0]} to {drive.window[1]} of the drive")
    if left_out:
        which = "frame that has" if left_out == 1 else "frames that have"
        notes.append(f"left out: {left_out} {which} no pose")
    there = [c for c in FISHEYE if is_folder(drive.of(PHOTOGRAPHS, c, FISHEYE[c]))]
    if set(cameras) & set(FISHEYE):
        notes.append(
            "pixels of a fisheye camera that see 90 degrees from its axis or more have no ray; "
            "points are projected into it, but it is too wide to be fitted or rendered"
        )
    elif there:
        notes.append(
            f"fisheye cameras ({', '.join(there)}) are read where one is named: "
            f"{Path(PHOTOGRAPHS, drive.name, there[0])}"
        )
    return notes


def _intrinsics(drive: Drive, camera: str) -> Intrinsics:
    if camera in FISHEYE:
        return _fisheye(drive.root / "calibration" / f"{camera}.yaml")
    path, number = drive.calibration("perspective.txt"), camera[-2:]
    rows = read_keyed_numbers(path)
    projection = keyed_matrix(rows, f"P_rect_{number}", (3, 4), path=path)
    width, height = keyed_matrix(rows, f"S_rect_{number}", (1, 2), path=path)[0]
    return Intrinsics(
        focal=(float(projection[0, 0]), float(projection[1, 1])),
        centre=(float(projection[0, 2]) + _PIXEL_CENTRE, float(projection[1, 2]) + _PIXEL_CENTRE),
        size=(round(float(width)), round(float(height))),
    )


def _fisheye(path: Path) -> Intrinsics:
    """The lens of a YAML file as OpenCV writes it, of which the rows ``key: number`` count."""
    if not path.is_file():
        raise MissingFileError(f"{path}: expected the lens of a fisheye camera, got none.")
    rows = read_keyed_numbers(path)
    lacking = [key for key in _FISHEYE_KEYS if key not in rows or rows[key].size != 1]
    if lacking:
        raise malformed(path, f"numbers {', '.join(lacking)}, got none")
    values = [float(rows[key][0]) for key in _FISHEYE_KEYS]
    expect(np.isfinite(values).all(), path, "finite numbers, got NaN or infinity")
    fx, fy, cx, cy, width, height, *distortion = values
    return Intrinsics(
        model="mei",
        focal=(fx, fy),
        centre=(cx + _PIXEL_CENTRE, cy + _PIXEL_CENTRE),
        distortion=tuple(distortion),
        size=(round(width), round(height)),
    )


def _start_points(drive: Drive, frames: list[int]) -> PointCloud | None:
    """Accumulated points of windows that share frames with the photographs; one file at a time."""
    meant = drive if drive.window is not None else replace(drive, window=(frames[0], frames[-1]))
    files = static_windows(meant)
    positions: list[NDArray[np.float64]] = []
    colours: list[NDArray[np.uint8]] = []
    for file in files.values():
        columns = read_ply_vertices(file)
        step = max(1, -(-len(columns["x"]) * len(files) // MAX_POINTS))
        chosen = {name: values[::step] for name, values in columns.items()}
        positions.append(vertex_positions(file, chosen))
        rgb = vertex_colours(chosen)
        if rgb is not None:
            colours.append(rgb)
    if not positions:
        return None
    whole = len(colours) == len(positions)
    return point_cloud(np.concatenate(positions), np.concatenate(colours) if whole else None)
