"""What the system says when something cannot be written, as a sentence that says what to do."""

import errno
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from splatseg.errors import OutputError, SplatsegError

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
