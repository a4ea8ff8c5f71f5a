"""Ctrl-C and SIGTERM wait until a fit is between two steps."""

import signal
import threading
from collections.abc import Generator
from contextlib import contextmanager
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
# The third gives up at once: whatever it is that takes so long may never end.
_PATIENCE = 3


class Interrupts:
    """How often the process was asked to stop."""

    def __init__(self) -> None:
        self._count = 0

    @property
    def requested(self) -> bool:
        """Whether it was asked at all."""
        return self._count > 0

    @property
    def impatient(self) -> bool:
        """Whether it was asked so often that nothing more should be begun."""
        return self._count >= _PATIENCE

    def receive(self, number: int, frame: FrameType | None) -> None:
        """What Python calls when a signal has come."""
        self._count += 1
        if self.impatient:
            raise KeyboardInterrupt


_active: list[Interrupts] = []


@contextmanager
def deferred_interrupts() -> Generator[Interrupts]:
    """While the block runs, SIGINT and SIGTERM are noted, not obeyed; the third raises.

    A block within a block shares what the outer one noted. Outside the main thread, which alone
    receives signals, nothing is noted. The block ends as it likes: who was asked to stop says so
    with a `KeyboardInterrupt` of its own.
    """
    if _active:
        yield _active[-1]
        return
    interrupts = Interrupts()
    if threading.current_thread() is not threading.main_thread():
        yield interrupts
        return
    before = {number: signal.getsignal(number) for number in _SIGNALS}
    _active.append(interrupts)
    try:
        for number in _SIGNALS:
            signal.signal(number, interrupts.receive)
        yield interrupts
    finally:
        for number, handler in before.items():
            # None stands for a handler that Python did not install and cannot put back.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        _active.remove(interrupts)
