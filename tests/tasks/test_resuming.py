"""Methods that train are stopped and go on: to the same bits, or not at all."""

import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from splatseg.cli import main
from splatseg.core import Labels
from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.fit import FitOptions
from splatseg.io.scene import load_scene
from splatseg.io.scene_folder import training_file
from splatseg.lift.training import _train, training_summary
from splatseg.methods import find_method
from splatseg.tasks import (
    CheckpointOptions,
    MakeSceneOptions,
    SegmentOptions,
    describe,
    fit_capture,
    save_segmentation,
    segment,
)
from splatseg.tasks import segment as segment_task
from support.observers import Cancelled, Stopping
from support.products import reordered

STEPS = 24
LAYER = "trained"
ASKED = SegmentOptions(evidence="labels_semantic", layer=LAYER, seed=3)
OFTEN = CheckpointOptions(checkpoint_steps=5)
GOING_ON = replace(OFTEN, resume=True)
TRAINING = ("identity",)


def own(method: str, **changes):
    quick = {"steps": STEPS, "batch": 200, "pixels": 300, "score_every": 8} | changes
    return find_method(method).options(**quick)


def run(scene, method="identity", *, asked=ASKED, checkpoints=OFTEN, observer=None, **changes):
    observer = observer or Stopping()
    return segment(
        scene,
        method,
        options=asked,
        method_options=own(method, **changes),
        checkpoints=checkpoints,
        backend="cpu",
        observer=observer,
    )


def saved(scene, made) -> bytes:
    return save_segmentation(made, scene.root).read_bytes()


@pytest.fixture(scope="module")
def straight(made_room, tmp_path_factory) -> dict[str, bytes]:
    """The layers of trainings that nobody stopped."""
    folder = shutil.copytree(made_room, tmp_path_factory.mktemp("straight") / "scene")
    scene = load_scene(folder)
    return {name: saved(scene, run(scene, name, checkpoints=None)) for name in TRAINING}


def stop(scene, *, after=12, **more) -> Path:
    """Stop a training in its step after so many; gives the checkpoint."""
    with pytest.raises(Cancelled):
        run(scene, observer=Stopping("segment", after=after), **more)
    return training_file(scene.root, LAYER)


@pytest.mark.parametrize("method", TRAINING)
def test_an_interrupted_training_goes_on_to_the_same_bits(scene, straight, method) -> None:
    path = training_file(scene.root, LAYER)
    stopping = Stopping("segment", after=12, error=KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt, match=r"was stopped at step 13 of 24; `resume` goes on"):
        run(scene, method, observer=stopping)
    assert path == scene.root / "training" / "trained.npz"
    assert training_summary(path).step == 13
    hearing = Stopping("segment", after=1000)
    made = run(scene, method, checkpoints=GOING_ON, observer=hearing)
    assert any("going on from step 13 of 24" in line for line in hearing.heard)
    assert hearing.calls == STEPS - 13
    assert path.is_file(), "it stays until the layer is written"
    assert saved(scene, made) == straight[method]
    assert not path.parent.exists()


def test_a_cancelled_training_says_how_it_goes_on(scene, straight) -> None:
    stopping = Stopping("segment", after=6)
    with pytest.raises(Cancelled):
        run(scene, observer=stopping)
    assert "the training was stopped at step 7 of 24; `resume` goes on from" in stopping.heard[-1]
    assert saved(scene, run(scene, checkpoints=GOING_ON)) == straight["identity"]


def test_what_follows_the_training_is_done_again_alone(scene, straight, monkeypatch) -> None:
    """Ctrl-C while labels spread to neighbours."""

    def interrupted(*_args, **_kwargs):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(sys.modules[segment_task.__module__], "complete", interrupted)
        with pytest.raises(KeyboardInterrupt, match="stopped at step 24 of 24"):
            run(scene)
    hearing = Stopping("segment", after=1000)
    made = run(scene, checkpoints=GOING_ON, observer=hearing)
    assert hearing.calls == 0, "nothing was left to train"
    assert saved(scene, made) == straight["identity"]


def test_checkpoints_come_as_often_as_asked_for(scene) -> None:
    path, found = training_file(scene.root, LAYER), []

    class Looking(Stopping):
        def progress(self, stage: str, done: int, total: int) -> None:
            found.append(training_summary(path).step if path.is_file() else 0)

    run(scene, observer=Looking())
    assert found == [0] * 5 + [5] * 5 + [10] * 5 + [15] * 5 + [20] * 4
    assert training_summary(path).step == STEPS
    path.unlink()
    found.clear()
    run(scene, observer=Looking(), checkpoints=CheckpointOptions(checkpoint_every=1e9))
    assert found == [0] * STEPS
    path.unlink()
    found.clear()
    run(scene, observer=Looking(), checkpoints=CheckpointOptions(checkpoint_every=1e-9))
    assert max(found) > 0
    path.unlink()
    found.clear()
    run(scene, observer=Looking(), checkpoints=None)
    assert not path.exists()


def test_only_the_same_training_goes_on(scene) -> None:
    path = stop(scene)
    before = path.read_bytes()

    def refused(says: str, *, where=scene, **more) -> None:
        hearing = Stopping()
        with pytest.raises(InputError, match=says) as error:
            run(where, checkpoints=GOING_ON, observer=hearing, **more)
        assert not any("`resume` goes on" in line for line in hearing.heard)
        assert str(error.value).count(". ") == 0, "one sentence"

    refused(r"one with seed 3 instead of 4\.", asked=replace(ASKED, seed=4))
    refused(r"one with rate 0\.1 instead of 0\.2\.", rate=0.2)
    refused(r"one with steps 24 instead of 25\.", steps=25)
    fewer = tuple(view.name for view in scene.views if view.split == "train")[:4]
    refused("one with other evidence, other views", asked=replace(ASKED, views=fewer))
    other = replace(ASKED, void=int(next(iter(scene.classes.rows)).id))
    refused(r"one with other evidence\.", asked=other)
    moved = scene.gaussians.replace(means=scene.gaussians.means + 0.01)
    refused(r"one with other Gaussians\.", where=replace(scene, gaussians=moved))
    assert path.read_bytes() == before


def test_how_a_training_is_read_may_differ(scene) -> None:
    stop(scene)
    made = run(scene, checkpoints=GOING_ON, readout="rendered", memory=1 << 20)
    assert made.layer.values.shape[1] == 16
    whole = run(scene, checkpoints=None, readout="rendered")
    assert made.layer.values.equal(whole.layer.values)


def test_a_stopped_training_is_not_lost_by_accident(scene, straight) -> None:
    path = stop(scene)
    with pytest.raises(InputError, match="stopped at step 13 of 24; `resume` continues it, `over"):
        run(scene)
    with pytest.raises(InputError, match="resume, overwrite: expected one of the two, got both"):
        run(scene, checkpoints=replace(GOING_ON, overwrite=True))
    assert training_summary(path).step == 13
    assert f"training of layer {LAYER} was stopped at step 13" in describe(scene.root)["notes"][-1]
    hearing = Stopping("segment", after=1000)
    made = run(scene, checkpoints=replace(OFTEN, overwrite=True), observer=hearing)
    assert hearing.calls == STEPS, "from the beginning"
    assert saved(scene, made) == straight["identity"]
    assert not any("training" in note for note in describe(scene.root)["notes"])


def test_a_damaged_checkpoint(scene) -> None:
    path = stop(scene)
    path.write_bytes(b"none")
    with pytest.raises(FileFormatError, match="expected the checkpoint of a training"):
        run(scene, checkpoints=GOING_ON)
    with pytest.raises(InputError, match="cannot be read; `overwrite` begins again"):
        run(scene)
    assert "cannot be read" in describe(scene.root)["notes"][-1]


def test_nothing_to_go_on_from_is_a_beginning(scene, straight) -> None:
    hearing = Stopping()
    made = run(scene, checkpoints=GOING_ON, observer=hearing)
    assert any("nothing to go on from, beginning" in line for line in hearing.heard)
    assert saved(scene, made) == straight["identity"]


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (CheckpointOptions(resume=True), "resume"),
        (CheckpointOptions(overwrite=True), "overwrite"),
        (CheckpointOptions(checkpoint_every=5.0), "checkpoint_every"),
        (CheckpointOptions(checkpoint_steps=5), "checkpoint_steps"),
    ],
)
@pytest.mark.parametrize("method", ["uplift", "vote"])
def test_methods_that_do_not_train_refuse(scene, method, options, named) -> None:
    with pytest.raises(InputError, match=f"^{named}: expected a method that trains, got {method}"):
        segment(scene, method, options=ASKED, checkpoints=options, backend="cpu")
    made = segment(scene, method, options=ASKED, checkpoints=CheckpointOptions(), backend="cpu")
    assert isinstance(made.layer, Labels)
    assert made.checkpoint is None
    assert not (scene.root / "training").exists()


def test_a_scene_without_a_folder_keeps_nothing(scene) -> None:
    asked = replace(ASKED, evidence="labels_semantic")
    nowhere = replace(scene, root=None)
    with pytest.raises(InputError, match="checkpoints: expected a scene with a folder"):
        run(nowhere, asked=asked)
    assert run(nowhere, asked=asked, checkpoints=None).checkpoint is None


WORDS = [
    "--method", "identity", "--evidence", "labels_semantic", "--layer", LAYER, "--seed", "3",
    "--steps", str(STEPS), "--batch", "200", "--pixels", "300", "--score-every", "8",
    "--checkpoint-steps", "2", "--backend", "cpu",
]  # fmt: skip


def steps_done(folder: Path) -> int:
    """Steps of the checkpoint, which is whole at any moment."""
    try:
        return training_summary(training_file(folder, LAYER)).step
    except MissingFileError:
        return 0


@pytest.mark.skipif(reordered(), reason="another process has other products")
def test_killed_between_two_checkpoints(made, straight, capsys) -> None:
    # Each step takes a moment, so that the process can be met between two.
    program = (
        "import sys, time, splatseg.cli, splatseg.tasks.segment\n"
        "from splatseg.lift.training import _train\n"
        "step = _train._Run.advance\n"
        "_train._Run.advance = lambda run: (time.sleep(0.05), step(run))\n"
        "sys.exit(splatseg.cli.main())"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program, "segment", str(made), *WORDS],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=os.environ | {"OMP_NUM_THREADS": "1", "SPLATSEG_THREADS": "1"},
    )
    deadline = time.monotonic() + 120
    while steps_done(made) < 6 and process.poll() is None:
        assert time.monotonic() < deadline, "no progress"
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    assert process.wait(timeout=120) == -signal.SIGKILL
    at = steps_done(made)
    assert at >= 6
    assert main(["segment", str(made), *WORDS]) == 2
    assert "--resume continues it, --overwrite begins again" in capsys.readouterr().err
    assert main(["segment", str(made), *WORDS, "--resume"]) == 0
    assert f"going on from step {at} of {STEPS}" in capsys.readouterr().out
    assert (made / "layers" / f"{LAYER}.npz").read_bytes() == straight["identity"]
    assert not (made / "training").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_command_with_one_sentence(
    made, straight, capsys, monkeypatch, number
) -> None:
    step = _train._Run.advance

    def interrupted(run) -> None:
        step(run)
        if run.state.step == 7:
            signal.raise_signal(number)

    with monkeypatch.context() as patch:
        patch.setattr(_train._Run, "advance", interrupted)
        assert main(["segment", str(made), *WORDS]) == 1
    err = capsys.readouterr().err
    (line,) = [line for line in err.splitlines() if line.startswith("interrupted")]
    assert "the training was stopped at step 7 of 24; --resume goes on from" in line
    assert not (made / "layers" / f"{LAYER}.npz").exists()
    assert main(["segment", str(made), *WORDS, "--resume"]) == 0
    assert (made / "layers" / f"{LAYER}.npz").read_bytes() == straight["identity"]


def test_what_is_refused_is_not_said_to_go_on(scene, small_room, tmp_path) -> None:
    stop(scene)
    hearing = Stopping("segment", after=1000)
    with pytest.raises(InputError, match="got one with batch 200 instead of 100"):
        run(scene, checkpoints=GOING_ON, observer=hearing, batch=100)
    assert not any("going on" in line for line in hearing.heard)
    fit_options = FitOptions(minutes=None, steps=40, max_gaussians=500)
    often = MakeSceneOptions(checkpoint_steps=5)
    stopping = Stopping("fit", after=8)
    with pytest.raises(Cancelled):
        fit_capture(
            small_room, tmp_path / "new", fit_options=fit_options, options=often, observer=stopping
        )
    hearing = Stopping()
    with pytest.raises(InputError, match="seed 0 instead of 1"):
        fit_capture(
            small_room,
            tmp_path / "new",
            fit_options=replace(fit_options, seed=1),
            options=replace(often, resume=True),
            observer=hearing,
        )
    assert not any("going on" in line for line in hearing.heard)
