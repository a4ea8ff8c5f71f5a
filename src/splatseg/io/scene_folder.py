"""The folder of a scene while it is written: its files, who works on it, what a kill left of it."""

import os
import shutil
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path

from splatseg.core.boundary import boundary
from splatseg.io.atomic import TEMPORARY, check_writable, sweep
from splatseg.io.lock import scene_lock
from splatseg.io.paths import path_inside
from splatseg.io.write_errors import named_write_failures

SCENE_FILE = "scene.json"
GAUSSIANS_FILE = "gaussians.ply"
CAMERAS_FILE = "cameras/transforms.json"
CHECKPOINT_FILE = "fit/checkpoint.npz"
TRAINING_FOLDER = "training"
"""Where methods that train keep their state until the layer is written."""

POSES_FOLDER = "capture"
"""Where `fit` keeps the poses that it found for bare photographs."""

MASKS_FOLDER = "masks"
"""Where `fit` keeps masks of views that it made, such as those without moving things."""

FOLDERS = ("cameras", "evidence", "layers", "reports")
"""Folders that every scene has."""

PENDING = f"{TEMPORARY}pending"
"""Folder of files of a new scene that count already, but are not in their places yet."""

_WORK_FOLDERS = (*FOLDERS, "exports", "fields", "fit", MASKS_FOLDER, TRAINING_FOLDER)
_POSES_ENTRIES = (
    "poses.json", "sparse", "frames", "frames.txt", "work", "aligned.npz", "pointmaps",
)  # fmt: skip


@boundary
def is_scene(path: Path) -> bool:
    """Whether a folder is a scene folder."""
    return current_file(path, SCENE_FILE).is_file()


@boundary
def is_unfinished(path: Path) -> bool:
    """Whether a folder holds a fit that has not become a scene yet, and nothing else."""
    checkpoint, poses = path / CHECKPOINT_FILE, path / POSES_FOLDER
    if is_scene(path) or not (checkpoint.parent.is_dir() or poses.is_dir()):
        return False
    own = (checkpoint.parent.name, poses.name, GAUSSIANS_FILE, MASKS_FOLDER, *FOLDERS)
    return (
        _holds_only(path, own)
        and _holds_only(checkpoint.parent, (checkpoint.name, f"{checkpoint.name}.new"))
        and _holds_only(poses, _POSES_ENTRIES)
    )


@boundary
def training_file(root: Path, layer: str) -> Path:
    """Where the training of a layer keeps its state.

    Raises:
        InputError: If a link leads out of the scene.
    """
    return path_inside(root, TRAINING_FOLDER, f"{layer}.npz", make=False)


@boundary
def training_files(root: Path) -> tuple[Path, ...]:
    """States of all trainings that were stopped, by the names of their layers."""
    return tuple(sorted((root / TRAINING_FOLDER).glob("*.npz")))


def scene_path(root: Path, *names: str) -> Path:
    """Where something of a scene is to be written; the folders that it needs are made.

    Raises:
        InputError: If a link leads out of the scene.
        OutputError: If there is no permission.
    """
    with named_write_failures(root.joinpath(*names)):
        return path_inside(root, *names)


@contextmanager
def work_on_scene(root: Path, work: str, *, writes: Sequence[str] = ()) -> Generator[None]:
    """Work on a scene folder as the only process that does, after what others left is cleared.

    What a process that was killed had as good as finished is finished.

    Args:
        root: The scene folder, or that of a fit.
        work: What is done, for the message to others.
        writes: Folders of the scene that will be written to.

    Raises:
        InputError: If another process works on it, or it may not be written to.
        OutputError: If the folder cannot be written to.
    """
    with scene_lock(root, work):
        with named_write_failures(root):
            _clear(root)
        for name in writes:
            check_writable(scene_path(root, name, "file").parent)
        yield


def finish_pending(root: Path) -> None:
    """Move the files of a new scene to their places, the last of them scene.json."""
    pending = root / PENDING
    if not pending.is_dir():
        return
    files = [path.relative_to(pending) for path in pending.rglob("*") if path.is_file()]
    for file in sorted(files, key=lambda file: (file.as_posix() == SCENE_FILE, file)):
        target = path_inside(root, file.as_posix())
        (pending / file).replace(target)
    for name in FOLDERS:
        (root / name).mkdir(exist_ok=True)
    shutil.rmtree(pending)


def current_file(root: Path, name: str) -> Path:
    """Where a file of the scene is: among those about to take their places, or in its own."""
    pending = root / PENDING / name
    return pending if pending.is_file() else root / name


def _clear(root: Path) -> None:
    """Finish or remove what processes that were killed left in a scene."""
    finish_pending(root)
    sweep(root)
    for name in _WORK_FOLDERS:
        for folder, _, files in os.walk(root / name):
            sweep(Path(folder))
            if name in ("fit", TRAINING_FOLDER):
                for file in files:
                    if file.endswith(".npz.new"):  # half a checkpoint
                        (Path(folder) / file).unlink(missing_ok=True)


def _holds_only(folder: Path, names: Sequence[str]) -> bool:
    """Whether a folder, where it is there, holds nothing but these, or what was being written."""
    # What a process that was killed was about to write lies in hidden folders of this prefix.
    return not folder.is_dir() or all(
        entry.name in names or entry.name.startswith(TEMPORARY) for entry in folder.iterdir()
    )
