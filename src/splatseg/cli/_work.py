"""What commands share: who is told of the work, and how its result is printed."""

import json
import shlex
import sys
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.text import Text
from typing_extensions import override

from splatseg.cli._fit_progress import fit_progress, pose_progress
from splatseg.cli._progress import progress
from splatseg.cli._streams import tell
from splatseg.core import Scene
from splatseg.errors import visible
from splatseg.fit import FitProgress
from splatseg.io.scene import load_scene
from splatseg.pose import PoseProgress
from splatseg.tasks import Observer


def open_scene(root: Path, data: Path | None) -> Scene:
    """The scene that a command works on."""
    return load_scene(root, data=data)


def typed(words: Sequence[str]) -> str:
    """The command line; nothing where the command was called from Python."""
    name = Path(words[0]).name if words else ""
    if name not in ("splatseg", "__main__.py"):
        return ""
    return shlex.join(["splatseg", *words[1:]])


def print_result(facts: Mapping[str, Any], lines: Sequence[str], *, json: bool) -> None:
    """Print what was made: one JSON object, or lines for people.

    Args:
        facts: What was made, in values that JSON holds; paths become their text.
        lines: The same in sentences.
        json: Which of the two.
    """
    sys.stdout.write(_json_line(facts) if json else "".join(f"{visible(line)}\n" for line in lines))
    sys.stdout.flush()


def plain(value: object) -> Text:
    """A value as a table of the terminal shows it: brackets in names are no markup."""
    return Text(visible(str(value)))


def _json_line(facts: Mapping[str, Any]) -> str:
    return json.dumps(facts, allow_nan=False, default=_path_text) + "\n"


def _path_text(value: object) -> str:
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"expected a value that JSON holds, got {type(value).__name__}.")


class ConsoleObserver(Observer):
    """Shows progress and notes on stderr, and what was found on stdout.

    Args:
        quiet: Show nothing.
        json: Stdout is for one JSON object: what was found goes to stderr too.
    """

    def __init__(self, *, quiet: bool = False, json: bool = False) -> None:
        self._quiet = quiet
        self._json = json

    @override
    @contextmanager
    def stage(self, stage: str) -> Generator[Callable[[int, int], None]]:
        """A bar or lines for the stage."""
        with progress(stage, quiet=self._quiet) as step:
            yield step

    @override
    @contextmanager
    def fit_stage(self) -> Generator[Callable[[FitProgress], None]]:
        """With loss and PSNR."""
        if self._quiet:
            yield _nothing
            return
        with fit_progress() as step:
            yield step

    @override
    @contextmanager
    def pose_stage(self) -> Generator[Callable[[PoseProgress], None]]:
        """With the names of its parts."""
        if self._quiet:
            yield _nothing
            return
        with pose_progress() as step:
            yield step

    @override
    def note(self, message: str) -> None:
        """A line of its own on stderr."""
        if not self._quiet:
            tell(sys.stderr, f"note: {visible(message)}\n")

    @override
    def info(self, message: str) -> None:
        """A line of its own."""
        if not self._quiet:
            tell(sys.stderr if self._json else sys.stdout, f"{visible(message)}\n")


def _nothing(now: object) -> None:
    """Where nobody wants to know."""
