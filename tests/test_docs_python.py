"""docs/python.md names every command, its function with its first arguments, and its options."""

import inspect
import re
from dataclasses import is_dataclass
from pathlib import Path

import splatseg
from splatseg import cli

PROJECT_ROOT = Path(__file__).resolve().parent.parent


def rows() -> list[tuple[str, str, list[str], list[str]]]:
    """Command, function, arguments and options of each row."""
    text = (PROJECT_ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    found = re.findall(r"^\| (?:`(\w+)`)? ?\| `(\w+)\(([\w, ]+)\)` \|(.*)\|$", text, re.MULTILINE)
    return [(a, b, c.split(", "), re.findall(r"`(\w+)`", d)) for a, b, c, d in found]


def test_every_command_has_a_function() -> None:
    named = {command for command, *_ in rows() if command}
    assert named | {"help", "completion"} >= set(cli.COMMANDS)
    assert named <= set(cli.COMMANDS)


def test_functions_take_what_the_page_says() -> None:
    assert len(rows()) >= 13
    for _, name, arguments, options in rows():
        function = getattr(splatseg, name)
        parameters = inspect.signature(function).parameters
        assert list(parameters)[: len(arguments)] == arguments, name
        annotations = " ".join(str(one.annotation) for one in parameters.values())
        for option in options:
            assert is_dataclass(getattr(splatseg, option)), option
            assert option in annotations, (name, option)
