"""The command line: `splatseg COMMAND ...`.

Each command is a frozen dataclass `Command` of a module of this package (tyro turns its fields into
flags and the strings under them into help) and a function ``run(command)``. The table below is all
that ``splatseg --help`` reads, so the list of commands appears without importing torch.

Exit status: 0 done, 2 bad input or usage, 1 everything else, Ctrl-C included.
"""

import difflib
import errno
import importlib
import re
import sys
from collections.abc import Collection, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Any

from splatseg.cli._streams import interrupted_by_signals, prepare_streams, silence, tell
from splatseg.cli._words import default_config, option_names, stored_page, with_flags
from splatseg.errors import InputError, MissingPackageError, SplatsegError, visible

_MAX_UNPACKED = re.compile("--max-unpacked(=.*)?")

EXIT_DONE = 0
EXIT_FAILED = 1
EXIT_USAGE = 2


@dataclass(frozen=True, slots=True)
class CommandEntry:
    """One row of the table of commands."""

    module: str
    """The module that holds `Command` and `run`."""

    summary: str
    """What the command does, in one line of the top-level help."""

    part: str = ""
    """Where a module holds two commands: of ``part`` these are `PartCommand` and `run_part`."""

    def kind_for(self, words: Sequence[str]) -> tuple[type[Any], tuple[Any, ...]]:
        """The class of the command for its words, and how tyro reads its fields."""
        module: Any = importlib.import_module(self.module)
        # A command whose flags depend on its words makes its type from them.
        command_for = getattr(module, "command_for", None)
        if command_for is None:
            kind = getattr(module, f"{self.part.title()}Command")
        else:
            kind = command_for(words)
        return kind, getattr(module, "CONFIG", None) or default_config()

    def run(self, command: object) -> None:
        """Do what the parsed command says."""
        module: Any = importlib.import_module(self.module)
        getattr(module, f"run_{self.part}" if self.part else "run")(command)


COMMANDS: dict[str, CommandEntry] = {
    "demo": CommandEntry(
        "splatseg.cli.demo", "the whole pipeline on a generated room, nothing to download"
    ),
    "info": CommandEntry(
        "splatseg.cli.info", "contents of a capture, a splat file or a scene folder"
    ),
    "fit": CommandEntry("splatseg.cli.fit", "photographs and start points -> Gaussians"),
    "import": CommandEntry(
        "splatseg.cli.fit",
        "any splat file, with or without photographs -> a scene",
        part="import",
    ),
    "chunks": CommandEntry(
        "splatseg.cli.chunks",
        "a scene or PLY file larger than memory -> a scene that is streamed from the disk",
    ),
    "doctor": CommandEntry(
        "splatseg.cli.info",
        "faults in a capture's cameras and points, and a corrected copy",
        part="doctor",
    ),
    "see": CommandEntry(
        "splatseg.cli.see",
        "a 2D model, or predictions recorded elsewhere -> evidence of the photographs",
    ),
    "segment": CommandEntry(
        "splatseg.cli.segment", "evidence (label maps, masks, features) -> a layer of the scene"
    ),
    "street": CommandEntry(
        "splatseg.cli.street", "a drive -> a mesh field with classes, and labels of laser points"
    ),
    "select": CommandEntry(
        "splatseg.cli.select", "clicks, boxes, strokes, masks, words -> a selection of Gaussians"
    ),
    "query": CommandEntry(
        "splatseg.cli.query", "words -> the objects that answer, with probabilities"
    ),
    "view": CommandEntry(
        "splatseg.cli.view", "a scene in the browser: look, click, name objects, export them"
    ),
    "render": CommandEntry(
        "splatseg.cli.render", "pictures, depth and label maps of a scene's views"
    ),
    "evaluate": CommandEntry(
        "splatseg.cli.evaluate", "score a layer against label maps of held-out views"
    ),
    "edit": CommandEntry(
        "splatseg.cli.edit",
        "objects removed, extracted, copied, moved, coloured, merged -> a new scene",
    ),
    "sharpen": CommandEntry(
        "splatseg.cli.edit",
        "Gaussians moved to one side of a layer's boundaries -> a new scene",
        part="sharpen",
    ),
    "export": CommandEntry(
        "splatseg.cli.export", "a scene and its labels as files that other tools read"
    ),
    "attach": CommandEntry(
        "splatseg.cli.export",
        "labels transferred to splats that an editor cropped, moved or rounded",
        part="attach",
    ),
    "completion": CommandEntry(
        "splatseg.cli.completion",
        "a script that completes commands and flags in bash, zsh or fish",
    ),
}
"""Every command of this distribution, in the order of the work."""

ENTRY_POINT_GROUP = "splatseg.commands"
"""Where other distributions register commands: a name and its `CommandEntry`."""

_ELSEWHERE = {"bench": "splatseg-bench"}
"""Commands of other distributions of this project."""


def find_commands() -> dict[str, CommandEntry]:
    """All commands: those of this distribution, then those of other installed ones.

    Raises:
        MissingPackageError: If an installed distribution registers a command that cannot be loaded.
    """
    found = dict(COMMANDS)
    for point in sorted(entry_points(group=ENTRY_POINT_GROUP), key=lambda point: point.name):
        if point.name in found:  # nobody replaces a command of splatseg
            continue
        try:
            entry: object = point.load()
        except (ImportError, AttributeError) as error:
            raise MissingPackageError(
                f"command {point.name!r} ({point.value}) cannot be loaded: {error}."
            ) from error
        if not isinstance(entry, CommandEntry):
            raise InputError(
                f"command {point.name!r} ({point.value}): expected a splatseg.cli.CommandEntry, "
                f"got {type(entry).__name__}."
            )
        found[point.name] = entry
    return found


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command line and return its exit status.

    Args:
        argv: The words after ``splatseg``; the process's own when None.

    Returns:
        0 when the command was carried out; 2 when the words or the input cannot be used; 1 for
        everything else. Errors are one line on the standard error stream; ``--debug`` anywhere
        among the words adds the traceback, ``--max-unpacked SIZE`` raises `io.limits`.

    Example:
        >>> main(["--version"])
        splatseg 0.2.0
        0
    """
    words = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in words
    if debug:
        words = [word for word in words if word != "--debug"]
    prepare_streams()
    signals: list[int] = []
    try:
        with interrupted_by_signals() as signals, _unpacking(words) as words:
            status = _dispatch(words)
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader of our output went away (`splatseg info X | head -1`).
        silence(sys.stdout)
        return EXIT_FAILED
    except KeyboardInterrupt as error:
        how = f": {error}" if error.args else ""
        tell(sys.stderr, f"interrupted{visible(how)}\n")
        return EXIT_FAILED
    except InputError as error:
        return _report(error, str(error), status=EXIT_USAGE, debug=debug)
    except SplatsegError as error:
        return _report(error, str(error), status=EXIT_FAILED, debug=debug)
    except OSError as error:
        return _report_system(error, debug=debug)
    except Exception as error:  # noqa: BLE001  (the last resort: one line, not a traceback)
        if signals:  # what was being imported or set up broke
            tell(sys.stderr, "interrupted\n")
            return EXIT_FAILED
        sentence = f"{type(error).__name__}: {error} (add --debug for the traceback)"
        return _report(error, sentence, status=EXIT_FAILED, debug=debug)
    return status


@contextmanager
def _unpacking(words: list[str]) -> Generator[list[str]]:
    """The words without ``--max-unpacked SIZE``, which holds for every file that is read inside."""
    at = next((i for i, word in enumerate(words) if _MAX_UNPACKED.fullmatch(word)), None)
    if at is None:
        yield words
        return
    from splatseg.io.limits import parse_size, unpacking  # here: most command lines need neither

    _, joined, size = words[at].partition("=")
    end = at + 1 if joined else at + 2
    if not joined:
        size = " ".join(words[at + 1 : end])
    with unpacking(parse_size(size)):
        yield [*words[:at], *words[end:]]


def entry_point() -> int:
    """What the installed `splatseg` script calls; it exits with the status returned."""
    return main()


def overview() -> str:
    """The text of ``splatseg --help``: every command with its one line."""
    commands = find_commands()
    width = max(len(name) for name in commands)
    rows = "\n".join(f"  {name:<{width}}  {row.summary}" for name, row in commands.items())
    return (
        "usage: splatseg COMMAND ...\n\n"
        "Segments 3D Gaussian scenes: which Gaussians are what, from posed photographs and what\n"
        "2D models see in them.\n\n"
        f"commands:\n{rows}\n\n"
        "splatseg COMMAND --help   the flags of one command, with their units and defaults\n"
        "splatseg help COMMAND     the same\n"
        "splatseg --version        the version\n"
        "--debug                   with any command: the traceback of an error\n"
        "--max-unpacked SIZE       with any command: how much a small file may unpack to, such as\n"
        "                          4GB (256MiB; always 64 times its own size)\n\n"
        "exit status: 0 done, 2 bad input or usage, 1 everything else"
    )


def _dispatch(words: list[str]) -> int:
    if not words:
        print(overview(), file=sys.stderr)
        return EXIT_USAGE
    name, rest = words[0], words[1:]
    if name == "help" and rest:
        name, rest = rest[0], [*rest[1:], "--help"]
    if name in ("--help", "-h", "help"):
        print(overview())
        return EXIT_DONE
    if name == "--version":
        print(f"splatseg {_version()}")
        return EXIT_DONE
    commands = COMMANDS if name in COMMANDS else find_commands()
    if name not in commands:
        raise InputError(_unknown(name, commands))
    page = stored_page(name, rest)
    if page is not None:
        sys.stdout.write(page)
        return EXIT_DONE
    return _run(commands[name], name, rest)


def _run(entry: CommandEntry, name: str, words: list[str]) -> int:
    """Parse the words of one command and run it; tyro's own exits become our status."""
    from splatseg.cli._parse import parse  # here: the top-level help needs none of it

    kind, config = entry.kind_for(words)
    try:
        command = parse(kind, words, prog=f"splatseg {name}", config=config)
    except SystemExit as leaving:  # after --help (0) or a usage error (2)
        return leaving.code if isinstance(leaving.code, int) else EXIT_USAGE
    except InputError as error:  # options check themselves
        error.args = (with_flags(str(error), option_names(kind)),)
        raise
    try:
        entry.run(command)
    except (InputError, KeyboardInterrupt) as error:
        # Tasks speak of options by their names in Python.
        if error.args:
            error.args = (with_flags(str(error), option_names(kind)),)
        raise
    return EXIT_DONE


def _version() -> str:
    from importlib.metadata import version

    return version("splatseg")


def _unknown(name: str, commands: Collection[str]) -> str:
    if name in _ELSEWHERE:
        return f"the command {name!r} is in another package; install {_ELSEWHERE[name]}."
    kind = "option" if name.startswith("-") else "command"
    known = [*commands, "--help", "--version"]
    close = difflib.get_close_matches(name, known, n=1)
    hint = f"did you mean {close[0]!r}?" if close else f"known are {', '.join(commands)}."
    return f"unknown {kind} {name!r}; {hint}"


def _report_system(error: OSError, *, debug: bool) -> int:
    """An error of the system: one of writing says what to do."""
    from splatseg.io.atomic import failure_to_write, is_write_failure

    sentence = f"{type(error).__name__}: {error} (add --debug for the traceback)"
    if error.errno == errno.ENAMETOOLONG:
        sentence = str(InputError(f"{error.filename}: the name is too long for a file."))
    elif is_write_failure(error):
        sentence = failure_to_write(error.filename or "the standard output", error)
    if error.filename is None:
        silence(sys.stdout)
    return _report(error, sentence, status=EXIT_FAILED, debug=debug)


def _report(error: Exception, sentence: str, *, status: int, debug: bool) -> int:
    if debug:
        import traceback

        traceback.print_exception(error, file=sys.stderr)
    tell(sys.stderr, f"error: {visible(sentence)}\n")
    return status
