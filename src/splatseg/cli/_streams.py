"""Standard output and error, of which nobody knows who reads them, or whether anybody does."""

import contextlib
import io
import os
import signal
import sys
import threading
from collections.abc import Generator
from contextlib import contextmanager
from types import FrameType
from typing import TextIO


def prepare_streams() -> None:
    """Give a process that was started with closed streams some that lead nowhere.

    And names of files that the terminal's encoding has no letters for are shown with escapes.
    """
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            # Otherwise the next file that is opened becomes the standard output.
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115, PTH123
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def tell(stream: TextIO, text: str) -> None:
    """Write what is worth no failure: that nobody reads it does not end the work."""
    try:
        stream.write(text)
        stream.flush()
    except BrokenPipeError:
        silence(stream)


def silence(stream: TextIO) -> None:
    """Let a stream lead nowhere from now on; the interpreter flushes it once more at its end."""
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


# SIGTERM and a closed terminal end a command as Ctrl-C does: what it does is left in order.


_SIGNALS = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if getattr(signal, name, None)]


@contextmanager
def interrupted_by_signals() -> Generator[list[int]]:
    """Raise `KeyboardInterrupt` where these signals would end the process at once.

    One that is ignored, as by ``nohup``, stays so. Work that answers signals itself does. Gives
    the list of those that came, Ctrl-C among them: an import that it breaks off may fail in
    another way.
    """
    came: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield came
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        came.append(number)
        raise KeyboardInterrupt

    usual = (signal.SIG_DFL, signal.default_int_handler)
    before = {number: signal.getsignal(number) for number in (*_SIGNALS, signal.SIGINT)}
    changed = {number: handler for number, handler in before.items() if handler in usual}
    for number in changed:
        signal.signal(number, interrupt)
    try:
        yield came
    finally:
        for number, handler in changed.items():
            signal.signal(number, handler)
