"""What the documentation shows is run: doctests of every module, every file of examples/, the
commands that README.md names."""

import doctest
import importlib
import importlib.util
import os
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import splatseg
import splatseg_bench
from splatseg import cli

PROJECT_ROOT = Path(__file__).resolve().parent.parent
NEEDS_A_PACKAGE = {"splatseg.render.cuda": "gsplat"}
"""Modules that import an optional package at the top; they are looked at where it is installed."""

NOT_EXAMPLES = {"splatseg.__main__", "splatseg._native"}


def modules() -> list[str]:
    found = [
        module.name
        for package in (splatseg, splatseg_bench)
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
    ]
    return ["splatseg", *sorted(name for name in found if name not in NOT_EXAMPLES)]


def source(name: str) -> str:
    """The text of a module, which is not imported for it."""
    spec = importlib.util.find_spec(name)
    assert spec is not None
    assert spec.origin is not None
    return Path(spec.origin).read_text(encoding="utf-8")


@pytest.mark.parametrize("name", [name for name in modules() if ">>>" in source(name)])
def test_doctests(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # an example may write a file
    result = doctest.testmod(
        importlib.import_module(name), optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    )
    assert result.attempted > 0
    assert result.failed == 0


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


def test_the_python_of_the_readme_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    room = splatseg.synthetic.room(seed=0)
    views = splatseg.synthetic.cameras(room, train=6, test=1, width=48, height=36)
    splatseg.synthetic.write_capture(room, "CAPTURE", views=views, points=200)
    start = splatseg.read_capture("CAPTURE").points
    assert start is not None
    count = len(start.points)
    gaussians = splatseg.Gaussians(
        means=start.points,
        rotations=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        scales=torch.full((count, 3), 0.1),
        opacities=torch.full((count,), 0.7),
        sh=torch.zeros(count, 1, 3),
    )
    splatseg.write_splats(gaussians, "labelled.ply")
    text = (PROJECT_ROOT / "README.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    assert blocks
    names: dict[str, object] = {}
    for block in blocks:
        exec(compile(block, "README.md", "exec"), names)
    view, lifted = names["view"], names["lifted"]
    assert isinstance(view, splatseg.render.Rendered)
    assert isinstance(lifted, splatseg.render.BackProjected)
    assert view.alpha.max() > 0
    assert lifted.weights.sum() == pytest.approx(view.alpha.sum().item(), rel=1e-4)


def readme_code() -> str:
    text = (PROJECT_ROOT / "README.md").read_text(encoding="utf-8")
    return "\n".join(re.findall(r"^```.*?\n(.*?)^```", text, re.MULTILINE | re.DOTALL))


def test_readme_names_only_commands_and_flags_that_exist(
    capsys: pytest.CaptureFixture[str],
) -> None:
    lines = re.findall(r"^ *splatseg +(\S+)(.*)$", readme_code(), re.MULTILINE)
    assert len(lines) >= 5
    for name, rest in lines:
        assert name in cli.find_commands(), name
        assert cli.main([name, "--help"]) == 0
        text = capsys.readouterr().out
        for flag in re.findall(r"(?<!\S)(--?[a-z][a-z-]*)", rest):
            assert flag in text, f"splatseg {name} has no flag {flag}"
