"""Long work: when it may be interrupted, when it writes checkpoints, when it resumes from one."""

import json
import signal
import threading
import time
import warnings
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from types import FrameType
from typing import Any, Final, cast

from splatseg.core.boundary import convert_fields
from splatseg.core.options import Count, Positive
from splatseg.errors import OutputError

_SIGNALS = (signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else []))
# This signal interrupts at once: the step in progress may never end.
_MAX_REQUESTS = 3


class Interrupts:
    """Counts the requests to stop."""

    def __init__(self) -> None:
        self._count = 0

    @property
    def requested(self) -> bool:
        """Whether there was a request."""
        return self._count > 0

    @property
    def forced(self) -> bool:
        """Whether there were so many requests that nothing further should be started."""
        return self._count >= _MAX_REQUESTS

    def receive(self, number: int, frame: FrameType | None) -> None:
        """The signal handler."""
        self._count += 1
        if self.forced:
            raise KeyboardInterrupt


_active: list[Interrupts] = []


def interrupt_requested() -> bool:
    """Whether signals are recorded now, and one has come: who waits for others ends by that."""
    return bool(_active) and _active[-1].requested


@contextmanager
def deferred_interrupts() -> Generator[Interrupts]:
    """Record these signals while the block runs; the third raises `KeyboardInterrupt`.

    A SIGTERM or SIGHUP that is ignored, as by ``nohup``, stays so. A nested block shares the
    requests of the outer one. Outside the main thread, which alone receives signals, nothing is
    recorded. The block itself decides how to stop.
    """
    if _active:
        yield _active[-1]
        return
    interrupts = Interrupts()
    if threading.current_thread() is not threading.main_thread():
        yield interrupts
        return
    before = {number: signal.getsignal(number) for number in _SIGNALS}
    for number in _SIGNALS[1:]:
        if before[number] == signal.SIG_IGN:
            del before[number]
    _active.append(interrupts)
    try:
        for number in before:
            signal.signal(number, interrupts.receive)
        yield interrupts
    finally:
        for number, handler in before.items():
            # None is a handler that Python did not install and cannot restore.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        _active.remove(interrupts)


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

    seconds: Positive = 60.0
    """Time between two checkpoints, seconds; more where writing one takes over a sixtieth of it."""

    steps: Count | None = None
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

    def write(self, save: Callable[[], None]) -> float:
        """Write one, or tell that it cannot be. Returns the seconds it took."""
        begin = time.monotonic()
        try:
            save()
        except OutputError as error:
            sentence = str(error).rstrip(".")
            self._checkpoints.failed(f"{sentence}; the work goes on, but has no checkpoint of now")
        now = time.monotonic()
        self._due = now + max(self._checkpoints.seconds, _MIN_PAUSE_RATIO * (now - begin))
        return now - begin


# Options are recorded as they stand in a file's JSON. Programs grow: an option that a record does
# not have is one that came later, and the work was done as if it had its default. An option that
# only the record has was taken away since; at its default of then it changed nothing, at any other
# value the work cannot go on as it began.


class Absent(Enum):
    """Where there is no value at all."""

    ABSENT = "no value"


ABSENT: Final = Absent.ABSENT

DIFFERENCES: Final = 240
"""Characters of a message that lists differences, whose names may be a file's."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OptionDifference:
    """An option that is not what it was."""

    name: str

    recorded: Any
    """The value that the work was begun with; `ABSENT` if it is not known."""

    wanted: Any
    """The value that is asked for; `ABSENT` where the program does not know the option."""

    @property
    def text(self) -> str:
        """The difference in words: ``seed 1 instead of 2``."""
        if self.recorded is ABSENT:
            return f"no {self.name} instead of {json.dumps(self.wanted)}"
        recorded = f"{self.name} {json.dumps(self.recorded)}"
        if self.wanted is ABSENT:
            return f"{recorded}, an option that this splatseg does not have"
        return f"{recorded} instead of {json.dumps(self.wanted)}"


def differing_names(recorded: Mapping[str, Any], wanted: Mapping[str, Any]) -> tuple[str, ...]:
    """Names of the entries that are not equal in both, in order."""
    return tuple(
        name for name in sorted({*recorded, *wanted}) if recorded.get(name) != wanted.get(name)
    )


def option_differences(
    recorded: Mapping[str, Any],
    wanted: Mapping[str, Any],
    *,
    defaults: Mapping[str, Any],
    recorded_defaults: Mapping[str, Any],
) -> tuple[OptionDifference, ...]:
    """Options that differ, by name; groups of options are looked into.

    Args:
        recorded: What the work was begun with, from JSON.
        wanted: What is asked for, in values as JSON gives them back.
        defaults: This program's: what an option counts as that is not recorded.
        recorded_defaults: Those of the program that made the record: a recorded option that this
            program does not know is no difference if it had this value.

    Example:
        >>> option_differences({"size": 3, "old": 1}, {"size": 3, "new": 7},
        ...                    defaults={"new": 7}, recorded_defaults={"old": 1})
        ()
        >>> option_differences({"size": 3}, {"size": 4}, defaults={}, recorded_defaults={})
        (OptionDifference(name='size', recorded=3, wanted=4),)
    """
    found: list[OptionDifference] = []
    for name in sorted({*recorded, *wanted}):
        before, now = recorded.get(name, ABSENT), wanted.get(name, ABSENT)
        default, old_default = defaults.get(name, ABSENT), recorded_defaults.get(name, ABSENT)
        if before is ABSENT:
            before = default
        groups = (_group(before), _group(now))
        if groups[0] is not None and groups[1] is not None:
            found += option_differences(
                groups[0],
                groups[1],
                defaults=_group(default) or {},
                recorded_defaults=_group(old_default) or {},
            )
        elif now is ABSENT and before == old_default:
            continue
        elif before != now:
            found.append(OptionDifference(name=name, recorded=before, wanted=now))
    return tuple(found)


def _group(value: object) -> Mapping[str, Any] | None:
    return cast("Mapping[str, Any]", value) if isinstance(value, Mapping) else None
