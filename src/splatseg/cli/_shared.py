"""What commands share: flags, progress on stderr, and how a result is printed."""

import json
import shlex
import sys
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeAlias, TypeVar

import tyro
from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text
from typing_extensions import override

from splatseg.cli._streams import tell
from splatseg.core import Executor, Scene
from splatseg.errors import InputError, visible
from splatseg.io.limits import MEMORY, memory_to_use
from splatseg.io.scene import load_scene
from splatseg.io.splats import Values
from splatseg.render import BackendName
from splatseg.tasks import ExecutorOptions, Observer, open_executor
from splatseg.tasks.work import Step

T = TypeVar("T")


def _flag(metavar: str | None, help: str, *aliases: str) -> Any:
    return tyro.conf.arg(metavar=metavar, help=help, aliases=aliases or None)


SceneFolder: TypeAlias = Annotated[Path, tyro.conf.Positional, _flag("SCENE", "The scene folder.")]

NewScene: TypeAlias = Annotated[
    Path, _flag("NEW", "Scene folder to write. It must not exist yet.", "-o")
]

NewSceneFolder: TypeAlias = Annotated[
    Path,
    _flag(
        "SCENE", "Scene folder to write. An existing scene is replaced unless it has layers.", "-o"
    ),
]

Data: TypeAlias = Annotated[
    Path | None,
    _flag(
        "CAPTURE",
        "Folder of the capture, if it was moved. Needed only to read photographs or evidence of "
        "the capture.",
    ),
]

Backend: TypeAlias = Annotated[
    BackendName,
    _flag(
        None,
        "Rendering backend: cpu, the C++ kernels; cuda; reference, slow and plain Python. auto: "
        "cuda for Gaussians on a GPU, else cpu.",
    ),
]

Field: TypeAlias = Annotated[
    str | None,
    _flag("NAME", "Field of the scene, made by street, instead of the Gaussians and their layers."),
]

Seed: TypeAlias = Annotated[int, _flag("N", "Seed of all random choices.")]

Format: TypeAlias = Annotated[
    str,
    _flag(
        "NAME",
        "Layout of the capture: auto, nerfstudio, blender, colmap, llff, idr, replica, scannet, "
        "scannetpp, kitti360 or waymo. auto takes the first of these that is found.",
    ),
]

Strict: TypeAlias = Annotated[
    bool,
    _flag(
        None,
        "Refuse a splat file with Gaussians that cannot be rendered (NaN, infinite), and a capture "
        "with photographs that are missing, unreadable, of another shape than their intrinsics or "
        "mask or with an impossible pose, or with start points that are not finite. Without it "
        "they are left out and counted or named, as long as a Gaussian and half of the photographs "
        "remain.",
    ),
]

Linear: TypeAlias = Annotated[
    tuple[Values, ...],
    _flag(
        "VALUES",
        "Values of a PLY file that are stored as they are, where 3DGS stores logs and logits: "
        "scales, opacities.",
    ),
]

Overwrite: TypeAlias = Annotated[
    bool, _flag(None, "Replace what an earlier run wrote under the same name.")
]

Memory: TypeAlias = Annotated[
    str | None,
    _flag(
        "SIZE",
        "Memory that Gaussians of a scene in chunks may take, such as 8GB: those of one view with "
        "what rendering makes of them, or of one stretch that is written. Layers, 4 to 80 bytes a "
        "Gaussian, come on top. Default: half of the machine's.",
    ),
]

Frames: TypeAlias = Annotated[int, _flag("N", "Number of views of a path.")]

Json: TypeAlias = Annotated[
    bool, _flag(None, "Print the result as one JSON object, and nothing else, to stdout.")
]

Quiet: TypeAlias = Annotated[
    bool, _flag(None, "Show no progress and no notes; results and errors are still printed.")
]

Downloads: TypeAlias = Annotated[
    bool, _flag(None, "Download missing weights; their names and sizes are printed first.")
]

Device: TypeAlias = Annotated[
    str, _flag("NAME", "Device of the models: cpu, cuda, cuda:1. auto takes cuda if available.")
]


@dataclass(frozen=True, kw_only=True)
class Printing:
    """A command that prints a result, and the progress of its work."""

    json: Json = False
    quiet: Quiet = False

    @property
    def observer(self) -> "ConsoleObserver":
        """Shows the progress."""
        return ConsoleObserver(quiet=self.quiet, json=self.json)


@dataclass(frozen=True, kw_only=True)
class OnScene(Printing):
    """A command that works on a scene."""

    scene: SceneFolder
    backend: Backend = "auto"
    data: Data = None

    def open(self) -> Scene:
        """The scene."""
        return load_scene(self.scene, data=self.data)

    def open_streamed(self, memory: str | None, *, level: int = 0) -> Scene:
        """The scene, for a command that streams one in chunks.

        Args:
            memory: What ``--memory`` says.
            level: A coarser level of one in chunks.

        Raises:
            InputError: If memory or a level is given for a scene that is not in chunks.
        """
        scene = load_scene(self.scene, data=self.data, memory=memory_to_use(memory), level=level)
        if memory is not None and scene.gaussians.chunks is None:
            raise InputError(
                f"{MEMORY}: goes with a scene in chunks, and {self.scene} is read as a whole; "
                "`splatseg chunks SCENE -o NEW` makes one."
            )
        return scene


@dataclass(frozen=True, kw_only=True)
class OnViews(OnScene):
    """A command that works on the views of a scene, each by itself."""

    executing: tyro.conf.OmitArgPrefixes[ExecutorOptions] = field(default_factory=ExecutorOptions)
    """Where views are worked on."""

    def open_executor(self) -> AbstractContextManager[Executor]:
        """What works on them."""
        return open_executor(self.executing, observer=self.observer)


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
        self._first: int | None = None

    def show(self, done: int, total: int, text: str = "") -> None:
        """Take note of how far the work is; a line is written if it is time.

        Args:
            done: How much is done.
            total: Of how much; 0 where that is not known, and nothing can be estimated.
            text: What is done, in words; empty is ``DONE of TOTAL``.
        """
        if self._first is None:
            self._first = done
        now = self._clock()
        if now - self._last < SECONDS_BETWEEN_LINES:
            return
        self._last = now
        elapsed = now - self._begin
        parts = [text or (f"{done} of {total}" if total else f"{done}")]
        if total:
            parts.append(f"{100 * done / total:.0f} %")
        parts.append(f"{_clock_time(elapsed)} elapsed")
        if total and done > self._first:
            left = elapsed * (total - done) / (done - self._first)
            parts.append(f"about {_clock_time(left)} left")
        self._write(f"{self._what}: {', '.join(parts)}\n")


def _clock_time(seconds: float) -> str:
    """Minutes and seconds, with hours where there are some: 0:07, 12:30, 1:02:03."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


@contextmanager
def progress(what: str, *, quiet: bool = False) -> Generator[Step]:
    """Progress of some work on stderr, with an estimate; gives a function of (done, total, text).

    A bar where stderr is a terminal, else plain lines.

    Args:
        what: The work, in a word or two.
        quiet: Show nothing at all.
    """
    if quiet:
        yield lambda done, total, text="": None
        return
    console = Console(stderr=True)
    if not console.is_terminal:
        yield ProgressLines(what, write=lambda line: tell(sys.stderr, line)).show
        return
    columns = (
        TextColumn(what),
        BarColumn(bar_width=24),
        TextColumn("{task.description}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(compact=True),
    )
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("", total=None)

        def show(done: int, total: int, text: str = "") -> None:
            words = text or f"{done}/{total}"
            bar.update(task, description=words, completed=done, total=total or None)

        yield show


def named_model(command: Any, option: str, protocol: type[T], does: str) -> T | None:
    """The model that an option of a command names, see `model_for`; None where it names none.

    The command has `Downloads` and `Device` as ``download`` and ``device``.
    """
    from splatseg.tasks.see import model_for  # here: most commands need no models

    named = getattr(command, option)
    if named is None:
        return None
    return model_for(
        option,
        named,
        protocol,
        does,
        download=command.download,
        device=command.device,
        report=command.observer.note,
    )


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
    def stage(self, stage: str) -> Generator[Step]:
        """A bar or lines for the stage."""
        with progress(stage, quiet=self._quiet) as step:
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
