"""Observers that stop a task, and keep what they were told."""

from splatseg.tasks import Observer


class Cancelled(Exception):
    """What a caller raises out of an observer."""


class Stopping(Observer):
    """Raises when a stage has got so far; keeps what it was told."""

    def __init__(self, stage: str = "", after: int = 0, error: type[BaseException] = Cancelled):
        self.stage_to_stop, self.after, self.error = stage, after, error
        self.heard: list[str] = []
        self.calls = 0

    def started(self, stage: str) -> None:
        self.heard.append(f"started {stage}")

    def progress(self, stage: str, done: int, total: int) -> None:
        if stage != self.stage_to_stop:
            return
        self.calls += 1
        if self.calls > self.after:
            raise self.error

    def finished(self, stage: str) -> None:
        self.heard.append(f"finished {stage}")

    def note(self, message: str) -> None:
        self.heard.append(message)

    def info(self, message: str) -> None:
        self.heard.append(message)
