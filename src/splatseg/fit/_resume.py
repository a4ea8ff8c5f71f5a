"""When a fit writes its state, and how it goes on from it."""

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

# Checkpoints take at most one part in so many of the time.
_LEAST_PAUSE = 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Checkpoints:
    """Where a fit keeps its state, and how often. None of it changes the result.

    Example:
        >>> Checkpoints(path=Path("scene/fit/checkpoint.npz"), resume=True).seconds
        60.0
    """

    path: Path
    """The file. Its folder is made when the first is written."""

    seconds: float = 60.0
    """Time between two, seconds; more where writing one takes over a sixtieth of it."""

    steps: int | None = None
    """Steps between two, instead of seconds."""

    resume: bool = False
    """Go on from the file if it is there; begin if it is not."""

    at_end: bool = False
    """Write one when the fit is finished too, from which a longer one can go on."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.seconds) and self.seconds > 0):
            raise RangeError(
                f"checkpoints.seconds: expected a positive number, got {self.seconds}."
            )
        if self.steps is not None and self.steps < 1:
            raise RangeError(f"checkpoints.steps: expected at least 1, got {self.steps}.")


class CheckpointClock:
    """Says when the next checkpoint is due, and writes it.

    Args:
        checkpoints: Where and how often.
        identity: What the fit is of; see `_identity`.
    """

    def __init__(self, checkpoints: Checkpoints, *, identity: Mapping[str, Any]) -> None:
        self._checkpoints = checkpoints
        self._identity = identity
        self._due = time.monotonic() + checkpoints.seconds

    def saved(self) -> FitState | None:
        """The state to go on from; None if there is none, or the fit is to begin.

        Raises:
            FileFormatError: If the checkpoint is damaged.
            InputError: If it is of another fit.
        """
        path = self._checkpoints.path
        if not (self._checkpoints.resume and path.is_file()):
            return None
        found = read_checkpoint(path)
        check_identity(path, found.identity, self._identity)
        return found.state

    def due(self, steps: int) -> bool:
        """Whether one is to be written after so many steps."""
        if self._checkpoints.steps is not None:
            return steps % self._checkpoints.steps == 0
        return time.monotonic() >= self._due

    def write(self, state: FitState) -> float:
        """Write one now; gives the seconds it took."""
        begin = time.monotonic()
        write_checkpoint(self._checkpoints.path, Checkpoint(state=state, identity=self._identity))
        end = time.monotonic()
        self._due = end + max(self._checkpoints.seconds, _LEAST_PAUSE * (end - begin))
        return end - begin
