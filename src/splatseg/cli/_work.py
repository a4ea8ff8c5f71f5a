"""What commands that go through views share: which views, which layer, and who is told."""

import sys
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from pathlib import Path

from typing_extensions import override

from splatseg.cli._progress import progress
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
        """A bar or lines for the stage."""
        with progress(stage) as step:
            yield step

    @override
    def note(self, message: str) -> None:
        """A line of its own."""
        sys.stdout.write(f"note: {message}\n")
