"""What commands that go through views share: which views, which layer, and a progress bar."""

import sys
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from typing_extensions import override

from splatseg.core import Scene
from splatseg.errors import InputError
from splatseg.io.scene import load_scene
from splatseg.tasks import Observer


def check_new_scene(out: Path) -> None:
    """Refuse before the work a place that a new scene could not be written to after it."""
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise InputError(f"{out}: expected a new folder, got one that is there.")
    if not out.resolve().parent.is_dir():
        raise InputError(f"{out}: expected a place in a folder that is there, got none.")


@contextmanager
def progress(what: str) -> Generator[Callable[[int, int], None]]:
    """A bar on stderr with an estimate; gives a function of (done, total)."""
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


def open_scene(root: Path, data: Path | None) -> Scene:
    """The scene that a command works on."""
    return load_scene(root, data=data)


def typed(words: Sequence[str]) -> str:
    """The command line; nothing where the command was called from Python."""
    name = Path(words[0]).name if words else ""
    if name not in ("splatseg", "__main__.py"):
        return ""
    return " ".join(["splatseg", *words[1:]])


class ConsoleObserver(Observer):
    """Shows progress on stderr and writes notes to stdout."""

    @override
    @contextmanager
    def stage(self, stage: str) -> Generator[Callable[[int, int], None]]:
        """A bar for the stage."""
        with progress(stage) as step:
            yield step

    @override
    def note(self, message: str) -> None:
        """A line of its own."""
        sys.stdout.write(f"note: {message}\n")
