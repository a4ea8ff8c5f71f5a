"""`import splatseg` and `splatseg --help` stay light: what they import, and how long they take.

The list of modules is the proof; the times only catch what no list can (a slow module of our
own), so they are the best of several runs, for a machine that is busy with other things.
"""

import subprocess
import sys
import time

import pytest

IMPORT_SECONDS = 0.3
HELP_SECONDS = 0.6
HEAVY = {"torch", "numpy", "scipy", "sklearn", "skimage", "cv2", "PIL", "jaxtyping", "tyro", "rich"}


def imported_by(code: str) -> set[str]:
    """The top-level packages in memory after a fresh interpreter has run `code`."""
    report = "import sys; print(*{name.partition('.')[0] for name in sys.modules}, file=sys.stderr)"
    done = subprocess.run(
        [sys.executable, "-c", f"{code}\n{report}"], capture_output=True, text=True, check=True
    )
    return set(done.stderr.split())


def best_seconds(*words: str, runs: int = 7) -> float:
    """The shortest wall time of a fresh interpreter with these arguments."""
    times: list[float] = []
    for _ in range(runs):
        start = time.perf_counter()
        subprocess.run([sys.executable, *words], capture_output=True, check=True)
        times.append(time.perf_counter() - start)
    return min(times)


@pytest.mark.parametrize(
    "code",
    [
        "import splatseg",
        "import splatseg; dir(splatseg)",
        "import splatseg.cli",
        "import splatseg.cli; splatseg.cli.main(['--help'])",
        "import splatseg.cli; splatseg.cli.main(['--version'])",
        "import splatseg.cli; splatseg.cli.main(['no-such-command'])",
    ],
)
def test_imports_nothing_heavy(code: str) -> None:
    assert not imported_by(code) & HEAVY


def test_a_public_name_does_import_torch() -> None:
    """The test above can fail: the same look at a name that needs torch finds it."""
    assert "torch" in imported_by("import splatseg; splatseg.Gaussians")


def test_import_is_quick() -> None:
    assert best_seconds("-c", "import splatseg") < IMPORT_SECONDS


def test_help_is_quick() -> None:
    assert best_seconds("-m", "splatseg", "--help") < HELP_SECONDS
