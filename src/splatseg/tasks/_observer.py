"""Who is told what a task does: progress, remarks, and the chance to stop it."""

from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from splatseg.fit import FitProgress
    from splatseg.pose import PoseProgress


class Observer:
    """Hears nothing. A command line, a notebook or a server overrides what it wants to hear.

    A task calls every method from the thread that it runs in. An exception raised by any of
    them ends the task, and is how a task is cancelled: what a task writes appears whole or not
    at all, and work that can be resumed is left so that it can.
    """

    def started(self, stage: str) -> None:
        """A stage of the work begins, such as ``render``."""

    def progress(self, stage: str, done: int, total: int) -> None:
        """So many of so many steps of a stage are done; of 0 where the number is not known."""

    def finished(self, stage: str) -> None:
        """A stage has ended, by an exception too."""

    def note(self, message: str) -> None:
        """Something a person should know; a sentence without a full stop."""

    def info(self, message: str) -> None:
        """What was found or decided on the way; a line without a full stop."""

    @contextmanager
    def stage(self, stage: str) -> Generator[Callable[[int, int], None]]:
        """Tell of a stage from its start to its end; gives a function of (done, total)."""
        self.started(stage)
        try:
            yield lambda done, total: self.progress(stage, done, total)
        finally:
            self.finished(stage)

    @contextmanager
    def fit_stage(self) -> Generator["Callable[[FitProgress], None]"]:
        """The stage ``fit``, for who wants the loss and the number of Gaussians as well."""
        with self.stage("fit") as step:
            yield lambda now: step(round(1000 * now.progress), 1000)

    @contextmanager
    def pose_stage(self) -> Generator["Callable[[PoseProgress], None]"]:
        """The stage ``poses``, for who wants the names of its parts as well."""
        with self.stage("poses") as step:
            yield lambda now: step(now.done, now.total)


SILENT = Observer()
"""For callers that want to hear nothing."""
