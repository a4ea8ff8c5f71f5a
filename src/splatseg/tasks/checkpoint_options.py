"""How long work is kept while it goes on, and whether it goes on from what was kept."""

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from splatseg.core.boundary import convert_fields
from splatseg.core.checkpoints import Checkpoints
from splatseg.errors import InputError
from splatseg.tasks._observer import Observer


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckpointOptions:
    """How work that was stopped goes on: a fit, or a method that trains."""

    resume: bool = False
    """Go on with what was stopped, with the same data and options. The result is that of work
    that was never stopped."""

    overwrite: bool = False
    """Begin again what was stopped."""

    checkpoint_every: float = 60.0
    """Seconds between two checkpoints, from which `resume` goes on."""

    checkpoint_steps: int | None = None
    """Steps between two checkpoints, instead of seconds."""

    def __post_init__(self) -> None:
        convert_fields(self)
        every = self.checkpoint_every
        if not (math.isfinite(every) and every > 0):
            raise InputError(f"checkpoint_every: expected a positive number, got {every}.")
        if self.checkpoint_steps is not None and self.checkpoint_steps < 1:
            raise InputError(f"checkpoint_steps: expected at least 1, got {self.checkpoint_steps}.")

    def check_not_both(self) -> None:
        """Refuse to go on and to begin again.

        Raises:
            InputError: If both are asked for.
        """
        if self.resume and self.overwrite:
            raise InputError("resume, overwrite: expected one of the two, got both.")

    def checkpoints(
        self, path: Path, *, at_end: bool, observer: Observer, onwards: str | None = None
    ) -> Checkpoints:
        """The same for the work itself.

        Args:
            path: Where checkpoints are written.
            at_end: Whether the finished work leaves one, too.
            observer: Is told of a checkpoint that cannot be written.
            onwards: What the observer is told when the work goes on from one.
        """
        told = {} if onwards is None else {"resumed": partial(observer.info, onwards)}
        return Checkpoints(
            path=path,
            seconds=self.checkpoint_every,
            steps=self.checkpoint_steps,
            resume=self.resume,
            at_end=at_end,
            failed=observer.note,
            **told,
        )
