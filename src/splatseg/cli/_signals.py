"""SIGTERM and a closed terminal end a command as Ctrl-C does: what it does is left in order."""

import signal
import threading
from collections.abc import Generator
from contextlib import contextmanager
from types import FrameType

_SIGNALS = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if getattr(signal, name, None)]


@contextmanager
def interrupted_by_signals() -> Generator[None]:
    """Raise `KeyboardInterrupt` where these signals would end the process at once.

    One that is ignored, as by ``nohup``, stays so. Work that answers signals itself does.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    changed = [number for number in _SIGNALS if signal.getsignal(number) == signal.SIG_DFL]
    for number in changed:
        signal.signal(number, _interrupt)
    try:
        yield
    finally:
        for number in changed:
            signal.signal(number, signal.SIG_DFL)


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt
