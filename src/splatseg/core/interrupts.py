"""Ctrl-C, SIGTERM and SIGHUP are deferred until long work is between two steps."""

import signal
import threading
from collections.abc import Generator
from contextlib import contextmanager
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else []))
# This signal interrupts at once: the step in progress may never end.
_MAX_REQUESTS = 3


class Interrupts:
    """Counts the requests to stop."""

    def __init__(self) -> None:
        self._count = 0

    @property
    def requested(self) -> bool:
        """Whether there was a request."""
        return self._count > 0

    @property
    def forced(self) -> bool:
        """Whether there were so many requests that nothing further should be started."""
        return self._count >= _MAX_REQUESTS

    def receive(self, number: int, frame: FrameType | None) -> None:
        """The signal handler."""
        self._count += 1
        if self.forced:
            raise KeyboardInterrupt


_active: list[Interrupts] = []


@contextmanager
def deferred_interrupts() -> Generator[Interrupts]:
    """Record these signals while the block runs; the third raises `KeyboardInterrupt`.

    A SIGTERM or SIGHUP that is ignored, as by ``nohup``, stays so. A nested block shares the
    requests of the outer one. Outside the main thread, which alone receives signals, nothing is
    recorded. The block itself decides how to stop.
    """
    if _active:
        yield _active[-1]
        return
    interrupts = Interrupts()
    if threading.current_thread() is not threading.main_thread():
        yield interrupts
        return
    before = {number: signal.getsignal(number) for number in _SIGNALS}
    for number in _SIGNALS[1:]:
        if before[number] == signal.SIG_IGN:
            del before[number]
    _active.append(interrupts)
    try:
        for number in before:
            signal.signal(number, interrupts.receive)
        yield interrupts
    finally:
        for number, handler in before.items():
            # None is a handler that Python did not install and cannot restore.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        _active.remove(interrupts)
