"""Numbers and times in text files: tables, rows with names, and dates a row."""

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatseg.io.foreign import expect, malformed, read_lines


def number_table(lines: Sequence[bytes], columns: int) -> NDArray[np.float64]:
    """Numbers of one or more lines of text (rows, columns), NaN and infinity too.

    Raises:
        ValueError: If a word is no number, or a line has more or fewer of them.
    """
    table = np.loadtxt(lines, ndmin=2, comments=None)
    if table.shape != (len(lines), columns):
        raise ValueError(f"they have {table.shape[1]}")
    return table


def numbers_of(words: Sequence[str]) -> NDArray[np.float64] | None:
    """Words as numbers; None where one is none."""
    try:
        return np.array([float(word) for word in words])
    except ValueError:
        return None


def read_numbers(path: Path, *, columns: int, rows: int | None = None) -> NDArray[np.float64]:
    """A table of numbers (rows, columns), separated by spaces; NaN and infinity are let through.

    Args:
        path: The file.
        columns: Numbers a row.
        rows: How many rows there must be; None takes any number from 1 on.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If a word is no number, or there are more or fewer of them.
    """
    shape = f"{'' if rows is None else f'{rows} '}rows of {columns} numbers"
    lines = read_lines(path, shape)
    expect(lines and rows in (None, len(lines)), path, f"{shape}, got {len(lines)} rows")
    table = np.empty((len(lines), columns))
    for i, line in enumerate(lines):
        values = numbers_of(line.split())
        if values is None or len(values) != columns:
            raise malformed(path, f"{columns} numbers in row {i + 1}", line)
        table[i] = values
    return table


def read_matrix(path: Path, shape: tuple[int, int], what: str) -> NDArray[np.float64]:
    """A file that is one matrix of finite numbers, in any number of rows.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it has more or fewer numbers, or other words.
    """
    values = numbers_of(" ".join(read_lines(path, what)).split())
    if values is None:
        raise malformed(path, f"{shape[0]} x {shape[1]} numbers, got other words")
    return _shaped(values, shape, where=str(path))


def read_keyed_numbers(path: Path) -> dict[str, NDArray[np.float64]]:
    """Rows ``NAME: 1 2 3`` by name; rows of other words, such as a date, are left out.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no text.
    """
    found: dict[str, NDArray[np.float64]] = {}
    for line in read_lines(path, "a calibration of rows NAME: numbers"):
        name, _, rest = line.partition(":")
        values = numbers_of(rest.split())
        if values is not None and values.size:
            found[name.strip()] = values
    return found


def keyed_matrix(
    rows: Mapping[str, NDArray[np.float64]], name: str, shape: tuple[int, int], *, path: Path
) -> NDArray[np.float64]:
    """One of the named rows as a matrix.

    Raises:
        FileFormatError: If there is none of that name, it has more or fewer numbers, or one of
            them is NaN or infinite.
    """
    expect(name in rows, path, f"a row {name}", ", ".join(rows) or None)
    return _shaped(rows[name], shape, where=f"{path}: {name}")


def _shaped(
    values: NDArray[np.float64], shape: tuple[int, int], *, where: str
) -> NDArray[np.float64]:
    fits = values.size == shape[0] * shape[1]
    expect(fits, where, f"{shape[0]} x {shape[1]} numbers, got {values.size}")
    expect(np.isfinite(values).all(), where, "finite numbers, got NaN or infinity")
    return values.reshape(shape)


def rigid(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """The 4 x 4 transform of its first three rows (3 x 4)."""
    return np.vstack((rows, [0.0, 0.0, 0.0, 1.0]))


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
    expect(not lines or not np.isnan(times).all(), path, "dates and times", "".join(lines[:1]))
    return times


def time_at(times: NDArray[np.float64] | None, frame: int) -> float:
    """Seconds of a frame, NaN where they are not known."""
    known = times is not None and 0 <= frame < len(times)
    return float(times[frame]) if known else math.nan  # pyright: ignore[reportOptionalSubscript]


def frame_time(times: NDArray[np.float64] | None, frame: int) -> float:
    """Seconds of a frame where they are known, else its number.

    Example:
        >>> frame_time(np.array([7.5, math.nan]), 0), frame_time(np.array([7.5, math.nan]), 1)
        (7.5, 1.0)
    """
    moment = time_at(times, frame)
    return moment if math.isfinite(moment) else float(frame)


def _seconds(line: str) -> float:
    try:
        return datetime.fromisoformat(line).replace(tzinfo=UTC).timestamp()
    except ValueError:
        return math.nan
