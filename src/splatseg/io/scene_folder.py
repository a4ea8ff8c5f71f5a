"""The folder of a scene while it is worked on: who does, its files, what a kill left of it.

``SCENE/.splatseg-lock`` says who works on the scene, for people. What counts is the lock of the
operating system on this file, which is gone when its process ends in whatever way; so the file
of a process that was killed bars nobody. Reading a scene needs no lock.
"""

import contextlib
import json
import os
import shutil
import socket
import time
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from splatseg.core.boundary import boundary
from splatseg.errors import FileFormatError, InputError
from splatseg.io.atomic import (
    TEMPORARY,
    check_writable,
    failure_to_write,
    is_running,
    named_write_failures,
    path_inside,
    sweep,
    try_lock,
)
from splatseg.io.json_files import parse_object
from splatseg.io.schema import structured

LOCK_FILE = f"{TEMPORARY}lock"

# Someone who only looks whether the lock is held holds it for an instant.
_TRIES, _PAUSE = 5, 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class LockOwner:
    """Who works on a scene."""

    work: str
    """What is done: fit, see, segment, ..."""

    process: int
    """Number of the process."""

    host: str
    """Name of the machine."""

    since: float
    """Seconds since 1970."""

    def __str__(self) -> str:
        """In words."""
        began = time.strftime("%H:%M", time.localtime(self.since))
        machine = "" if self.host == socket.gethostname() else f" on {self.host:.80}"
        return f"{self.work:.40}, process {self.process}{machine}, since {began}"


_held: dict[Path, int] = {}
"""How many blocks of this process hold the lock of a scene."""


@contextmanager
def scene_lock(root: Path, work: str) -> Generator[None]:
    """Work on a scene folder, which is there, as the only process that does.

    A block within another one of the same process passes.

    Args:
        root: The scene folder.
        work: What is done, for the message to others.

    Raises:
        InputError: If another process works on it, or the folder cannot be written to: nothing
            was done yet.
    """
    key = root.resolve()
    if key in _held:
        _held[key] += 1
        try:
            yield
        finally:
            _held[key] -= 1
        return
    try:
        handle = _taken(root / LOCK_FILE)
    except OSError as error:
        raise InputError(failure_to_write(root, error)) from error
    _held[key] = 1
    try:
        me = LockOwner(work=work, process=os.getpid(), host=socket.gethostname(), since=time.time())
        os.ftruncate(handle, 0)
        os.pwrite(handle, json.dumps(asdict(me)).encode(), 0)
        yield
    finally:
        del _held[key]
        # Still locked: who opened the file before sees that it is not the one of that name.
        with contextlib.suppress(OSError):
            (root / LOCK_FILE).unlink(missing_ok=True)
        os.close(handle)


def check_unlocked(root: Path) -> None:
    """Refuse a scene that another process works on, before anything else is said of it.

    Raises:
        InputError: If one does.
    """
    owner = None if root.resolve() in _held else lock_owner(root)
    if owner is not None:
        raise InputError(_refusal(root, owner))


def lock_owner(root: Path) -> LockOwner | None:
    """Who works on a scene now; None if nobody does."""
    try:
        # Whatever a scene from elsewhere has of this name: nothing is waited for.
        handle = os.open(root / LOCK_FILE, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:
        return None
    try:
        owner = _read(handle)
        lock = try_lock(handle, shared=True)
    finally:
        os.close(handle)
    if lock == "held":
        return owner or LockOwner(work="splatseg", process=0, host="", since=0.0)
    return owner if lock == "unknown" and _seems_to_run(owner) else None


def _taken(path: Path) -> int:
    """A handle of the lock file, locked.

    Raises:
        InputError: If another process holds it.
    """
    for attempt in range(_TRIES):
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
        lock, owner = try_lock(handle), _read(handle)
        # On a file system without locks the number of the process has to do.
        free = lock == "taken" or (lock == "unknown" and not _seems_to_run(owner))
        if free and _is_current(handle, path):
            return handle
        os.close(handle)
        if not free and attempt == _TRIES - 1:
            raise InputError(_refusal(path.parent, owner))
        time.sleep(_PAUSE)  # or its owner has just removed it
    raise InputError(_refusal(path.parent, None))


def _refusal(root: Path, owner: LockOwner | None) -> str:
    who = "" if owner is None else f" ({owner})"
    return f"{root}: another splatseg works on this scene{who}; wait for it to end, or stop it."


def _is_current(handle: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except FileNotFoundError:
        return False


def _seems_to_run(owner: LockOwner | None) -> bool:
    return (
        owner is not None
        and owner.process != os.getpid()
        and (owner.host != socket.gethostname() or is_running(owner.process))
    )


def _read(handle: int) -> LockOwner | None:
    """What a lock file says; None where it says nothing yet."""
    try:
        entry = parse_object(os.pread(handle, 4096, 0), where=LOCK_FILE)
        return structured(entry, LockOwner, where=LOCK_FILE)
    except (FileFormatError, OSError):
        return None


SCENE_FILE = "scene.json"
GAUSSIANS_FILE = "gaussians.ply"
CAMERAS_FILE = "cameras/transforms.json"
CHECKPOINT_FILE = "fit/checkpoint.npz"
BLOCKS_FOLDER = "fit/blocks"
"""Where a fit in blocks keeps the checkpoint of each."""

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
    checkpoint, poses, blocks = (path / n for n in (CHECKPOINT_FILE, POSES_FOLDER, BLOCKS_FOLDER))
    if is_scene(path) or not (checkpoint.parent.is_dir() or poses.is_dir()):
        return False
    own = (checkpoint.parent.name, poses.name, GAUSSIANS_FILE, MASKS_FOLDER, *FOLDERS)
    return (
        _holds_only(path, own)
        and _holds_only(checkpoint.parent, (checkpoint.name, f"{checkpoint.name}.new", blocks.name))
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
