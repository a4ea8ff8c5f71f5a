"""Tables of numbers in text files: rows of words, as poses and intrinsics are written."""

from collections.abc import Sequence
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatseg.errors import FileFormatError, quoted
from splatseg.io.foreign import read_lines

_BLOCK = 1 << 12
"""Lines whose words are in memory at once."""


def number_table(lines: Sequence[bytes], columns: int) -> NDArray[np.float64]:
    """Numbers of lines of text (rows, columns), separated by white space; NaN and infinity too.

    A million lines of 62 numbers take about eight seconds.

    Raises:
        ValueError: If a word is no number, or a line has more or fewer of them.
    """
    table = np.empty((len(lines), columns))
    for start in range(0, len(lines), _BLOCK):
        rows = [line.split() for line in lines[start : start + _BLOCK]]
        for i, row in enumerate(rows):
            if len(row) != columns:
                raise ValueError(f"row {start + i + 1} has {len(row)}")
        words = chain.from_iterable(rows)
        values = np.fromiter(map(float, words), np.float64, columns * len(rows))
        table[start : start + len(rows)] = values.reshape(-1, columns)
    return table


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
    if not lines or (rows is not None and len(lines) != rows):
        raise FileFormatError(f"{path}: expected {shape}, got {len(lines)} rows.")
    table = np.empty((len(lines), columns))
    for i, line in enumerate(lines):
        words = line.split()
        if len(words) != columns:
            raise FileFormatError(
                f"{path}: expected {columns} numbers in row {i + 1}, got {quoted(line)}."
            )
        try:
            table[i] = [float(word) for word in words]
        except ValueError as error:
            raise FileFormatError(
                f"{path}: expected {columns} numbers in row {i + 1}, got {quoted(line)}."
            ) from error
    return table
