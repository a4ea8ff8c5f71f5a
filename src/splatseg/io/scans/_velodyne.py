"""What KITTI's data sets share: numbered files of points, and a scanner that turns as it drives."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from splatseg.io.scans._records import read_records

COLUMNS = 4
"""x, y, z and the share of the light that came back, float32."""

_NUMBER = re.compile(r"[0-9]{1,10}")


def numbered_files(folder: Path, suffix: str) -> dict[str, Path]:
    """Files whose names are numbers, by their names, in the order of the numbers."""
    files = folder.glob(f"*{suffix}") if folder.is_dir() else ()
    named = [file for file in files if _NUMBER.fullmatch(file.stem)]
    return {file.stem: file for file in sorted(named, key=lambda file: (int(file.stem), file.stem))}


def read_points(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Positions in the sensor's axes (n, 3), and intensities.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If its last point is cut short.
    """
    rows = read_records(path, COLUMNS)
    return rows[:, :3].astype(np.float64), rows[:, 3]


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


def skipped(names: Sequence[str], posed: Sequence[str]) -> tuple[str, ...]:
    """A note on scans that have no pose."""
    lacking = len(names) - len(posed)
    if not lacking:
        return ()
    return (f"left out: {lacking} of {len(names)} scans that have no pose",)
