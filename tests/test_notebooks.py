"""The notebooks of examples/ run, cell by cell and in order, from an empty folder.

No kernel and no package for notebooks is needed: the cells are plain Python, and what the last
line of a cell gives is shown as a notebook would show it.
"""

import ast
import json
from pathlib import Path
from typing import Any

import pytest

NOTEBOOKS = sorted((Path(__file__).parent.parent / "examples").glob("*.ipynb"))


def run_cell(source: str, names: dict[str, Any], where: str) -> None:
    """Run a cell, and show the value of its last line."""
    tree = ast.parse(source, filename=where)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, where, "exec"), names)
    if last is None:
        return
    value = eval(compile(ast.Expression(last.value), where, "eval"), names)
    shown = getattr(value, "_repr_html_", value.__repr__)()
    assert len(shown) < 400_000, f"{where}: what is shown is too long"


def test_there_are_three() -> None:
    assert len(NOTEBOOKS) == 3


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook(
    notebook: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {"__name__": "__main__"}
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    for i, cell in enumerate(cells):
        if cell["cell_type"] == "code":
            assert not cell["outputs"], "outputs are not committed"
            run_cell("".join(cell["source"]), names, f"{notebook.name}, cell {i}")
    if "figures" in names:
        assert names["figures"]["mIoU"] > 0.2
        assert "%" in capsys.readouterr().out
