"""Checkpoints: the state of a fit on disk, written at intervals and read to resume.

An npz (a ZIP archive of NumPy arrays, uncompressed, nothing pickled) with a header of JSON. It is
written beside the previous one under a fixed second name and replaces it when it is complete,
so a process that is killed at any moment leaves a complete one, and an unfinished file that the
next one overwrites. Each array has a checksum, so damage is detected.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from numpy.typing import NDArray

from splatseg.core.boundary import boundary
from splatseg.errors import FileFormatError, quoted
from splatseg.fit._state import FitState
from splatseg.io.arrays import Npz, open_npz, write_checkpoint_file
from splatseg.io.json_files import parse_object

FORMAT = "splatseg-fit"
VERSION = 1
"""Version of the files written. No other version is read."""

_HEADER = "header"


class CheckpointVersionError(FileFormatError):
    """A checkpoint is valid, but of a version that cannot be resumed."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Checkpoint:
    """A state, and the data and options that it belongs to."""

    state: FitState

    identity: Mapping[str, Any]
    """Data, options and backend; see `_identity`."""


def write_checkpoint(checkpoint: Checkpoint, path: Path) -> None:
    """Write a checkpoint; the previous one stays until the new one is complete.

    Raises:
        OutputError: If it cannot be written; the previous one is kept.
    """
    header = {
        "format": FORMAT,
        "version": VERSION,
        "identity": dict(checkpoint.identity),
        "content": dict(checkpoint.state.content),
    }
    tensors = checkpoint.state.tensors
    arrays = {name: tensor.numpy() for name, tensor in tensors.items()}
    write_checkpoint_file(header, arrays, path)


def read_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint. Inverse of `write_checkpoint`.

    Raises:
        MissingFileError: If there is no such file.
        CheckpointVersionError: If it is of another version.
        FileFormatError: If it is not a checkpoint, or damaged.
    """
    with open_npz(path, expected="the checkpoint of a fit") as archive:
        header = _header(path, archive)
        names = [name for name in archive.names if name != _HEADER]
        tensors = {name: torch.from_numpy(_array(path, archive, name)) for name in names}
    state = FitState(tensors=tensors, content=header["content"], where=str(path))
    return Checkpoint(state=state, identity=header["identity"])


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckpointSummary:
    """Where a fit was when its checkpoint was written."""

    steps: int
    progress: float
    """Share of the fit that is done, [0, 1]."""

    seconds: float
    """Since the fit began, pauses left out."""

    gaussians: int


@boundary
def checkpoint_summary(path: Path) -> CheckpointSummary:
    """Steps, progress and size of a checkpoint. Reads no tensors.

    Raises:
        MissingFileError: If there is no such file.
        CheckpointVersionError: If it is of another version.
        FileFormatError: If it is not a checkpoint, or damaged.
    """
    with open_npz(path, expected="the checkpoint of a fit") as archive:
        content = _header(path, archive)["content"]
    state = FitState(tensors={}, content=content, where=str(path))
    return CheckpointSummary(
        steps=int(state.number("steps")),
        progress=state.number("progress"),
        seconds=state.number("seconds"),
        gaussians=int(state.number("gaussians")),
    )


def _array(path: Path, archive: Npz, name: str) -> NDArray[Any]:
    array = archive.array(name)
    if array.dtype.kind not in "fiub":
        raise FileFormatError(f"{path}: expected {quoted(name)} to be an array of numbers.")
    return array


def _header(path: Path, archive: Npz) -> dict[str, Any]:
    if _HEADER not in archive:
        raise FileFormatError(f"{path}: expected the checkpoint of a fit, got another archive.")
    header = parse_object(_array(path, archive, _HEADER).tobytes(), where=str(path))
    if header.get("format") != FORMAT:
        raise FileFormatError(
            f"{path}: expected the checkpoint of a fit, got {quoted(header.get('format'))}."
        )
    if header.get("version") != VERSION:
        raise CheckpointVersionError(
            f"{path}: this fit cannot be resumed, as another splatseg stopped it (expected a "
            f"checkpoint of version {VERSION}, got version {quoted(header.get('version'))})."
        )
    if not isinstance(header.get("content"), dict) or not isinstance(header.get("identity"), dict):
        raise FileFormatError(f"{path}: expected a header with content and identity.")
    return header
