"""When long work writes checkpoints, and whether it goes on from one."""

import math
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from splatseg.core.boundary import convert_fields
from splatseg.errors import RangeError

# The pause is at least this many times the time that writing a checkpoint took.
_MIN_PAUSE_RATIO = 60.0


class CheckpointWarning(UserWarning):
    """A checkpoint could not be written; the work goes on without it."""


def _warn(sentence: str) -> None:
    warnings.warn(sentence, CheckpointWarning, stacklevel=2)


def _nothing() -> None:
    """Where nobody wants to know."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Checkpoints:
    """Where work writes checkpoints, and how often. The result does not depend on it.

    Example:
        >>> Checkpoints(path=Path("scene/fit/checkpoint.npz"), resume=True).seconds
        60.0
    """

    path: Path
    """The file. Its folder is created with the first checkpoint."""

    seconds: float = 60.0
    """Time between two checkpoints, seconds; more where writing one takes over a sixtieth of it."""

    steps: int | None = None
    """Steps between two checkpoints, instead of seconds."""

    resume: bool = False
    """Resume from the file if it exists; begin anew if it does not."""

    at_end: bool = False
    """Write one at the end too: from it a fit can be made longer, and what follows a training
    can be done again."""

    resumed: Callable[[], None] = _nothing
    """Called when the work goes on from the file, after it was found to be of this work."""

    failed: Callable[[str], None] = _warn
    """Told in a sentence that a checkpoint could not be written; the one before is still there,
    and the work goes on. The default is a `CheckpointWarning`."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if not (math.isfinite(self.seconds) and self.seconds > 0):
            raise RangeError(
                f"checkpoints.seconds: expected a positive number, got {self.seconds}."
            )
        if self.steps is not None and self.steps < 1:
            raise RangeError(f"checkpoints.steps: expected at least 1, got {self.steps}.")


def without_checkpoint(error: Exception) -> str:
    """The sentence about a checkpoint that could not be written."""
    return f"{str(error).rstrip('.')}; the work goes on, but has no checkpoint of now"


class CheckpointSchedule:
    """Tracks when the next checkpoint is due.

    Args:
        checkpoints: How often.
    """

    def __init__(self, checkpoints: Checkpoints) -> None:
        self._checkpoints = checkpoints
        self._due = time.monotonic() + checkpoints.seconds

    def due(self, steps: int) -> bool:
        """Whether a checkpoint is due after this many steps."""
        if self._checkpoints.steps is not None:
            return steps % self._checkpoints.steps == 0
        return time.monotonic() >= self._due

    def written(self, seconds: float) -> None:
        """One has just been written, which took so many seconds."""
        pause = max(self._checkpoints.seconds, _MIN_PAUSE_RATIO * seconds)
        self._due = time.monotonic() + pause
