"""The help of every command: kept pages are what the parser says, and read as a person wants."""

import importlib.machinery
import importlib.util
import re
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar

import pytest
import tyro

from splatseg.cli import COMMANDS
from splatseg.cli._parse import flowing, parse, wrapped
from splatseg.cli._words import FOLDER, listed, option_value, stored_page, with_flags
from splatseg.core.options import options
from splatseg.errors import InputError

ROOT = Path(__file__).parents[2]


@pytest.mark.skipif(
    tuple(map(int, tyro.__version__.split(".")[:3])) < (1, 0, 17),
    reason="the pages have the layout of tyro 1.0.17 and later",
)
def test_pages_are_what_the_parser_says() -> None:
    loader = importlib.machinery.SourceFileLoader("help_pages", str(ROOT / "scripts/help_pages"))
    spec = importlib.util.spec_from_loader("help_pages", loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    wanted = module.pages()
    kept = {path.name: path.read_text(encoding="utf-8") for path in FOLDER.glob("*.txt")}
    assert kept == wanted, "run scripts/help_pages"


@pytest.mark.parametrize("name", COMMANDS)
def test_help_is_the_page_and_loads_nothing_heavy(name, splatseg) -> None:
    status, text, _ = splatseg(name, "--help")
    assert status == 0
    assert text == (FOLDER / f"{name}.txt").read_text(encoding="utf-8")
    assert splatseg("help", name)[1] == text
    assert splatseg(name, "-h")[1] == text
    assert max(len(line) for line in text.splitlines() if not line.startswith("splatseg ")) <= 80
    assert "{None}" not in text


def test_help_imports_no_torch() -> None:
    code = (
        "import sys; from splatseg.cli import main; main(['segment', '--help']); "
        "sys.exit('torch' in sys.modules or 'tyro' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], stdout=subprocess.DEVNULL).returncode == 0


def test_only_questions_for_help_are_answered_by_a_page() -> None:
    assert stored_page("segment", []) is None
    assert stored_page("segment", ["S", "--method", "vote"]) is None
    assert stored_page("segment", ["S", "--help"]) is None
    assert stored_page("segment", ["--method", "no-such", "--help"]) is None
    assert stored_page("segment", ["--method", "../pages/segment-vote", "--help"]) is None
    page = (FOLDER / "segment-vote.txt").read_text(encoding="utf-8")
    assert stored_page("segment", ["--method", "vote", "--help"]) == page
    assert stored_page("segment", ["--help", "--method=vote"]) == page


@dataclass(frozen=True, kw_only=True)
class Inner:
    """Inside."""

    size: int | None = None
    """A sentence that goes
    over two lines."""


@dataclass(frozen=True, kw_only=True)
class Outer:
    """One sentence that is
    broken in the source.

    splatseg outer --size 3
    """

    place: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PLACE")]
    """Where."""

    names: tuple[str, ...] = ("a",)
    """Which."""

    inner: Inner = field(default_factory=lambda: Inner(size=7))
    """The inner ones."""


def test_what_is_parsed_is_an_instance_of_the_class_itself() -> None:
    config = (tyro.conf.OmitArgPrefixes,)
    assert parse(Outer, ["x"], prog="p", config=config) == Outer(place=Path("x"))
    words = ["x", "--size", "3", "--names", "b", "c"]
    found = parse(Outer, words, prog="p", config=config)
    assert found == Outer(place=Path("x"), names=("b", "c"), inner=Inner(size=3))
    assert type(found) is Outer


def test_sentences_flow_and_placeholders_are_short(capsys, monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    with pytest.raises(SystemExit):
        parse(Outer, ["--help"], prog="p", config=(tyro.conf.OmitArgPrefixes,))
    text = capsys.readouterr().out
    assert "One sentence that is broken in the source." in text
    assert "A sentence that goes over two lines." in text
    assert re.search(r"--size N\b", text)
    assert "PLACE" in text


def test_words() -> None:
    assert flowing("a\n  b\n\n  c") == "a b\n\nc"
    assert flowing("a\n\n- b\n  c\n- d") == "a\n\n- b c\n- d"
    assert option_value(["--method", "a", "--method=b"], "--method") == "b"
    assert option_value(["--method"], "--method") is None
    assert listed("--x", ["a,b", "c d"]) == ("a", "b", "c d")
    with pytest.raises(InputError, match=r"--x: expected one name or more"):
        listed("--x", [" , "])
    assert with_flags("min_share: expected 0.", {"min_share"}) == "--min-share: expected 0."
    assert with_flags("layer, truth: no.", {"layer", "truth"}) == "--layer, --truth: no."
    assert with_flags("layer, other: no.", {"layer"}) == "layer, other: no."
    assert with_flags("no colon", {"no"}) == "no colon"


@options(removed={"slack": "`size` bounds it"})
class Fitted:
    """Options of which one went."""

    size: int = 1
    """Size."""


@dataclass(frozen=True, kw_only=True)
class Fitting:
    """A command of which a flag went, too."""

    REMOVED: ClassVar[Mapping[str, str]] = {"old": "use --new"}

    plain: tyro.conf.OmitArgPrefixes[Fitted] = field(default_factory=Fitted)
    nested: Fitted = field(default_factory=Fitted)


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("--slack", "--slack: this option was removed; --size bounds it."),
        ("--slack=3", "--slack: this option was removed; --size bounds it."),
        ("--no-slack", "--no-slack: this option was removed; --size bounds it."),
        ("--nested.slack", "--nested.slack: this option was removed; --size bounds it."),
        ("--old", "--old: this option was removed; use --new."),
    ],
)
def test_flags_that_went_say_what_to_use(word, said) -> None:
    with pytest.raises(InputError, match=f"^{re.escape(said)}$"):
        parse(Fitting, [word, "3"], prog="p", config=())


def test_long_lines_are_wrapped_and_commands_stay_whole() -> None:
    long = "word " * 30
    command = "splatseg " + "x" * 100
    lines = wrapped(f"{long}\n{command}\nshort  \n\n").splitlines()
    assert command in lines
    assert all(len(line) <= 80 for line in lines if line != command)
    assert lines[-1] == "short"


def test_items_of_lists_hang_and_empty_lines_do_not_double() -> None:
    lines = wrapped("- " + "word " * 30 + "\n\n \n\nend\n").splitlines()
    assert lines[0].startswith("- word")
    assert all(line.startswith("  word") for line in lines[1:-2])
    assert lines[-2:] == ["", "end"]
    assert lines[-3]
