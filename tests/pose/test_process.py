"""Stopping: by Ctrl-C, with the parent, by a failure; and going on afterwards."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from splatseg.errors import BackendError
from splatseg.pose import PoseOptions, PoseProgress, _recover, recover_poses

OPTIONS = PoseOptions(longest=320, threads=1)


@pytest.fixture
def processes(monkeypatch: pytest.MonkeyPatch) -> list[subprocess.Popen[str]]:
    """The processes that were started."""
    started: list[subprocess.Popen[str]] = []

    class Noted(subprocess.Popen):  # type: ignore[type-arg]
        def __init__(self, *words: Any, **named: Any) -> None:
            super().__init__(*words, **named)
            started.append(self)

    monkeypatch.setattr(_recover.subprocess, "Popen", Noted)
    return started


def stop_at(stage: str) -> Callable[[PoseProgress], None]:
    def stop(now: PoseProgress) -> None:
        if now.stage == stage:
            raise KeyboardInterrupt

    return stop


def test_after_ctrl_c_nothing_runs_and_a_second_run_goes_on(
    room: Any, tmp_path: Path, processes: list[subprocess.Popen[str]]
) -> None:
    folder, kept = tmp_path / "in", tmp_path / "capture"
    for i in range(4):
        room.save(i, folder / f"{i}.png")
    with pytest.raises(KeyboardInterrupt):
        recover_poses(folder, folder=kept, options=OPTIONS, progress=stop_at("matches"))
    assert [process.returncode is not None for process in processes] == [True]
    assert [entry.name for entry in kept.iterdir()] == ["work"]
    # Features are not looked for again: without the images they could not be.
    for copy in (kept / "work" / "images").iterdir():
        copy.write_bytes(b"\x89PNG\r\n\x1a\n gone")
    told: list[str] = []

    def until_mapping(now: PoseProgress) -> None:
        told.append(now.stage)
        stop_at("mapping")(now)

    with pytest.raises(KeyboardInterrupt):
        recover_poses(folder, folder=kept, options=OPTIONS, progress=until_mapping)
    assert "mapping" in told
    features = json.loads((kept / "work" / "job.json").read_text())["database"]
    assert Path(features).stat().st_size > 100_000
    # Other options are other work: nothing of the old is used.
    other = PoseOptions(longest=300, threads=1)
    result = recover_poses(folder, folder=kept, options=other)
    assert len(result.report.registered) == 4
    assert sorted(entry.name for entry in kept.iterdir()) == ["poses.json", "sparse"]
    assert all(process.poll() is not None for process in processes)


def test_the_process_ends_with_its_parent(tmp_path: Path) -> None:
    """Its standard input is a pipe from the parent, which closes when the parent is killed."""
    code = (
        "import time; from splatseg.pose._worker import _end_with_parent;"
        " _end_with_parent(); print('up', flush=True); time.sleep(60)"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == "up\n"
        assert process.poll() is None
        process.stdin.close()
        assert process.wait(timeout=20) == 1
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def test_a_failure_is_told_with_its_last_words(tmp_path: Path) -> None:
    job = {"result": str(tmp_path / "result.json"), "options": {"threads": 1}}
    with pytest.raises(
        BackendError, match=r"ended with status 1: .*KeyError: 'database'.*log\.txt"
    ):
        _recover.run_worker(job, tmp_path, progress=lambda stage, done, total: None)


def test_what_a_library_prints_is_passed_over() -> None:
    told: list[tuple[str, int, int]] = []
    for line in ("hello", "3", '{"stage": "x"}', '{"stage": "x", "done": 1, "total": 2}'):
        _recover._pass_on(line, lambda *said: told.append(said))
    assert told == [("x", 1, 2)]


def test_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    assert _recover.usable_threads(5) == 5
    assert _recover.usable_threads(None) == 3
    monkeypatch.setenv("OMP_NUM_THREADS", "none")
    assert _recover.usable_threads(None) >= 1


def test_the_process_needs_neither_torch_nor_pillow() -> None:
    """pycolmap and Pillow in one process end in heap corruption."""
    code = (
        "import sys, splatseg.pose._worker;"
        " print(sorted({'torch', 'PIL', 'cv2'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
