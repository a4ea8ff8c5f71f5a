"""What is written comes first, then where to, then under which name: in every function."""

import ast
from pathlib import Path

import pytest

import splatseg

SOURCE = Path(splatseg.__file__).parent
DESTINATIONS = {"path", "folder", "root"}
NAMES = {"name", "identity"}
"""What may follow the destination: a name in it, or of what is written."""


def writers() -> list[tuple[str, list[str]]]:
    """(module.function, names of its positional arguments) of every ``save_*`` and ``write_*``."""
    found: list[tuple[str, list[str]]] = []
    for file in sorted(SOURCE.rglob("*.py")):
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.FunctionDef) and node.name.startswith(("save_", "write_")):
                words = [argument.arg for argument in node.args.args]
                found.append((f"{file.relative_to(SOURCE)}: {node.name}", words))
    return found


def test_there_are_writers() -> None:
    assert len(writers()) > 25


@pytest.mark.parametrize(("function", "words"), writers(), ids=[row[0] for row in writers()])
def test_values_come_before_the_destination(function: str, words: list[str]) -> None:
    places = [i for i, word in enumerate(words) if word in DESTINATIONS]
    assert len(places) == 1, f"{function}({', '.join(words)}): expected one destination"
    assert places[0] >= 1, f"{function}({', '.join(words)}): expected what is written first"
    assert set(words[places[0] + 1 :]) <= NAMES
