"""Checkpoints of long work: arrays, and a header of JSON that says of what work they are."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from splatseg.errors import FileFormatError, quoted
from splatseg.io.arrays import open_npz
from splatseg.io.json_files import parse_object

_HEADER = "header"


class CheckpointVersionError(FileFormatError):
    """A checkpoint is valid, but of a version that cannot be resumed."""


def read_checkpoint_file(
    path: Path, work: str, version: int, names: Collection[str] | None = None
) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """The header and the arrays of a checkpoint, see `io.arrays.write_checkpoint_file`.

    Args:
        path: The file.
        work: What it is the checkpoint of, such as ``fit``: ``format`` is splatseg-fit.
        version: The version that is read.
        names: Which arrays; None reads all of them.

    Raises:
        MissingFileError: If there is no such file.
        CheckpointVersionError: If it is of another version.
        FileFormatError: If it is no such checkpoint, or damaged.
    """
    expected = f"the checkpoint of a {work}"
    with open_npz(path, expected=expected) as file:
        if _HEADER not in file:
            raise FileFormatError(f"{path}: expected {expected}, got another archive.")
        header = parse_object(file.array(_HEADER).tobytes(), where=str(path))
        wanted = [n for n in file.names if n != _HEADER and (names is None or n in names)]
        arrays = {name: file.array(name) for name in wanted}
    if header.get("format") != f"splatseg-{work}":
        raise FileFormatError(f"{path}: expected {expected}, got {quoted(header.get('format'))}.")
    if header.get("version") != version:
        raise CheckpointVersionError(
            f"{path}: this {work} cannot be resumed, as another splatseg stopped it (expected a "
            f"checkpoint of version {version}, got version {quoted(header.get('version'))})."
        )
    for name, array in arrays.items():
        if array.dtype.kind not in "fiub":
            raise FileFormatError(f"{path}: expected {quoted(name)} to be an array of numbers.")
    return header, arrays
