"""Sequences of KITTI's odometry benchmark, and SemanticKITTI's labels of them.

    sequences/00/velodyne/000000.bin    float32 x y z intensity, the scanner's axes
    sequences/00/labels/000000.label    uint32 a point: 16 bits of class, above them the instance
    sequences/00/calib.txt              row Tr: the left camera from the scanner
    sequences/00/poses.txt, or poses/00.txt beside ``sequences``: 3 x 4, of the left camera
    sequences/00/times.txt              seconds, may lack

The world is the scanner's axes at the first pose of the file, x ahead and z up, as
semantic-kitti-api puts scans together.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatseg.errors import InputError, MissingFileError
from splatseg.io.captures.raw_views import checked_pose
from splatseg.io.label_tables import label_table
from splatseg.io.scans._records import read_ids
from splatseg.io.scans._source import RawScan, Scans, only_one
from splatseg.io.scans._velodyne import numbered_files, read_points, skipped
from splatseg.io.text_numbers import keyed_matrix, read_keyed_numbers, read_numbers, rigid

_VOID = frozenset({0, 1})
"""unlabeled and outlier."""

_SCANNER, _LABELS = "velodyne", "labels"
_CLASS_BITS = 16


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
    if not find_semantic_kitti(path):
        raise MissingFileError(
            f"{path}: expected a sequence of SemanticKITTI, with {_SCANNER}, {_LABELS} and "
            "calib.txt, got none."
        )
    return _read(path, "semantic-kitti")


def read_odometry(path: Path) -> Scans:
    """Scans of a sequence, without labels.

    Raises:
        MissingFileError: If there is no sequence, or poses or calibration lack.
        InputError: If there are several sequences, or a file is broken.
    """
    if not find_odometry(path):
        raise MissingFileError(
            f"{path}: expected a sequence of KITTI's odometry, with {_SCANNER} and calib.txt, got "
            "none."
        )
    return _read(path, "kitti-odometry")


def _read(path: Path, format: str) -> Scans:
    folders = {folder.name: folder for folder in _sequences(path)}
    folder = folders[only_one(path, list(folders), "sequence")]
    files = numbered_files(folder / _SCANNER, ".bin")
    poses = _poses(folder)
    posed = [name for name in files if int(name) < len(poses)]
    if not posed:
        raise InputError(
            f"{path}: expected scans with poses, got {len(files)} scans and {len(poses)} poses."
        )
    labelled = format == "semantic-kitti"
    times = folder / "times.txt"
    clock = read_numbers(times, columns=1)[:, 0] if times.is_file() else np.zeros(0)

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
            time=float(clock[number]) if number < len(clock) else None,
        )

    return Scans(
        path=path,
        format=format,
        scan_names=tuple(posed),
        read=read,
        classes=label_table("semantic-kitti").classes if labelled else None,
        notes=skipped(list(files), posed),
    )


def _labels(path: Path, points: int) -> dict[str, NDArray[np.int64]]:
    both = read_ids(path, "<u4", points=points)
    return {
        "semantic": both & ((1 << _CLASS_BITS) - 1),
        "instance": both >> _CLASS_BITS,
    }


def _sequences(path: Path) -> tuple[Path, ...]:
    """The sequence that a path is or lies in, else those of the data set's folder."""
    for folder in (path, path.parent if path.name in (_SCANNER, _LABELS) else path):
        if _is_sequence(folder):
            return (folder,)
    if not path.is_dir():
        return ()
    for folder in (path, path / "sequences", path / "dataset" / "sequences"):
        if folder.is_dir():
            found = tuple(sorted(child for child in folder.iterdir() if _is_sequence(child)))
            if found:
                return found
    return ()


def _is_sequence(folder: Path) -> bool:
    return (folder / _SCANNER).is_dir() and (folder / "calib.txt").is_file()


def _poses(folder: Path) -> list[NDArray[np.float64]]:
    """world_from_scanner of every row."""
    name = f"{folder.absolute().name}.txt"
    above = folder.absolute().parents
    places = (folder / "poses.txt", *(parent / "poses" / name for parent in above[:3]))
    path = next((place for place in places if place.is_file()), places[0])
    if not path.is_file():
        raise MissingFileError(
            f"{path}: expected the poses of the sequence, there or in poses/{name} above it, got "
            "none; scans without poses are of no use."
        )
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
