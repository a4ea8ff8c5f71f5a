"""The top of the command line: the table of commands, exit statuses, one-line errors."""

import ast
import dataclasses
import errno
import importlib
import inspect
import os
import re
import subprocess
import sys
import textwrap
import types
from collections.abc import Callable

import pytest

from splatseg import cli
from splatseg.cli import _shared as _types
from splatseg.errors import BackendError, InputError, MissingPackageError, RangeError


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Settings that several commands share."""

    near: float = 0.01
    """Nearest depth."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Count:
    """Counts."""

    steps: int = 3
    """How many steps to take."""

    # A comment that must not become help.
    seed: int = 0
    options: Options = Options()


@pytest.fixture
def install_command(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[Count], None]], None]:
    """Put a command `count` whose `run` is the given function into the table."""

    def install(run: Callable[[Count], None]) -> None:
        module = types.ModuleType("splatseg.cli.count")
        module.__dict__.update(Command=Count, run=run)
        monkeypatch.setitem(sys.modules, module.__name__, module)
        entry = cli.CommandEntry(module=module.__name__, summary="counts")
        monkeypatch.setitem(cli.COMMANDS, "count", entry)

    return install


def raising(error: BaseException) -> Callable[[Count], None]:
    def run(command: Count) -> None:
        raise error

    return run


def test_every_row_of_the_table_is_a_command() -> None:
    for name, entry in cli.COMMANDS.items():
        module = importlib.import_module(entry.module)
        assert dataclasses.is_dataclass(module.Command), name
        assert module.Command.__dataclass_params__.frozen, name
        assert callable(module.run), name


def test_every_module_of_the_package_is_in_the_table() -> None:
    from pathlib import Path

    files = {path.stem for path in Path(cli.__file__).parent.glob("[!_]*.py")}
    assert files == {entry.module.rsplit(".", 1)[1] for entry in cli.COMMANDS.values()}


@pytest.mark.parametrize("name", sorted(cli.COMMANDS))
def test_each_command_has_help(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([name, "--help"]) == 0
    assert f"splatseg {name}" in capsys.readouterr().out


@pytest.mark.parametrize("name", sorted(cli.COMMANDS))
def test_each_field_of_a_command_is_explained(name: str) -> None:
    """A sentence stands under every field, or its type is shared and has one."""
    module = importlib.import_module(cli.COMMANDS[name].module)
    tree = ast.parse(textwrap.dedent(inspect.getsource(module.Command))).body[0]
    assert isinstance(tree, ast.ClassDef)
    body = tree.body
    for field, below in zip(body, [*body[1:], None], strict=True):
        if isinstance(field, ast.AnnAssign):
            explained = isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant)
            shared = hasattr(_types, ast.unparse(field.annotation))
            assert explained or shared, f"{name}: {ast.unparse(field)}"


@pytest.mark.parametrize("word", ["--help", "-h", "help"])
def test_help_lists_every_command(word: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([word]) == 0
    text = capsys.readouterr().out
    for name, entry in cli.COMMANDS.items():
        assert re.search(rf"^  {name} +{re.escape(entry.summary)}$", text, re.MULTILINE)


class Point:
    """An entry point of another distribution."""

    value = "elsewhere:ENTRY"

    def __init__(self, name: str, found: object) -> None:
        self.name = name
        self._found = found

    def load(self) -> object:
        if isinstance(self._found, Exception):
            raise self._found
        return self._found


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Let these be all the commands that other distributions register."""

    def register(**found: object) -> None:
        points = [Point(name, one) for name, one in found.items()]
        monkeypatch.setattr(cli, "entry_points", lambda group: points)

    return register


def test_another_distribution_adds_a_command_and_replaces_none(registered) -> None:
    entry = cli.CommandEntry(module="elsewhere", summary="counts sheep")
    registered(sheep=entry, fit=entry)
    assert cli.find_commands() == cli.COMMANDS | {"sheep": entry}
    assert "\n  sheep       counts sheep\n" in cli.overview()


@pytest.mark.parametrize(
    ("found", "word", "status", "sentence"),
    [
        ({}, "bench", 2, "the command 'bench' is in another package; install splatseg-bench."),
        ({"a": ImportError("no b")}, "a", 1,
         "command 'a' (elsewhere:ENTRY) cannot be loaded: no b."),
        ({"a": 3}, "a", 2,
         "command 'a' (elsewhere:ENTRY): expected a splatseg.cli.CommandEntry, got int."),
    ],
)  # fmt: skip
def test_a_command_that_is_not_there(registered, capsys, found, word, status, sentence) -> None:
    registered(**found)
    assert cli.main([word]) == status
    assert capsys.readouterr().err == f"error: {sentence}\n"


def test_no_command_is_a_usage_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("usage: splatseg COMMAND")


@pytest.mark.parametrize(
    ("word", "sentence"),
    [
        ("rendr", "error: unknown command 'rendr'; did you mean 'render'?\n"),
        ("--versoin", "error: unknown option '--versoin'; did you mean '--version'?\n"),
    ],
)
def test_unknown_words_get_a_suggestion(
    word: str, sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([word, "--steps", "1"]) == 2
    assert capsys.readouterr() == ("", sentence)


def test_a_word_like_nothing_gets_the_list(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["qqqqq"]) == 2
    assert f"known are {', '.join(cli.find_commands())}." in capsys.readouterr().err


def test_words_become_the_dataclass(install_command: Callable[..., None]) -> None:
    seen: list[Count] = []
    install_command(seen.append)
    assert cli.main(["count"]) == 0
    assert cli.main(["count", "--steps", "7", "--near", "0.5"]) == 0
    assert seen == [Count(steps=3), Count(steps=7, options=Options(near=0.5))]


def test_help_comes_from_the_string_under_a_field(
    install_command: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    install_command(raising(RuntimeError("--help must not run the command")))
    assert cli.main(["count", "--help"]) == 0
    text = capsys.readouterr().out
    assert "How many steps to take." in text
    assert "must not become help" not in text


@pytest.mark.parametrize("words", [["--steps", "many"], ["--stepz", "1"], ["stray"]])
def test_words_that_do_not_parse_are_usage_errors(
    words: list[str], install_command: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    install_command(raising(RuntimeError("must not run")))
    assert cli.main(["count", *words]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "Traceback" not in captured.err


@pytest.mark.parametrize(
    ("error", "status", "stderr"),
    [
        (InputError("DATA is empty."), 2, "error: DATA is empty.\n"),
        (RangeError("near must be positive."), 2, "error: near must be positive.\n"),
        (MissingPackageError("pip install gsplat"), 1, "error: pip install gsplat\n"),
        (BackendError("no GPU."), 1, "error: no GPU.\n"),
        (KeyboardInterrupt(), 1, "interrupted\n"),
        (
            KeyError("x"),
            1,
            "error: KeyError: 'x' (add --debug for the traceback)\n",
        ),
    ],
)
def test_errors_become_one_line_and_a_status(
    error: BaseException,
    status: int,
    stderr: str,
    install_command: Callable[..., None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    install_command(raising(error))
    assert cli.main(["count"]) == status
    assert capsys.readouterr() == ("", stderr)


def test_a_command_may_set_its_own_exit_only_through_errors(
    install_command: Callable[..., None],
) -> None:
    """A SystemExit out of `run` is not mistaken for tyro's."""
    install_command(raising(SystemExit(5)))
    with pytest.raises(SystemExit):
        cli.main(["count"])


@pytest.mark.parametrize("words", [["--debug", "count"], ["count", "--debug", "--steps", "1"]])
def test_debug_adds_the_traceback(
    words: list[str], install_command: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    install_command(raising(InputError("DATA is empty.")))
    assert cli.main(words) == 2
    text = capsys.readouterr().err
    assert text.startswith("Traceback (most recent call last)")
    assert text.endswith("error: DATA is empty.\n")


@pytest.mark.parametrize("module", ["splatseg"])
def test_python_dash_m(module: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", module, "nothing"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert done.stderr.startswith("error: unknown command 'nothing'")


@pytest.mark.parametrize("length", [10, 10_000_000])
def test_a_reader_that_goes_away_is_no_traceback(length: int) -> None:
    """`splatseg --help | true`: the pipe breaks while we write, or when we flush at the end."""
    script = (
        "import sys, splatseg.cli as cli\n"
        f"cli.overview = lambda: 'x' * {length}\n"
        "sys.exit(cli.main(['--help']))\n"
    )
    # Buffered, as a user's is: what is still in the buffer is written at exit.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    read_end, write_end = os.pipe()
    os.close(read_end)
    try:
        done = subprocess.run(
            [sys.executable, "-c", script],
            stdout=write_end,
            stderr=subprocess.PIPE,
            env=environment,
            check=False,
        )
    finally:
        os.close(write_end)
    assert done.stderr == b""
    assert done.returncode == 1


def test_a_name_too_long_for_a_file_is_one_sentence(monkeypatch, capsys) -> None:
    """Where no boundary stands before the system."""

    def run(command: object) -> None:
        raise OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG), "x" * 5000)

    monkeypatch.setattr("splatseg.cli.info.run", run)
    assert cli.main(["info", "a"]) == 1
    assert capsys.readouterr().err.endswith("...xxxxxxxxxxxx: the name is too long for a file.\n")
