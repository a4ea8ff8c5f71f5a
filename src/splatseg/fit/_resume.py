"""When a fit writes checkpoints, and how it resumes."""

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatseg.errors import RangeError
from splatseg.fit._checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from splatseg.fit._identity import check_identity
from splatseg.fit._state import FitState

# The pause is at least this many times the time that writing a checkpoint took.
_MIN_PAUSE_RATIO = 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Checkpoints:
    """Where a fit writes checkpoints, and how often. The result does not depend on it.

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
    """Resume from the file if it exists; start a new fit if it does not."""

    at_end: bool = False
    """Write one at the end of the fit too, from which a longer fit can resume."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.seconds) and self.seconds > 0):
            raise RangeError(
                f"checkpoints.seconds: expected a positive number, got {self.seconds}."
            )
        if self.steps is not None and self.steps < 1:
            raise RangeError(f"checkpoints.steps: expected at least 1, got {self.steps}.")


class CheckpointClock:
    """Tracks when the next checkpoint is due, and writes it.

    Args:
        checkpoints: Where and how often.
        identity: Identity of the fit; see `_identity`.
    """

    def __init__(self, checkpoints: Checkpoints, *, identity: Mapping[str, Any]) -> None:
        self._checkpoints = checkpoints
        self._identity = identity
        self._due = time.monotonic() + checkpoints.seconds

    def saved(self) -> FitState | None:
        """The state to resume from; None if there is none, or a new fit was asked for.

        Raises:
            FileFormatError: If the checkpoint is damaged.
            InputError: If it belongs to another fit.
        """
        path = self._checkpoints.path
        if not (self._checkpoints.resume and path.is_file()):
            return None
        found = read_checkpoint(path)
        check_identity(path, found.identity, self._identity)
        return found.state

    def due(self, steps: int) -> bool:
        """Whether a checkpoint is due after this many steps."""
        if self._checkpoints.steps is not None:
            return steps % self._checkpoints.steps == 0
        return time.monotonic() >= self._due

    def write(self, state: FitState) -> float:
        """Write a checkpoint. Returns the seconds it took."""
        begin = time.monotonic()
        write_checkpoint(self._checkpoints.path, Checkpoint(state=state, identity=self._identity))
        end = time.monotonic()
        self._due = end + max(self._checkpoints.seconds, _MIN_PAUSE_RATIO * (end - begin))
        return end - begin
