"""Checkpoints: the state of a fit on disk, written at intervals and read to resume.

An npz (a ZIP archive of NumPy arrays, uncompressed, nothing pickled) with a header of JSON. It is
written beside the previous one under a fixed second name and replaces it when it is complete,
so a process that is killed at any moment leaves a complete one, and an unfinished file that the
next one overwrites. Each array has a checksum, so damage is detected.
"""

import zipfile
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.lib.npyio import NpzFile
from numpy.typing import NDArray

from splatseg.core.boundary import boundary
from splatseg.errors import FileFormatError, MissingFileError, SplatsegError
from splatseg.fit._state import FitState
from splatseg.io.json_files import json_text, parse_object

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
        SplatsegError: If it cannot be written; the previous one is kept.
    """
    header = {
        "format": FORMAT,
        "version": VERSION,
        "identity": dict(checkpoint.identity),
        "content": dict(checkpoint.state.content),
    }
    text = json_text(str(path), header)
    arrays: dict[str, NDArray[Any]] = {_HEADER: np.frombuffer(text.encode(), np.uint8)}
    arrays |= {name: tensor.numpy() for name, tensor in checkpoint.state.tensors.items()}
    unfinished = _unfinished(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with unfinished.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
        unfinished.replace(path)
    except OSError as error:
        raise SplatsegError(f"{path}: the checkpoint cannot be written ({error}).") from error


def read_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint. Inverse of `write_checkpoint`.

    Raises:
        MissingFileError: If there is no such file.
        CheckpointVersionError: If it is of another version.
        FileFormatError: If it is not a checkpoint, or damaged.
    """
    with _opened(path) as archive:
        header = _header(path, archive)
        names = [name for name in archive.files if name != _HEADER]
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
    with _opened(path) as archive:
        content = _header(path, archive)["content"]
    state = FitState(tensors={}, content=content, where=str(path))
    return CheckpointSummary(
        steps=int(state.number("steps")),
        progress=state.number("progress"),
        seconds=state.number("seconds"),
        gaussians=int(state.number("gaussians")),
    )


@boundary
def discard_checkpoint(path: Path) -> None:
    """Remove a checkpoint, and its folder if nothing else is in it."""
    files = [file for file in (path, _unfinished(path)) if file.is_file()]
    for file in files:
        file.unlink()
    folder = path.absolute().parent
    if files and not any(folder.iterdir()):
        folder.rmdir()


def _unfinished(path: Path) -> Path:
    return path.with_name(f"{path.name}.new")


@contextmanager
def _opened(path: Path) -> Generator[NpzFile]:
    if not path.is_file():
        raise MissingFileError(f"{path}: there is no such checkpoint.")
    try:
        # NumPy reads a file that is not an archive as a single array, or as a pickle.
        with zipfile.ZipFile(path):
            pass
        with np.load(path, allow_pickle=False) as archive:
            yield archive
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
        if isinstance(error, FileFormatError):
            raise
        raise FileFormatError(
            f"{path}: expected the checkpoint of a fit, got a damaged file or another format "
            f"({error})."
        ) from error


def _array(path: Path, archive: NpzFile, name: str) -> NDArray[Any]:
    array = cast(object, archive[name])
    # A member that is not .npy is read as bytes.
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiub":
        raise FileFormatError(f"{path}: expected {name!r} to be an array of numbers.")
    return array


def _header(path: Path, archive: NpzFile) -> dict[str, Any]:
    if _HEADER not in archive.files:
        raise FileFormatError(f"{path}: expected the checkpoint of a fit, got another archive.")
    header = parse_object(_array(path, archive, _HEADER).tobytes(), where=str(path))
    if header.get("format") != FORMAT:
        raise FileFormatError(
            f"{path}: expected the checkpoint of a fit, got {header.get('format')!r}."
        )
    if header.get("version") != VERSION:
        raise CheckpointVersionError(
            f"{path}: this fit cannot be resumed, as another splatseg stopped it (expected a "
            f"checkpoint of version {VERSION}, got version {header.get('version')!r})."
        )
    if not isinstance(header.get("content"), dict) or not isinstance(header.get("identity"), dict):
        raise FileFormatError(f"{path}: expected a header with content and identity.")
    return header
