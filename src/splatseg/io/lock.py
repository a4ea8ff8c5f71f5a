"""One process at a time changes a scene: a lock that ends with its process.

``SCENE/.splatseg-lock`` says who works on the scene, for people. What counts is the lock of the
operating system on this file, which is gone when its process ends in whatever way; so the file
of a process that was killed bars nobody. Reading a scene needs no lock.
"""

import contextlib
import json
import os
import socket
import time
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from splatseg.errors import FileFormatError, InputError
from splatseg.io.atomic import TEMPORARY, is_running
from splatseg.io.file_locks import try_lock
from splatseg.io.json_files import parse_object
from splatseg.io.write_errors import failure_to_write

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
        machine = "" if self.host == socket.gethostname() else f" on {self.host}"
        return f"{self.work}, process {self.process}{machine}, since {began}"


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
        return LockOwner(
            work=str(entry["work"])[:40],
            process=int(entry["process"]),
            host=str(entry["host"])[:80],
            since=float(entry["since"]),
        )
    except (FileFormatError, OSError, ValueError, KeyError, TypeError, OverflowError):
        return None
