"""Checkpoints of a training: read to resume, written when they are due."""

import time
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from typing import Any

from splatseg.core.checkpoints import Checkpoints, CheckpointSchedule, without_checkpoint
from splatseg.errors import OutputError
from splatseg.lift.training._state import TrainingState, read_state, write_state


class TrainingFile:
    """The file in which a training keeps its state.

    Args:
        checkpoints: Where and how often.
        identity: What the training is of, see `read_state`.
    """

    def __init__(self, checkpoints: Checkpoints, identity: Mapping[str, Any]) -> None:
        self._checkpoints = checkpoints
        self._identity = identity
        self._schedule = CheckpointSchedule(checkpoints)
        self._written: int | None = None

    @property
    def at_end(self) -> bool:
        """Whether one is wanted of the finished training."""
        return self._checkpoints.at_end

    def saved(self, start: TrainingState) -> TrainingState:
        """The state to begin with: the saved one where that is asked for and there is one.

        Args:
            start: The training before its first step.

        Raises:
            InputError: If the checkpoint is of another training.
            FileFormatError: If it is damaged.
        """
        path = self._checkpoints.path
        if not (self._checkpoints.resume and path.is_file()):
            return start
        state = read_state(path, start, self._identity)
        self._checkpoints.resumed()
        self._written = state.step
        return state

    def due(self, state: TrainingState) -> bool:
        """Whether a checkpoint is due."""
        return self._schedule.due(state.step)

    def write(self, state: TrainingState) -> None:
        """Write a checkpoint, unless the file has this step already, or tell that it cannot be."""
        if self._written == state.step:
            return
        begin = time.monotonic()
        try:
            write_state(state, self._checkpoints.path, self._identity)
            self._written = state.step
        except OutputError as error:
            self._checkpoints.failed(without_checkpoint(error))
        self._schedule.written(time.monotonic() - begin)

    @contextmanager
    def written_on_error(self, state: TrainingState) -> Generator[None]:
        """Write a checkpoint if the block raises, whatever it is."""
        passed = False
        try:
            yield
            passed = True
        finally:
            if not passed:
                self.write(state)
