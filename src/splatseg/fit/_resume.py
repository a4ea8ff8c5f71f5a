"""Checkpoints of a fit: read to resume, written when they are due."""

import time
from collections.abc import Mapping
from typing import Any

from splatseg.core.checkpoints import Checkpoints, CheckpointSchedule, without_checkpoint
from splatseg.errors import OutputError
from splatseg.fit._checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from splatseg.fit._identity import check_identity
from splatseg.fit._state import FitState


class CheckpointClock:
    """Tracks when the next checkpoint is due, and writes it.

    Args:
        checkpoints: Where and how often.
        identity: Identity of the fit; see `_identity`.
    """

    def __init__(self, checkpoints: Checkpoints, *, identity: Mapping[str, Any]) -> None:
        self._checkpoints = checkpoints
        self._identity = identity
        self._schedule = CheckpointSchedule(checkpoints)

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
        self._checkpoints.resumed()
        return found.state

    def due(self, steps: int) -> bool:
        """Whether a checkpoint is due after this many steps."""
        return self._schedule.due(steps)

    def write(self, state: FitState) -> float:
        """Write a checkpoint, or tell that it cannot be. Returns the seconds it took."""
        begin = time.monotonic()
        checkpoint = Checkpoint(state=state, identity=self._identity)
        try:
            write_checkpoint(checkpoint, self._checkpoints.path)
        except OutputError as error:
            self._checkpoints.failed(without_checkpoint(error))
        seconds = time.monotonic() - begin
        self._schedule.written(seconds)
        return seconds
