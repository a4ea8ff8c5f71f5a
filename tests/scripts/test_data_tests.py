"""Tests marked `data`: not run without the large scenes, counted, and required where they are."""

import subprocess
import sys
from pathlib import Path

import pytest

from support.shared import SharedData

TESTS = """
import pytest

def test_by_its_fixture(shared_data):
    assert (shared_data / "README.md").is_file()

@pytest.mark.parametrize("n", [1, pytest.param(2, marks=pytest.mark.data)])
def test_by_its_mark(n):
    assert n

def test_of_neither():
    assert True
"""
CONFTEST = """
import os
import pytest
from pathlib import Path
from support import shared

SHARED = shared.SharedData.find(os.environ, Path(__file__).parent)

def pytest_configure(config):
    config.addinivalue_line("markers", "data: large scenes")
    config.pluginmanager.register(shared.DataTests(SHARED))

@pytest.fixture
def shared_data():
    return SHARED.folder
"""


@pytest.fixture
def project(tmp_path: Path, project_root: Path) -> Path:
    """A project with four tests, two of them marked, and no large scenes beside it."""
    root = tmp_path / "project"
    (root / "tests").mkdir(parents=True)
    (root / "scripts").mkdir()
    (root / "conftest.py").write_text(CONFTEST)
    (root / "tests" / "test_them.py").write_text(TESTS)
    support = project_root / "tests"
    (root / "pytest.ini").write_text(f"[pytest]\npythonpath = {support}\n")
    script = project_root / "scripts" / "data-tests-ran"
    (root / "scripts" / script.name).write_text(script.read_text())
    return root


def put_large_scenes(at: Path) -> None:
    (at / "data").mkdir(parents=True)
    (at / "data" / "README.md").write_text("scenes")
    (at / "score").mkdir()
    (at / "score" / "score.py").write_text("")


def run(project: Path, monkeypatch, *words: str, data: Path | None = None) -> tuple[int, str, int]:
    """pytest's status and output in that project, and the status of scripts/data-tests-ran."""
    monkeypatch.delenv("SPLATSEG_DATA", raising=False)
    monkeypatch.delenv("PYTEST_XDIST_WORKER", raising=False)
    if data is not None:
        monkeypatch.setenv("SPLATSEG_DATA", str(data))
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-rs", *words]
    done = subprocess.run(command, cwd=project, capture_output=True, text=True, check=False)
    log = project / "log.txt"
    log.write_text(done.stdout)
    script = ["bash", str(project / "scripts" / "data-tests-ran"), str(log)]
    checked = subprocess.run(script, cwd=project, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout + done.stderr, checked.returncode


def test_without_the_scenes_the_rest_runs_and_the_count_is_said(project, monkeypatch) -> None:
    status, out, required = run(project, monkeypatch)
    assert (status, required) == (0, 0)
    assert "tests marked data: 0 run, 2 not run: there is no ../shared/data (the variable" in out
    lines = out.splitlines()
    line = next(i for i, text in enumerate(lines) if text.startswith("tests marked data"))
    assert "2 passed, 2 skipped" in lines[-1]
    assert line < len(lines) - 1


@pytest.mark.parametrize("named", [False, True])
def test_with_the_scenes_all_run(project, monkeypatch, tmp_path, named) -> None:
    put_large_scenes(tmp_path / ("elsewhere" if named else "shared"))
    data = tmp_path / "elsewhere" / "data" if named else None
    status, out, required = run(project, monkeypatch, data=data)
    assert (status, required) == (0, 0), out
    assert "tests marked data: 2 run, 0 not run\n" in out


def test_a_run_that_passed_them_over_is_no_good_where_they_are(
    project, monkeypatch, tmp_path
) -> None:
    put_large_scenes(tmp_path / "shared")
    assert run(project, monkeypatch, "-m", "not data")[::2] == (0, 1)
    (tmp_path / "shared" / "data" / "README.md").unlink()
    status, out, required = run(project, monkeypatch)
    assert (status, required) == (0, 1)
    assert "2 not run: there is no " in out


def test_a_variable_that_names_nothing_is_an_error(tmp_path) -> None:
    with pytest.raises(pytest.UsageError, match=r"SPLATSEG_DATA=.*gone: there is no .*README.md"):
        SharedData.find({"SPLATSEG_DATA": str(tmp_path / "gone")}, tmp_path)
