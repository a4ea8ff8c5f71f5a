"""Every command that a page shows is understood: its words are parsed as those of a person."""

import re
import shlex
from pathlib import Path

import pytest

from splatseg import cli
from splatseg.cli import CommandEntry, find_commands

ROOT = Path(__file__).resolve().parent.parent
PAGES = [
    ROOT / "README.md",
    *sorted(page for page in (ROOT / "docs").rglob("*.md") if "reference" not in page.parts),
]

_BLOCK = re.compile(r"^(```|~~~).*?$\n(.*?)^\1", re.MULTILINE | re.DOTALL)
_LINE = re.compile(r"^ *(?:\$ )?(splatseg .*)$", re.MULTILINE)
_INDENTED = re.compile(r"^ {4}(splatseg .*)$", re.MULTILINE)
_OTHERS = re.compile(r"COMMAND|--method majority|\.\.\.")
"""Placeholders, and a method that the page itself defines."""

_INLINE = re.compile(r"`(splatseg [^`]+)`")


def commands_of(page: Path) -> list[str]:
    """Command lines of blocks, of indented lines, and of single quotes with more than a name."""
    text = re.sub(r"\\\n\s*", " ", page.read_text(encoding="utf-8"))  # lines that go on
    found = [line for block in _BLOCK.finditer(text) for line in _LINE.findall(block.group(2))]
    rest = _BLOCK.sub("", text)
    found += [line.partition("  ")[0] for line in _INDENTED.findall(rest)]  # what it does follows
    # A name and a flag are a way to speak of the flag.
    found += [line for line in _INLINE.findall(rest) if line.split()[2:3] not in ([], ["..."])]
    told = [line for line in found if not line.split()[2].startswith("-")]
    return [line for line in told if not _OTHERS.search(line)]


SHOWN = [(page, line) for page in PAGES for line in commands_of(page)]


def test_pages_show_many() -> None:
    assert len(SHOWN) > 200
    assert len({page for page, _ in SHOWN}) > 15


@pytest.mark.parametrize(
    ("page", "line"), SHOWN, ids=[f"{page.stem}: {line[:60]}" for page, line in SHOWN]
)
def test_a_command_is_understood(
    page: Path,
    line: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = shlex.split(line, comments=True)[1:]
    monkeypatch.chdir(tmp_path)
    ran: list[object] = []
    monkeypatch.setattr(CommandEntry, "run", lambda entry, command: ran.append(command))
    assert words[0] in find_commands(), f"{page.name}: {line}"
    status = cli.main(words)
    said = capsys.readouterr()
    assert status == 0, f"{page.name}: {line}\n{said.err}"
    assert ran or "--help" in words or "-h" in words
