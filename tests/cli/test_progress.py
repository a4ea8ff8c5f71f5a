"""Progress in a log: plain lines every ten seconds; in a terminal a bar; none if silenced."""

import subprocess
import sys

import pytest

from splatseg.cli import _shared as _progress
from splatseg.cli._shared import ProgressLines, progress


class Clock:
    """Seconds as the test wants them."""

    def __init__(self) -> None:
        self.now = 500.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    """A clock that stands."""
    return Clock()


@pytest.fixture
def lines() -> list[str]:
    """What was written."""
    return []


def test_at_most_a_line_every_ten_seconds(clock: Clock, lines: list[str]) -> None:
    shown = ProgressLines("see", write=lines.append, clock=clock)
    for done in range(101):
        shown.show(done, 100)
        clock.now += 0.7
    assert len(lines) == 6
    # The first call after 10 s is that of 15 * 0.7 s; the next that of 30 * 0.7 s.
    assert lines[0] == "see: 15 of 100, 15 %, 0:10 elapsed, about 0:59 left\n"
    assert lines[1] == "see: 30 of 100, 30 %, 0:21 elapsed, about 0:49 left\n"


def test_short_work_writes_nothing(clock: Clock, lines: list[str]) -> None:
    shown = ProgressLines("see", write=lines.append, clock=clock)
    clock.now += 9.9
    shown.show(3, 3)
    assert lines == []


def test_what_was_there_before_is_no_speed(clock: Clock, lines: list[str]) -> None:
    """Resumed at 90 of 100; four in the first twenty seconds leave thirty for six."""
    shown = ProgressLines("see", write=lines.append, clock=clock)
    shown.show(90, 100)
    clock.now += 20
    shown.show(94, 100)
    assert lines == ["see: 94 of 100, 94 %, 0:20 elapsed, about 0:30 left\n"]
    lines.clear()
    slow = ProgressLines("see", write=lines.append, clock=clock)
    slow.show(2, 4)
    clock.now += 4000
    slow.show(2, 4)
    assert lines == ["see: 2 of 4, 50 %, 1:06:40 elapsed\n"]


def test_words_and_estimates_of_the_work_itself(clock: Clock, lines: list[str]) -> None:
    shown = ProgressLines("fit", write=lines.append, clock=clock)
    clock.now += 65
    shown.show(0, 100)
    lines.clear()
    clock.now += 65
    shown.show(50, 100, "step 70")
    assert lines == ["fit: step 70, 50 %, 2:10 elapsed, about 2:10 left\n"]
    shown = ProgressLines("fit", write=lines.append, clock=clock)
    clock.now += 130
    shown.show(7, 0)
    assert lines[1] == "fit: 7, 2:10 elapsed\n"


def test_in_a_log_they_go_to_stderr_at_once(capsys, monkeypatch) -> None:
    monkeypatch.setattr(_progress, "SECONDS_BETWEEN_LINES", 0.0)
    with progress("see") as step:
        step(1, 4)
        written = capsys.readouterr()
        assert written.err.startswith("see: 1 of 4, 25 %, 0:00 elapsed")
        assert written.out == ""
    with progress("see", quiet=True) as step:
        step(2, 4)
    assert capsys.readouterr().err == ""


def test_in_a_terminal_a_bar_is_drawn(capsys, monkeypatch) -> None:
    monkeypatch.setattr(_progress, "SECONDS_BETWEEN_LINES", 0.0)
    monkeypatch.setenv("FORCE_COLOR", "1")
    with progress("see") as step:
        step(1, 4)
    assert "see: 1 of 4" not in capsys.readouterr().err


_PROGRAM = """
from splatseg.cli import _shared as _progress
_progress.SECONDS_BETWEEN_LINES = 0.0
from splatseg.cli import main
import sys
sys.exit(main(sys.argv[1:]))
"""


def test_a_fit_into_a_log(tmp_path, small) -> None:
    """What a person finds who looks into the log of a long fit."""
    command = [
        sys.executable, "-c", _PROGRAM, "fit", small.scene / "cameras", "-o", tmp_path / "scene",
        "--steps", "8", "--start", "random", "--max-gaussians", "50", "--format", "nerfstudio",
    ]  # fmt: skip
    done = subprocess.run(
        [str(word) for word in command], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    steps = [line for line in done.stderr.splitlines() if line.startswith("fit: step ")]
    assert len(steps) == 8
    assert steps[3].startswith("fit: step 4, loss ")
    assert ", 50 %, 0:0" in steps[3]
    assert "Gaussians" in steps[3]
    assert " left" in steps[3]
    assert "\x1b" not in done.stderr
