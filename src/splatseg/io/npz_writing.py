"""Archives of NumPy arrays with a header, written: layers, and checkpoints of long work.

Entries are stored uncompressed and without time stamps, so that the same values give the same
bytes; nothing is pickled.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
from numpy.lib.format import write_array
from numpy.typing import NDArray

from splatseg.io.atomic import sync
from splatseg.io.json_files import json_text
from splatseg.io.write_errors import named_write_failures

HEADER = "header"
"""Name of the entry that holds the header, JSON as bytes of UTF-8."""


def save_arrays(
    header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], path: Path, *, name: Path
) -> None:
    """Write a header and arrays to a file as they come.

    Args:
        header: Values that JSON holds.
        arrays: By name.
        path: The file.
        name: What the file is to be called, for messages.

    Raises:
        InputError: If the header holds a value that JSON has no word for.
        OSError: If it cannot be written.
    """
    text = json_text(f"{name}: header", header)
    named: dict[str, Any] = {HEADER: np.frombuffer(text.encode(), np.uint8), **arrays}
    # As np.savez does it, which before numpy 2.1 makes allow_pickle=False an array of that name, or
    # leaves an archive that complains when it is collected, where the disk is full.
    with ZipFile(path, "w") as archive:
        for key, array in named.items():
            with archive.open(f"{key}.npy", "w", force_zip64=True) as member:
                write_array(member, np.asanyarray(array), allow_pickle=False)


def write_checkpoint_file(
    header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], path: Path
) -> None:
    """Write a checkpoint; the one before stays until the disk has the new one.

    It is written under a fixed second name, so that a process that is killed at any moment
    leaves a complete one, and an unfinished file that the next one overwrites.

    Raises:
        OutputError: If it cannot be written; the one before is still there.
    """
    new = unfinished(path)
    with named_write_failures(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            save_arrays(header, arrays, new, name=path)
            sync(new)
            new.replace(path)
            sync(path.parent)
        except OSError:
            new.unlink(missing_ok=True)  # a full disk needs the space
            raise


def discard_checkpoint_file(path: Path) -> None:
    """Remove a checkpoint, and its folder if nothing else is in it."""
    for file in (path, unfinished(path)):
        file.unlink(missing_ok=True)
    if path.parent.is_dir() and not any(path.parent.iterdir()):
        path.parent.rmdir()


def unfinished(path: Path) -> Path:
    """Where a checkpoint is while it is being written."""
    return path.with_name(f"{path.name}.new")
