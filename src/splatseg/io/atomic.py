"""Writing files and folders so that nothing half-written is ever seen under the target's name.

Everything is written in a hidden folder beside the target (same file system, so that the rename
is one step) and renamed only when the block ended well. The hidden folder's name has the number
of the process, and the process holds a lock on it: what a killed process left is told from what
another one is writing, and `sweep` removes it. What data names is written below its folder, see
`path_inside`, and what the system says of a failure becomes a sentence that says what to do.
"""

import contextlib
import errno
import fcntl
import os
import shutil
import tempfile
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from splatseg.errors import InputError, MissingFileError, OutputError, SplatsegError

_WHAT_TO_DO = {
    errno.ENOSPC: "the disk is full; free some space and give the command again",
    errno.EDQUOT: "the disk quota is used up; free some space and give the command again",
    errno.EFBIG: "the file would be larger than is allowed here",
    errno.EROFS: "it lies on a disk that can only be read; choose another folder",
    errno.EACCES: "there is no permission to write there; change it or choose another folder",
    errno.EPERM: "there is no permission to write there; change it or choose another folder",
    errno.ENAMETOOLONG: "its name is too long; choose a shorter one",
}

# Of talking to other processes and people, not of files.
_OF_NO_FILE = (ConnectionError, ChildProcessError, ProcessLookupError, TimeoutError)


def failure_to_write(path: Path | str, error: OSError) -> str:
    """The sentence: what cannot be written, why, and what to do.

    Example:
        >>> failure_to_write("a.ply", OSError(28, "No space left on device"))
        'a.ply: cannot be written: the disk is full; free some space and give the command again.'
    """
    reason = _WHAT_TO_DO.get(error.errno or 0, error.strerror or str(error))
    return f"{path}: cannot be written: {reason}."


def is_write_failure(error: OSError) -> bool:
    """Whether an error that has no file of its own to name is about one that is written."""
    return error.errno in _WHAT_TO_DO and not isinstance(error, SplatsegError)


@contextmanager
def named_write_failures(path: Path, *, within: Path | None = None) -> Generator[None]:
    """Turn what the system says of writing in the block into an `OutputError`.

    Errors about other files than those below `within`, and our own, go through as they are.

    Args:
        path: What is being written, for the message.
        within: Where it is written for now; None takes errors about any file.
    """
    try:
        yield
    except (SplatsegError, *_OF_NO_FILE):
        raise
    except OSError as error:
        if not _is_of(error, path, within):
            raise
        raise OutputError(failure_to_write(path, error)) from error


def _is_of(error: OSError, path: Path, within: Path | None) -> bool:
    if within is None or error.filename is None or error.errno in (errno.ENOSPC, errno.EDQUOT):
        return True
    named = Path(str(error.filename))
    return named in (path, within) or within in named.parents


def path_inside(folder: Path, *names: str, make: bool = True) -> Path:
    """A path below a folder, which it cannot leave: every file named by data is written so.

    Args:
        folder: The folder. It may itself be a link, and need not be there yet.
        names: What is below it; names with a slash lie in further folders.
        make: Make the folders that the path needs.

    Returns:
        The path, as it is written.

    Raises:
        InputError: If a name climbs, is absolute or no name at all, or a link that is there leads
            out of the folder.

    Example:
        >>> path_inside(Path("masks"), "left/0001.json", make=False).as_posix()
        'masks/left/0001.json'
    """
    parts = [part for name in names for part in name.split("/")]
    if any(part in ("", ".", "..") or "\\" in part or "\0" in part for part in parts):
        raise InputError(f"{folder}: expected the name of a file below it, got {names[-1]!r:.60}.")
    path = folder.joinpath(*parts)
    try:
        leaves = not path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError) as error:  # links in a circle
        raise InputError(f"{path}: cannot be followed ({error}).") from error
    if leaves:
        raise InputError(
            f"{path}: expected a place in {folder}, but a link leads out of it to "
            f"{path.resolve()}; nothing is written there."
        )
    if make:
        path.parent.mkdir(parents=True, exist_ok=True)
    return path


def check_utf8(path: Path) -> None:
    """Refuse a path that no JSON file can hold, as its bytes are not UTF-8.

    Raises:
        InputError: If it is one.
    """
    try:
        str(path.absolute()).encode()
    except UnicodeEncodeError as error:
        shown = os.fsencode(path)
        raise InputError(
            f"{str(path).encode(errors='replace').decode()}: expected a name in UTF-8, got the "
            f"bytes {shown!r:.200}; rename it (`convmv -f latin1 -t utf8`)."
        ) from error


Lock = Literal["taken", "held", "unknown"]
"""We have it now; another one has it; the file system has no such locks."""


def try_lock(handle: int, *, shared: bool = False) -> Lock:
    """Lock an open file or folder without waiting; closing the handle gives it back.

    Args:
        handle: Its descriptor.
        shared: Others may have it at the same time, if theirs is shared too.
    """
    try:
        fcntl.flock(handle, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return "held"
    except OSError:
        return "unknown"
    return "taken"


TEMPORARY = ".splatseg-"
"""How the names of files and folders begin that are ours and not the user's."""

_PREVIOUS = ("previous", "previous.old")
# A process of this number that runs may be another one, of another container or later.
_CERTAINLY_ABANDONED = 3600.0


@contextmanager
def atomic_file(path: str | os.PathLike[str], *, durable: bool = False) -> Generator[Path]:
    """Give a temporary path to write a file to; it becomes `path` when the block ends well.

    The temporary name ends with the target's whole name, so writers that look at the suffix
    see the right one. An existing file is replaced in one step. If the block raises, the
    target is untouched and the temporary file is gone.

    Args:
        path: The file to write. Its folder must exist.
        durable: Wait until the disk has the file before it replaces the old one, so that a
            power cut leaves one of the two.

    Raises:
        MissingFileError: If the folder of `path` does not exist.
        InputError: If `path` is a folder, or if the block ended without writing the file.
        OutputError: If the disk is full, or there is no permission.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with atomic_file(Path(folder) / "a.txt") as temporary:
        ...         _ = temporary.write_text("whole")
        ...     print((Path(folder) / "a.txt").read_text())
        whole
    """
    target = _checked_target(path)
    if target.is_dir():
        raise InputError(f"{target}: expected a file to write, got a folder.")
    with hidden_folder(target) as holder, named_write_failures(target, within=holder):
        temporary = holder / target.name
        yield temporary
        if not temporary.is_file():
            raise InputError(f"{target}: expected the file to be written, but nothing was.")
        if durable:
            sync(temporary)
        temporary.replace(target)
        if durable:
            sync(target.parent)


@contextmanager
def atomic_folder(path: str | os.PathLike[str], *, durable: bool = False) -> Generator[Path]:
    """Give an empty temporary folder to fill; it becomes `path` when the block ends well.

    An existing folder is replaced as a whole: what the block did not write is gone afterwards.
    Between two renames the target is missing for an instant, but both the old and the new
    folder are complete at every moment; the old one comes back if the second rename fails, and
    `sweep` brings the new one into place if the process was killed between the two.

    Args:
        path: The folder to write. Its parent must exist.
        durable: Wait until the disk has everything before the folder takes its name.

    Raises:
        MissingFileError: If the parent of `path` does not exist.
        InputError: If `path` is a file.
        OutputError: If the disk is full, or there is no permission.
    """
    target = _checked_target(path)
    if target.exists() and not target.is_dir():
        raise InputError(f"{target}: expected a folder to write, got a file.")
    with hidden_folder(target) as holder, named_write_failures(target, within=holder):
        temporary = holder / target.name
        temporary.mkdir()
        yield temporary
        if durable:
            sync_tree(temporary)
        replace_folder(temporary, target, holder / _PREVIOUS[0])
        if durable:
            sync(target.parent)


@contextmanager
def hidden_folder(target: Path) -> Generator[Path]:
    """A hidden folder beside `target` while the block runs, which `sweep` lets alone.

    Raises:
        OutputError: If none can be made there.
    """
    with named_write_failures(target):
        holder = Path(tempfile.mkdtemp(prefix=f"{TEMPORARY}{os.getpid()}-", dir=target.parent))
    handle = None
    try:
        handle = _locked(holder)
        yield holder
    finally:
        _remove(holder)  # while it is locked, or another process may take it for abandoned
        if handle is not None:
            os.close(handle)


def _remove(holder: Path) -> None:
    """Remove a hidden folder, whole even if Ctrl-C comes meanwhile."""
    try:
        shutil.rmtree(holder, ignore_errors=True)
    except KeyboardInterrupt:
        shutil.rmtree(holder, ignore_errors=True)
        raise


def sweep(folder: Path) -> None:
    """Clear a folder of what killed processes were writing in it.

    A folder that one was about to replace gets its new content. What a process that runs is
    writing stays, and so does what may not be removed.
    """
    if not folder.is_dir():
        return
    for holder in folder.glob(f"{TEMPORARY}[0-9]*-*"):
        if holder.is_dir() and not holder.is_symlink() and _is_abandoned(holder):
            with contextlib.suppress(OSError):
                _finish_replacing(holder, folder)
            shutil.rmtree(holder, ignore_errors=True)


def is_vacant(folder: Path) -> bool:
    """Whether a folder holds nothing of the user's."""
    return all(entry.name.startswith(TEMPORARY) for entry in folder.iterdir())


def check_writable(folder: Path) -> None:
    """Find out before long work whether something can be written in a folder that is there.

    Raises:
        InputError: If it cannot; the message says why and what to do.
    """
    try:
        with hidden_folder(folder / TEMPORARY):
            pass
    except OSError as error:
        reason = str(error).partition(": ")[2] or str(error)
        raise InputError(f"{folder}: {reason}") from error


def sync(path: Path) -> None:
    """Wait until the disk has a file, or the names in a folder.

    Raises:
        OSError: If the disk does not take it.
    """
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        # Some file systems know no such thing for folders.
        if error.errno not in (errno.EINVAL, errno.ENOTSUP) or not path.is_dir():
            raise
    finally:
        os.close(handle)


def sync_tree(folder: Path) -> None:
    """Wait until the disk has a folder with everything in it."""
    for parent, _, files in os.walk(folder):
        for name in files:
            sync(Path(parent) / name)
        sync(Path(parent))


def replace_folder(new: Path, target: Path, aside: Path) -> None:
    """Rename `new` to `target`; what was there before goes to `aside`."""
    if not target.exists():
        new.replace(target)
        return
    if aside == new:  # the target itself is called "previous"
        aside = aside.with_name(_PREVIOUS[1])
    try:
        target.replace(aside)
        new.replace(target)
    except BaseException:  # Ctrl-C between the two too: what is aside would be gone
        if aside.exists() and not target.exists():
            aside.replace(target)
        raise


def _finish_replacing(holder: Path, folder: Path) -> None:
    """Do the second rename of `replace_folder`, if its process was killed before it."""
    names = {entry.name for entry in holder.iterdir()}
    aside = _PREVIOUS[1] if _PREVIOUS[1] in names else _PREVIOUS[0]
    new = names - {aside}
    if aside in names and len(new) == 1:
        name = new.pop()
        if not (folder / name).exists():
            (holder / name).replace(folder / name)


def _locked(holder: Path) -> int:
    """A handle of the folder, with a lock on it where there are locks."""
    handle = os.open(holder, os.O_RDONLY)
    try_lock(handle)
    return handle


def _is_abandoned(holder: Path) -> bool:
    """Whether the process that made a hidden folder has ended."""
    try:
        handle = os.open(holder, os.O_RDONLY)
    except OSError:
        return False
    try:
        if try_lock(handle) == "held":
            return False
    finally:
        os.close(handle)
    number = holder.name.removeprefix(TEMPORARY).partition("-")[0]
    if not (number.isdecimal() and is_running(int(number))):
        return True
    return time.time() - holder.stat().st_mtime > _CERTAINLY_ABANDONED


def is_running(process: int) -> bool:
    """Whether a process of this number runs on this machine."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def _checked_target(path: str | os.PathLike[str]) -> Path:
    """The path as written, symlinks followed, after a check that its folder is there."""
    target = Path(path)
    if target.is_symlink():  # replace what the link points to, not the link
        target = target.resolve()
    if not target.parent.is_dir():
        raise MissingFileError(
            f"{target}: expected an existing folder to write in, but {target.parent} is missing."
        )
    return target
