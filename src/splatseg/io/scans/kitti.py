"""Scans of KITTI: raw recordings, sequences of the odometry benchmark, SemanticKITTI's labels.

    2011_09_26/calib_imu_to_velo.txt                                     rows R (3 x 3) and T
    2011_09_26/2011_09_26_drive_0001_sync/oxts/data/0000000000.txt       lat lon alt roll pitch yaw
    2011_09_26/2011_09_26_drive_0001_sync/velodyne_points/data/0000000000.bin

    sequences/00/velodyne/000000.bin    float32 x y z intensity, the scanner's axes
    sequences/00/labels/000000.label    uint32 a point: 16 bits of class, above them the instance
    sequences/00/calib.txt              row Tr: the left camera from the scanner
    sequences/00/poses.txt, or poses/00.txt beside ``sequences``: 3 x 4, of the left camera
    sequences/00/times.txt              seconds, may lack

The world of a recording has the axes east, north and up, and its origin at the first position of
the satellite and inertial unit; that of a sequence is the scanner's axes at the first pose of the
file, x ahead and z up, as semantic-kitti-api puts scans together.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from splatseg.errors import InputError, MissingFileError
from splatseg.io.captures.raw_views import checked_pose
from splatseg.io.foreign import expect, malformed, read_lines
from splatseg.io.label_tables import label_table
from splatseg.io.scans._source import (
    RawScan,
    Scans,
    numbered_files,
    only_one,
    read_ids,
    read_records,
    skipped,
)
from splatseg.io.text_numbers import (
    keyed_matrix,
    numbers_of,
    read_keyed_numbers,
    read_numbers,
    read_times,
    rigid,
    time_at,
)

EARTH_RADIUS = 6378137.0
"""Metres, at the equator."""

_SCANS = Path("velodyne_points") / "data"
_UNIT = Path("oxts") / "data"
_CALIBRATION = "calib_imu_to_velo.txt"
_USED = 6
_MAX_LATITUDE = 85.0

_VOID = frozenset({0, 1})
"""unlabeled and outlier."""

_SEQUENCE_SCANS, _LABELS = "velodyne", "labels"
_CLASS_BITS = 16


def read_points(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Positions in the sensor's axes (n, 3), and intensities: x, y, z and i in float32.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If its last point is cut short.
    """
    rows = read_records(path, 4)
    return rows[:, :3].astype(np.float64), rows[:, 3]


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
    what = f"a recording of KITTI, with {_SCANS.as_posix()} and {_UNIT.as_posix()}, got none"
    expect(found, path, what, error=MissingFileError)
    folders = {folder.name: folder for folder in found}
    folder = folders[only_one(path, list(folders), "recording")]
    files = numbered_files(folder / _SCANS, ".bin")
    packets = numbered_files(folder / _UNIT, ".txt")
    posed = [name for name in files if name in packets]
    what = f"scans with poses, got {len(files)} scans and {len(packets)} packets of the inertial "
    what += "unit, none of the same frame"
    expect(posed, path, what, error=InputError)
    unit_from_scanner = np.linalg.inv(_scanner_from_unit(folder))
    first = _packet(packets[next(iter(packets))])
    times = read_times(folder / "velodyne_points" / "timestamps.txt")

    def read(name: str) -> RawScan:
        points, intensity = read_points(files[name])
        return RawScan(
            where=files[name],
            points=points,
            world_from_sensor=unit_pose(_packet(packets[name]), first) @ unit_from_scanner,
            intensity=intensity,
            time=time_at(times, int(name)),
        )

    names, notes = tuple(posed), skipped(list(files), posed)
    return Scans(path=path, format="kitti-raw", scan_names=names, read=read, notes=notes)


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
    scale = float(np.cos(np.radians(first[0])))
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("ZYX", packet[[5, 4, 3]]).as_matrix()
    pose[:3, 3] = _place(packet, scale) - _place(first, scale)
    return pose


def _place(packet: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
    north = np.log(np.tan(np.pi * (90 + packet[0]) / 360))
    return np.array(
        (scale * EARTH_RADIUS * np.radians(packet[1]), scale * EARTH_RADIUS * north, packet[2])
    )


def _packet(path: Path) -> NDArray[np.float64]:
    """Latitude, longitude, altitude, roll, pitch and yaw of a file of 30 numbers."""
    words = " ".join(read_lines(path, "a packet of the inertial unit")).split()[:_USED]
    values = numbers_of(words)
    sound = values is not None and len(values) == _USED and np.isfinite(values).all()
    if values is None or not sound or abs(values[0]) > _MAX_LATITUDE:
        what = "a packet of the inertial unit, finite numbers that begin with latitude, longitude, "
        raise malformed(path, f"{what}altitude, roll, pitch and yaw", " ".join(words))
    return values


def _scanner_from_unit(folder: Path) -> NDArray[np.float64]:
    places = (folder.absolute().parent / _CALIBRATION, folder / _CALIBRATION)
    path = next((place for place in places if place.is_file()), places[0])
    what = "this file of KITTI's calibration, got none; each day has its own, in an archive of its "
    what += "own"
    expect(path.is_file(), path, what, error=MissingFileError)
    rows = read_keyed_numbers(path)
    turn = keyed_matrix(rows, "R", (3, 3), path=path)
    moved = keyed_matrix(rows, "T", (3, 1), path=path)
    return checked_pose(rigid(np.hstack((turn, moved))), where=str(path))


def _recordings(path: Path) -> tuple[Path, ...]:
    """The recording that a path is or lies in, else those of the folder."""
    for folder in (path, *path.absolute().parents[:2]):
        if _is_recording(folder):
            return (folder,)
    below = path.iterdir() if path.is_dir() else ()
    return tuple(sorted(child for child in below if _is_recording(child)))


def _is_recording(folder: Path) -> bool:
    return (folder / _SCANS).is_dir() and (folder / _UNIT).is_dir()


def find_semantic_kitti(path: Path) -> bool:
    """Whether a path is a sequence with labels, or the data set's folder with one."""
    return any((folder / _LABELS).is_dir() for folder in _sequences(path))


def find_odometry(path: Path) -> bool:
    """Whether a path is a sequence of the odometry benchmark, or the data set's folder."""
    return bool(_sequences(path))


def read_semantic_kitti(path: Path) -> Scans:
    """Scans of a sequence with their labels; a scan without a file of labels has none.

    ``export``'s form ``label`` writes labels back in the order of the scan's file.

    Raises:
        MissingFileError: If there is no sequence with labels, or poses or calibration lack.
        InputError: If there are several sequences, or a file is broken.
    """
    what = f"a sequence of SemanticKITTI, with {_SEQUENCE_SCANS}, {_LABELS} and calib.txt, got none"
    expect(find_semantic_kitti(path), path, what, error=MissingFileError)
    return _read_sequence(path, "semantic-kitti")


def read_odometry(path: Path) -> Scans:
    """Scans of a sequence, without labels.

    Raises:
        MissingFileError: If there is no sequence, or poses or calibration lack.
        InputError: If there are several sequences, or a file is broken.
    """
    what = f"a sequence of KITTI's odometry, with {_SEQUENCE_SCANS} and calib.txt, got none"
    expect(find_odometry(path), path, what, error=MissingFileError)
    return _read_sequence(path, "kitti-odometry")


def _read_sequence(path: Path, format: str) -> Scans:
    folders = {folder.name: folder for folder in _sequences(path)}
    folder = folders[only_one(path, list(folders), "sequence")]
    files = numbered_files(folder / _SEQUENCE_SCANS, ".bin")
    poses = _sequence_poses(folder)
    posed = [name for name in files if int(name) < len(poses)]
    what = f"scans with poses, got {len(files)} scans and {len(poses)} poses"
    expect(posed, path, what, error=InputError)
    labelled = format == "semantic-kitti"
    clock = folder / "times.txt"
    times = read_numbers(clock, columns=1)[:, 0] if clock.is_file() else None

    def read(name: str) -> RawScan:
        points, intensity = read_points(files[name])
        number, file = int(name), folder / _LABELS / f"{name}.label"
        return RawScan(
            where=files[name],
            points=points,
            world_from_sensor=poses[number],
            intensity=intensity,
            labels=_labels(file, len(points)) if labelled and file.is_file() else {},
            void=_VOID,
            time=time_at(times, number),
        )

    return Scans(
        path=path,
        format=format,
        scan_names=tuple(posed),
        read=read,
        classes=label_table("semantic-kitti").classes if labelled else None,
        notes=skipped(list(files), posed),
    )


def _labels(path: Path, points: int) -> Mapping[str, NDArray[np.int64]]:
    both = read_ids(path, "<u4", points=points)
    return {"semantic": both & ((1 << _CLASS_BITS) - 1), "instance": both >> _CLASS_BITS}


def _sequences(path: Path) -> tuple[Path, ...]:
    """The sequence that a path is or lies in, else those of the data set's folder."""
    inside = path.name in (_SEQUENCE_SCANS, _LABELS)
    for folder in (path, path.parent if inside else path):
        if _is_sequence(folder):
            return (folder,)
    for folder in (path, path / "sequences", path / "dataset" / "sequences"):
        below = folder.iterdir() if folder.is_dir() else ()
        found = tuple(sorted(child for child in below if _is_sequence(child)))
        if found:
            return found
    return ()


def _is_sequence(folder: Path) -> bool:
    return (folder / _SEQUENCE_SCANS).is_dir() and (folder / "calib.txt").is_file()


def _sequence_poses(folder: Path) -> list[NDArray[np.float64]]:
    """world_from_scanner of every row."""
    name = f"{folder.absolute().name}.txt"
    above = folder.absolute().parents
    places = (folder / "poses.txt", *(parent / "poses" / name for parent in above[:3]))
    path = next((place for place in places if place.is_file()), places[0])
    what = f"the poses of the sequence, there or in poses/{name} above it, got none; scans without "
    what += "poses are of no use"
    expect(path.is_file(), path, what, error=MissingFileError)
    calibration = folder / "calib.txt"
    matrix = rigid(keyed_matrix(read_keyed_numbers(calibration), "Tr", (3, 4), path=calibration))
    camera_from_scanner = checked_pose(matrix, where=f"{calibration}: Tr")
    back = np.linalg.inv(camera_from_scanner)
    return [
        back
        @ checked_pose(rigid(row.reshape(3, 4)), where=f"{path}: row {i + 1}")
        @ camera_from_scanner
        for i, row in enumerate(read_numbers(path, columns=12))
    ]
