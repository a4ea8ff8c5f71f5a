"""Files of dates and times, a row a frame, as KITTI's data sets have them."""

import math
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatseg.errors import FileFormatError, quoted
from splatseg.io.foreign import read_lines


def read_times(path: Path) -> NDArray[np.float64] | None:
    """Seconds of each row of ``timestamps.txt`` on one clock; None where there is no such file.

    Rows are ``2013-05-28 08:46:02.904000000``; an empty one, or one of other words, is NaN.

    Raises:
        FileFormatError: If no row is a time.
    """
    if not path.is_file():
        return None
    lines = read_lines(path, "dates and times")
    times = np.array([_seconds(line) for line in lines])
    if len(times) and np.isnan(times).all():
        raise FileFormatError(f"{path}: expected dates and times, got {quoted(lines[0])}.")
    return times


def frame_time(times: NDArray[np.float64] | None, frame: int) -> float:
    """Seconds of a frame where they are known, else its number.

    Args:
        times: Seconds by frame, NaN where they are not known; None where no time is.
        frame: Its number, 0 or more.

    Example:
        >>> frame_time(np.array([7.5, math.nan]), 0), frame_time(np.array([7.5, math.nan]), 1)
        (7.5, 1.0)
    """
    known = times is not None and frame < len(times) and math.isfinite(times[frame])
    return float(times[frame]) if times is not None and known else float(frame)


def _seconds(line: str) -> float:
    try:
        return datetime.fromisoformat(line).replace(tzinfo=UTC).timestamp()
    except ValueError:
        return math.nan
