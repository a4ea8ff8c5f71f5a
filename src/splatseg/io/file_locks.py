"""Locks of the operating system on open files: they end with their process, however it ends."""

from typing import Literal

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

Lock = Literal["taken", "held", "unknown"]
"""We have it now; another one has it; the file system or the system has no such locks."""


def try_lock(handle: int, *, shared: bool = False) -> Lock:
    """Lock an open file or folder without waiting; closing the handle gives it back.

    Args:
        handle: Its descriptor.
        shared: Others may have it at the same time, if theirs is shared too.
    """
    if fcntl is None:
        return "unknown"
    try:
        fcntl.flock(handle, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return "held"
    except OSError:
        return "unknown"
    return "taken"
