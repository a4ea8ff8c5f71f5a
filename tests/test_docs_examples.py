"""What the documentation shows is run: doctests of every module, every file of examples/, the
commands that README.md names."""

import doctest
import importlib
import os
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

import splatseg
from splatseg import cli

PROJECT_ROOT = Path(__file__).resolve().parent.parent
NEEDS_A_PACKAGE = {"splatseg.render.cuda": "gsplat"}
"""Modules that import an optional package at the top; they are looked at where it is installed."""

NOT_EXAMPLES = {"splatseg.__main__", "splatseg.cli.__main__", "splatseg._native"}


def modules() -> list[str]:
    found = pkgutil.walk_packages(splatseg.__path__, "splatseg.")
    return ["splatseg", *sorted(module.name for module in found if module.name not in NOT_EXAMPLES)]


@pytest.mark.parametrize("name", modules())
def test_doctests(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # an example may write a file
    result = doctest.testmod(
        importlib.import_module(name), optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    )
    assert result.failed == 0


def test_there_are_doctests_to_run() -> None:
    finder = doctest.DocTestFinder(exclude_empty=True)
    count = sum(
        bool(test.examples)
        for name in modules()
        for test in finder.find(importlib.import_module(name))
    )
    assert count >= 5


@pytest.mark.parametrize(
    "example", sorted((PROJECT_ROOT / "examples").glob("*.py")), ids=lambda path: path.name
)
def test_examples_run(example: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(example)],
        cwd=tmp_path,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip(), "an example shows something"


def readme_code() -> str:
    text = (PROJECT_ROOT / "README.md").read_text(encoding="utf-8")
    return "\n".join(re.findall(r"^```.*?\n(.*?)^```", text, re.MULTILINE | re.DOTALL))


def test_readme_names_only_commands_and_flags_that_exist(
    capsys: pytest.CaptureFixture[str],
) -> None:
    lines = re.findall(r"^ *splatseg +(\S+)(.*)$", readme_code(), re.MULTILINE)
    assert len(lines) >= 5
    for name, rest in lines:
        assert name in cli.COMMANDS, name
        assert cli.main([name, "--help"]) == 0
        text = capsys.readouterr().out
        for flag in re.findall(r"(?<!\S)(--?[a-z][a-z-]*)", rest):
            assert flag in text, f"splatseg {name} has no flag {flag}"
