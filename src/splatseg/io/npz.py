"""Archives of NumPy arrays, read without pickles."""

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg.errors import FileFormatError, MissingFileError


def read_npz(
    path: Path, names: Sequence[str], *, optional: Sequence[str] = ()
) -> dict[str, NDArray[Any]]:
    """Named arrays of an npz, and those of the optional ones that are there.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no npz, or lacks one of them.
    """
    if not path.is_file():
        raise MissingFileError(f"{path}: there is no such file.")
    try:
        with zipfile.ZipFile(path):
            pass
        with np.load(path, allow_pickle=False) as archive:
            missing = [name for name in names if name not in archive.files]
            if missing:
                found = ", ".join(archive.files)
                raise FileFormatError(f"{path}: expected an array {missing[0]!r}, got {found}.")
            there = [name for name in optional if name in archive.files]
            return {name: archive[name] for name in (*names, *there)}
    except FileFormatError:
        raise
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise FileFormatError(
            f"{path}: expected an npz, but it cannot be read ({error})."
        ) from error
