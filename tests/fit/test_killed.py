"""Real processes, killed at any moment: nothing is corrupted, and the end is the same."""

import signal
import time
from pathlib import Path

import numpy as np
import pytest

from splatseg.errors import MissingFileError
from splatseg.fit import checkpoint_summary
from splatseg.io.scene import load_scene
from splatseg.io.scene_folder import CHECKPOINT_FILE, is_scene, is_unfinished
from splatseg.synthetic import cameras, room, write_capture
from support.forked import Forked

STEPS = 150
EVERY = 4
KILLS = 5


@pytest.fixture(scope="module")
def capture_folder(tmp_path_factory) -> Path:
    """A generated room in photographs of 96 x 64 pixels."""
    folder = tmp_path_factory.mktemp("room") / "room"
    scene = room(seed=3)
    views = cameras(scene, width=96, height=64)[::12]
    write_capture(scene, folder, views=views, points=800)
    return folder


def _begin(capture: Path, scene: Path, *words: str, every: int = EVERY) -> Forked:
    command = ["fit", capture, "-o", scene, "--steps", STEPS]
    return Forked(*command, "--max-gaussians", 3000, "--checkpoint-steps", every, *words)


def _ended(process: Forked) -> tuple[int, str, str]:
    with process:
        out, err = process.communicate()
        return process.wait(), out, err


def _steps(scene: Path) -> int:
    """Steps of the last checkpoint. Whatever moment it is, it is whole."""
    try:
        return checkpoint_summary(scene / CHECKPOINT_FILE).steps
    except MissingFileError:
        return 0


def _wait_for(process: Forked, scene: Path, steps: int) -> None:
    deadline = time.monotonic() + 120
    while _steps(scene) < steps and process.poll() is None:
        assert time.monotonic() < deadline, "no progress"
        time.sleep(0.002)


@pytest.fixture(scope="module")
def straight(capture_folder: Path, tmp_path_factory) -> bytes:
    """The Gaussians of a fit that nobody stopped."""
    scene = tmp_path_factory.mktemp("straight") / "scene"
    status, _, err = _ended(_begin(capture_folder, scene))
    assert status == 0, err
    assert not (scene / "fit").exists(), "a finished fit leaves no checkpoint"
    return (scene / "gaussians.ply").read_bytes()


def test_killed_at_any_moment_nothing_is_lost(
    capture_folder: Path, straight: bytes, tmp_path: Path
) -> None:
    rng = np.random.default_rng()  # another moment each time: every one must do
    scene = tmp_path / "scene"
    at = 0
    for kill in range(KILLS):
        process = _begin(capture_folder, scene, "--resume")
        _wait_for(process, scene, at + 1)
        time.sleep(rng.uniform(0, 0.15))
        process.send_signal(signal.SIGKILL)
        status, out, err = _ended(process)
        if status == 0:
            break  # it was faster
        assert status == -signal.SIGKILL, err
        assert is_scene(scene) or is_unfinished(scene)
        assert ("nothing to go on from" if kill == 0 else "going on from step") in out
        if not (scene / CHECKPOINT_FILE).exists() and at > 0:
            # It had finished, and was killed while it scored and reported.
            assert is_scene(scene)
            break
        now = _steps(scene)
        assert now >= at + 1, "a process that wrote checkpoints goes on further than the last"
        at = now
    else:
        status, _, err = _ended(_begin(capture_folder, scene, "--resume"))
        assert status == 0, err
    assert (scene / "gaussians.ply").read_bytes() == straight
    assert load_scene(scene).provenance["steps"] == STEPS
    assert not (scene / CHECKPOINT_FILE).exists()
    assert not is_unfinished(scene)


def test_killed_before_the_first_checkpoint(capture_folder: Path, tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    process = _begin(capture_folder, scene, every=STEPS)
    time.sleep(0.3)
    process.send_signal(signal.SIGKILL)
    _ended(process)
    assert _steps(scene) == 0
    process = _begin(capture_folder, scene, "--resume")
    _wait_for(process, scene, 1)
    process.send_signal(signal.SIGKILL)
    _ended(process)
    assert _steps(scene) >= EVERY


@pytest.mark.parametrize(("number", "again"), [(signal.SIGINT, False), (signal.SIGTERM, True)])
def test_a_stopped_process_leaves_a_scene_and_a_checkpoint(
    capture_folder: Path, straight: bytes, tmp_path: Path, number: int, again: bool
) -> None:
    """One signal, or two, the second while the first is being answered or, under load, later."""
    scene = tmp_path / "scene"
    process = _begin(capture_folder, scene)
    _wait_for(process, scene, 40)
    process.send_signal(number)
    if again:
        time.sleep(0.01)
        process.send_signal(number)
    status, out, err = _ended(process)
    assert status == 1
    assert "interrupted" in err
    assert again or "--resume goes on" in out, "a second one may end the report as well"
    stopped = load_scene(scene)
    stopped.gaussians.check_values()
    assert stopped.provenance["interrupted"] is True
    assert stopped.provenance["steps"] == _steps(scene) >= 40
    status, out, err = _ended(_begin(capture_folder, scene))
    assert status == 2
    assert "--resume continues it, --overwrite begins again" in err
    status, out, err = _ended(_begin(capture_folder, scene, "--resume"))
    assert status == 0, err
    assert f"going on from step {stopped.provenance['steps']}" in out
    assert (scene / "gaussians.ply").read_bytes() == straight
