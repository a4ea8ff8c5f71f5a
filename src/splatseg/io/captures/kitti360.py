"""Reads KITTI-360: rectified stereo photographs of a drive, or one of its fisheye cameras.

Liao, Xie and Geiger, KITTI-360, TPAMI 2022. `kitti360_drive` says how a drive, a window of frames
and a camera are named.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatseg.core import Capture, PointCloud
from splatseg.errors import FileFormatError, InputError, MissingFileError, quoted
from splatseg.io.captures._points import point_cloud, vertex_colours
from splatseg.io.captures.build import build_capture
from splatseg.io.captures.kitti360_drive import (
    ACCUMULATED,
    PHOTOGRAPHS,
    Drive,
    calibration_rows,
    camera_pose,
    drive_at,
    find_drive,
    read_poses,
    window_name,
    window_of,
)
from splatseg.io.captures.raw_views import Intrinsics, RawView
from splatseg.io.captures.replica import inverse_pose
from splatseg.io.foreign import is_folder, read_lines
from splatseg.io.images import find_images
from splatseg.io.keyed_numbers import keyed_matrix
from splatseg.io.ply import read_ply_vertices, vertex_positions

PERSPECTIVE = {"image_00": "data_rect", "image_01": "data_rect"}
FISHEYE = {"image_02": "data_rgb", "image_03": "data_rgb"}
"""Cameras by the folder of their photographs below their own."""

MAX_POINTS = 1_000_000
"""Start points that are taken of the accumulated ones, evenly."""

_PIXEL_CENTRE = 0.5
"""KITTI counts pixels from the centre of the first; here it is at a half."""

_LENS = ("xi", "k1", "k2", "p1", "p2")
_PROJECTION = ("gamma1", "gamma2", "u0", "v0")
_SIZE = ("image_width", "image_height")


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
    if not posed:
        raise InputError(
            f"{path}: expected photographs with poses, got {len(frames)} frames"
            f"{_of_window(drive)} of which none has a pose."
        )
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
    known = PERSPECTIVE | FISHEYE
    if drive.part in known:
        return (drive.part,)
    found = tuple(c for c in PERSPECTIVE if is_folder(drive.of(PHOTOGRAPHS, c, PERSPECTIVE[c])))
    if not found:
        raise MissingFileError(
            f"{drive.folder}: expected image_00/data_rect or image_01/data_rect, got neither; name "
            "a fisheye camera, image_02 or image_03, to read that."
        )
    return found


def _numbered(drive: Drive, camera: str) -> list[tuple[int, Path]]:
    folder = drive.of(PHOTOGRAPHS, camera, (PERSPECTIVE | FISHEYE)[camera])
    files = [(file.stem, file) for file in find_images(folder)]
    return [(int(stem), file) for stem, file in files if re.fullmatch(r"[0-9]{1,10}", stem)]


def _of_window(drive: Drive) -> str:
    return "" if drive.window is None else f" from {drive.window[0]} to {drive.window[1]}"


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
    path = drive.root / "calibration" / "perspective.txt"
    rows, number = calibration_rows(path), camera[-2:]
    projection = keyed_matrix(rows, f"P_rect_{number}", (3, 4), path=path)
    size = keyed_matrix(rows, f"S_rect_{number}", (1, 2), path=path)[0]
    return Intrinsics(
        fx=float(projection[0, 0]),
        fy=float(projection[1, 1]),
        cx=float(projection[0, 2]) + _PIXEL_CENTRE,
        cy=float(projection[1, 2]) + _PIXEL_CENTRE,
        width=round(float(size[0])),
        height=round(float(size[1])),
    )


def _fisheye(path: Path) -> Intrinsics:
    """The lens of a YAML file as OpenCV writes it, of which the rows ``key: number`` count."""
    values = _yaml_numbers(path)
    lacking = [key for key in (*_SIZE, *_LENS, *_PROJECTION) if key not in values]
    if lacking:
        raise FileFormatError(f"{path}: expected numbers {', '.join(lacking)}, got none.")
    return Intrinsics(
        model="mei",
        fx=values["gamma1"],
        fy=values["gamma2"],
        cx=values["u0"] + _PIXEL_CENTRE,
        cy=values["v0"] + _PIXEL_CENTRE,
        distortion=tuple(values[key] for key in _LENS),
        width=round(values["image_width"]),
        height=round(values["image_height"]),
    )


def _yaml_numbers(path: Path) -> Mapping[str, float]:
    if not path.is_file():
        raise MissingFileError(f"{path}: expected the lens of a fisheye camera, got none.")
    found: dict[str, float] = {}
    for line in read_lines(path, "the lens of a fisheye camera"):
        key, _, word = line.partition(":")
        try:
            value = float(word)
        except ValueError:
            continue
        if not np.isfinite(value):
            raise FileFormatError(f"{path}: expected finite numbers, got {quoted(line)}.")
        found[key.strip()] = value
    return found


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
