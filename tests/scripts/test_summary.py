"""The summary of a run survives the death of a worker and an internal error."""

import subprocess
import sys
from pathlib import Path

import pytest

TESTS = """
import os
import signal
import time
import pytest

@pytest.mark.parametrize("n", range(8))
def test_it(n):
    assert n != 2
    if n == 5:
        time.sleep(1)  # what failed before has been told
        ENDS
"""
CONFTEST = """
import os
from support.summary import SummaryAfterInternalError

def pytest_configure(config):
    config.pluginmanager.register(SummaryAfterInternalError())

def pytest_runtest_makereport(item, call):
    if os.environ.pop("BROKEN", ""):
        raise OSError(27, "File too large")
"""
INTERNAL_ERROR = 3


def run(folder: Path, project_root: Path, monkeypatch, ends: str, *words: str) -> tuple[int, str]:
    """pytest's status and output for tests of which one fails and a later one ends the worker."""
    (folder / "conftest.py").write_text(CONFTEST)
    (folder / "test_them.py").write_text(TESTS.replace("ENDS", ends))
    (folder / "pytest.ini").write_text(f"[pytest]\npythonpath = {project_root / 'tests'}\n")
    for name in ("PYTEST_XDIST_WORKER", "PYTEST_ADDOPTS", "BROKEN"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")  # the others take long to import
    plugins = ("-p", "xdist", "-p", "no:cacheprovider")
    command = [sys.executable, "-m", "pytest", *plugins, "-ra", *words]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    return done.returncode, done.stderr + done.stdout


@pytest.mark.parametrize("words", [(), ("-n", "2", "--dist", "worksteal")])
def test_after_an_internal_error_what_failed_is_named(
    tmp_path: Path, project_root: Path, monkeypatch, words: tuple[str, ...]
) -> None:
    status, out = run(tmp_path, project_root, monkeypatch, "os.environ['BROKEN'] = '1'", *words)
    assert status == INTERNAL_ERROR, out
    assert "INTERNALERROR" in out
    summary = out[out.index("short test summary") :]
    assert "FAILED test_them.py::test_it[2] - assert 2 != 2" in summary
    assert "was running: test_them.py::test_it[5]" in summary
    assert "was running: test_them.py::test_it[2]" not in summary
    assert "1 failed" in summary.splitlines()[-1]


def test_after_the_death_of_a_worker_what_failed_is_named(
    tmp_path: Path, project_root: Path, monkeypatch
) -> None:
    ends = "os.kill(os.getpid(), signal.SIGKILL)"
    words = ("-n", "2", "--dist", "worksteal")
    status, out = run(tmp_path, project_root, monkeypatch, ends, *words)
    assert status == 1, out
    summary = out[out.index("short test summary") :]
    assert "FAILED test_them.py::test_it[2] - assert 2 != 2" in summary
    assert "FAILED test_them.py::test_it[5] - worker 'gw" in summary
    assert "2 failed, 6 passed" in summary.splitlines()[-1]
