"""Who is told what a task does: progress, remarks, and the chance to stop it."""

from collections.abc import Callable, Generator
from contextlib import contextmanager


class Observer:
    """Hears nothing. A command line, a notebook or a server overrides what it wants to hear.

    A task calls every method from the thread that it runs in. An exception raised by any of
    them ends the task, and is how a task is cancelled: what a task writes appears whole or not
    at all, and work that can be resumed is left so that it can.
    """

    def started(self, stage: str) -> None:
        """A stage of the work begins, such as ``render``."""

    def progress(self, stage: str, done: int, total: int) -> None:
        """So many of so many steps of a stage are done."""

    def finished(self, stage: str) -> None:
        """A stage has ended, by an exception too."""

    def note(self, message: str) -> None:
        """Something a person should know; a sentence without a full stop."""

    @contextmanager
    def stage(self, stage: str) -> Generator[Callable[[int, int], None]]:
        """Tell of a stage from its start to its end; gives a function of (done, total)."""
        self.started(stage)
        try:
            yield lambda done, total: self.progress(stage, done, total)
        finally:
            self.finished(stage)


SILENT = Observer()
"""For callers that want to hear nothing."""
