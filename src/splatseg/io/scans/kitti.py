"""Scans of KITTI's raw recordings, whose poses come from the satellite and inertial unit.

    2011_09_26/calib_imu_to_velo.txt                                     rows R (3 x 3) and T
    2011_09_26/2011_09_26_drive_0001_sync/oxts/data/0000000000.txt       lat lon alt roll pitch yaw
    2011_09_26/2011_09_26_drive_0001_sync/velodyne_points/data/0000000000.bin

The world has the axes east, north and up, and its origin at the unit's first position.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.captures.raw_views import checked_pose
from splatseg.io.foreign import read_lines
from splatseg.io.scans._source import RawScan, Scans, only_one
from splatseg.io.scans._velodyne import numbered_files, read_points, skipped
from splatseg.io.text_numbers import keyed_matrix, read_keyed_numbers, read_times, rigid

EARTH_RADIUS = 6378137.0
"""Metres, at the equator."""

_SCANNER = Path("velodyne_points") / "data"
_UNIT = Path("oxts") / "data"
_CALIBRATION = "calib_imu_to_velo.txt"
_USED = 6
_MAX_LATITUDE = 85.0


def find_kitti_raw(path: Path) -> bool:
    """Whether a path is a recording, or the folder of a day with one."""
    return bool(_recordings(path))


def read_kitti_raw(path: Path) -> Scans:
    """Scans of a recording that have a packet of the inertial unit; names are the frames'.

    Poses are what KITTI's devkit makes of the packets, in axes that point east, north and up: the
    position on Mercator's map at the scale of the first latitude, the turn by yaw, pitch and roll.
    What the car moves while the scanner turns is not undone.

    Raises:
        MissingFileError: If there is no recording, or its calibration lacks.
        InputError: If there are several recordings, a file is broken, or no scan has a packet.
    """
    found = _recordings(path)
    if not found:
        raise MissingFileError(
            f"{path}: expected a recording of KITTI, with {_SCANNER.as_posix()} and "
            f"{_UNIT.as_posix()}, got none."
        )
    folders = {folder.name: folder for folder in found}
    folder = folders[only_one(path, list(folders), "recording")]
    files = numbered_files(folder / _SCANNER, ".bin")
    packets = numbered_files(folder / _UNIT, ".txt")
    posed = [name for name in files if name in packets]
    if not posed:
        raise InputError(
            f"{path}: expected scans with poses, got {len(files)} scans and {len(packets)} packets "
            "of the inertial unit, none of the same frame."
        )
    unit_from_scanner = np.linalg.inv(_scanner_from_unit(folder))
    first = _packet(packets[next(iter(packets))])
    times = read_times(folder / "velodyne_points" / "timestamps.txt")

    def read(name: str) -> RawScan:
        points, intensity = read_points(files[name])
        moment = float(times[int(name)]) if times is not None and int(name) < len(times) else None
        return RawScan(
            where=files[name],
            points=points,
            world_from_sensor=unit_pose(_packet(packets[name]), first) @ unit_from_scanner,
            intensity=intensity,
            time=moment if moment is not None and np.isfinite(moment) else None,
        )

    return Scans(
        path=path,
        format="kitti-raw",
        scan_names=tuple(posed),
        read=read,
        notes=skipped(list(files), posed),
    )


def unit_pose(packet: NDArray[np.float64], first: NDArray[np.float64]) -> NDArray[np.float64]:
    r"""world_from_unit of a packet, 4 x 4.

    With latitude :math:`\varphi` and longitude :math:`\lambda` in degrees, radius r and the first
    packet's scale :math:`s = \cos(\pi \varphi_0 / 180)`, east is :math:`s r \pi \lambda / 180` and
    north :math:`s r \ln \tan(\pi (90 + \varphi) / 360)`, both less the first packet's; the turn is
    :math:`R_z(yaw) R_y(pitch) R_x(roll)`.

    Args:
        packet: Latitude and longitude in degrees, altitude in metres; roll, pitch and yaw in
            radians (yaw 0 looks east).
        first: That of the origin.
    """
    scale = np.cos(np.radians(first[0]))
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("ZYX", packet[[5, 4, 3]]).as_matrix()
    pose[:3, 3] = _place(packet, float(scale)) - _place(first, float(scale))
    return pose


def _place(packet: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
    north = np.log(np.tan(np.pi * (90 + packet[0]) / 360))
    return np.array(
        (scale * EARTH_RADIUS * np.radians(packet[1]), scale * EARTH_RADIUS * north, packet[2])
    )


def _packet(path: Path) -> NDArray[np.float64]:
    """Latitude, longitude, altitude, roll, pitch and yaw of a file of 30 numbers."""
    words = " ".join(read_lines(path, "a packet of the inertial unit")).split()[:_USED]
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        values = np.zeros(0)
    if len(values) < _USED or not np.isfinite(values).all() or abs(values[0]) > _MAX_LATITUDE:
        raise FileFormatError(
            f"{path}: expected a packet of the inertial unit, finite numbers that begin with "
            f"latitude, longitude, altitude, roll, pitch and yaw, got {' '.join(words)!r:.80}."
        )
    return values


def _scanner_from_unit(folder: Path) -> NDArray[np.float64]:
    places = (folder.absolute().parent / _CALIBRATION, folder / _CALIBRATION)
    path = next((place for place in places if place.is_file()), places[0])
    if not path.is_file():
        raise MissingFileError(
            f"{path}: expected this file of KITTI's calibration, got none; each day has its own, "
            "in an archive of its own."
        )
    rows = read_keyed_numbers(path)
    turn = keyed_matrix(rows, "R", (3, 3), path=path)
    moved = keyed_matrix(rows, "T", (3, 1), path=path)
    return checked_pose(rigid(np.hstack((turn, moved))), where=str(path))


def _recordings(path: Path) -> tuple[Path, ...]:
    """The recording that a path is or lies in, else those of the folder."""
    for folder in (path, *path.absolute().parents[:2]):
        if _is_recording(folder):
            return (folder,)
    if not path.is_dir():
        return ()
    return tuple(sorted(child for child in path.iterdir() if _is_recording(child)))


def _is_recording(folder: Path) -> bool:
    return (folder / _SCANNER).is_dir() and (folder / _UNIT).is_dir()
