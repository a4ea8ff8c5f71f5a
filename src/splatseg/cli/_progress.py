"""Progress on stderr: a bar in a terminal, a plain line every ten seconds in a log."""

import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from splatseg.cli._streams import tell

SECONDS_BETWEEN_LINES = 10.0
"""At most one line in this time: enough to see that something goes on, few enough for a log."""


class ProgressLines:
    """Writes how far some work is, where a bar cannot be redrawn.

    The first line comes when the work has taken as long as there is between two lines, so that
    short work writes none.

    Args:
        what: The work, in a word or two; each line begins with it.
        write: Called with each line, its line feed included.
        clock: Gives seconds.
    """

    def __init__(
        self,
        what: str,
        *,
        write: Callable[[str], object],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._what = what
        self._write = write
        self._clock = clock
        self._begin = self._last = clock()
        self._first: float | None = None

    def show(
        self,
        done: float,
        total: float | None,
        *,
        text: str | None = None,
        seconds_left: float | None = None,
    ) -> None:
        """Take note of how far the work is; a line is written if it is time.

        Args:
            done: How much is done.
            total: Of how much; None where that is not known.
            text: What is done, in words; None is ``DONE of TOTAL``.
            seconds_left: Estimate; None goes by the speed since the first call.
        """
        if self._first is None:
            self._first = done
        now = self._clock()
        if now - self._last < SECONDS_BETWEEN_LINES:
            return
        self._last = now
        elapsed = now - self._begin
        if text is None:
            text = f"{done:g}" if total is None else f"{done:g} of {total:g}"
        parts = [text]
        if total:
            parts.append(f"{100 * done / total:.0f} %")
            if seconds_left is None and done > self._first:
                seconds_left = elapsed * (total - done) / (done - self._first)
        parts.append(f"{_clock_time(elapsed)} elapsed")
        if seconds_left is not None:
            parts.append(f"about {_clock_time(seconds_left)} left")
        self._write(f"{self._what}: {', '.join(parts)}\n")


def _clock_time(seconds: float) -> str:
    """Minutes and seconds, with hours where there are some: 0:07, 12:30, 1:02:03."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def lines_on_stderr(what: str) -> ProgressLines | None:
    """Plain lines where stderr is no terminal; None where it is one, which shows a bar."""
    if Console(stderr=True).is_terminal:
        return None

    return ProgressLines(what, write=lambda line: tell(sys.stderr, line))


@contextmanager
def progress(what: str, *, quiet: bool = False) -> Generator[Callable[[int, int], None]]:
    """Progress of some work on stderr, with an estimate; gives a function of (done, total).

    Args:
        what: The work, in a word or two.
        quiet: Show nothing at all.
    """
    if quiet:
        yield _nothing
        return
    lines = lines_on_stderr(what)
    if lines is not None:
        yield lines.show
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(compact=True),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None)

        def step(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        yield step


def _nothing(done: int, total: int) -> None:
    """Where nobody wants to know."""
