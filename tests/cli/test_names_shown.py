"""Names of others on the terminal: seen as they are, no markup of our tables, no commands to it."""

from types import SimpleNamespace

import pytest

from splatseg import cli
from splatseg.cli import evaluate
from splatseg.core import ClassTable
from splatseg_bench import command as bench

NAME = "[red]wall[/red] [/] \x1b[31m\u202e"
SEEN = "[red]wall[/red] [/] \\x1b[31m\\u202e"


@pytest.fixture
def shown(monkeypatch, capsys):
    """What a function prints on a wide terminal."""
    monkeypatch.setenv("COLUMNS", "400")

    def show(function, *words) -> str:
        function(*words)
        return capsys.readouterr().out

    return show


def test_the_table_of_a_protocol(shown, monkeypatch) -> None:
    table = (("method", NAME, "source"), [(f"a {NAME}", 0.5, None), ("b", None, f"c {NAME}")])
    monkeypatch.setattr(bench, "bench_table", lambda run, **chosen: table)
    run = SimpleNamespace(protocol=SimpleNamespace(name="p", summary="s"))
    found = shown(bench._print_table, run)
    assert found.count(SEEN) == 3
    assert f"a {SEEN}" in found
    assert f"c {SEEN}" in found
    assert "0.500" in found
    assert "\x1b" not in found


def test_tables_of_scores(shown) -> None:
    figures = {
        "scene": NAME, "split": "test", "layer": f"b {NAME}", "mIoU": 0.5,
        "per_class": {"1": 0.25}, "names_per_class": {"1": f"c {NAME}"},
    }  # fmt: skip
    scene = SimpleNamespace(classes=ClassTable(rows=()))
    found = shown(evaluate._print_tables, figures, scene)
    assert f"{SEEN}, test views" in found
    assert f"b {SEEN}" in found
    assert f"c {SEEN}" in found
    assert "\x1b" not in found


@pytest.mark.parametrize("error", [KeyboardInterrupt(NAME), ValueError(NAME)])
def test_what_ends_a_command(error, monkeypatch, capsys) -> None:
    def end(words) -> int:
        raise error

    monkeypatch.setattr(cli, "_dispatch", end)
    assert cli.main(["info"]) == 1
    message = capsys.readouterr().err
    assert SEEN in message
    assert message.count("\n") == 1
