"""A scene fitted in blocks: what it remembers, how it is stopped and goes on, what is refused."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from splatseg.cli import main
from splatseg.errors import InputError
from splatseg.fit import FitOptions
from splatseg.fit._block_fits import refined_steps
from splatseg.io.captures import read_capture
from splatseg.io.scene import load_scene
from splatseg.io.scene_folder import BLOCKS_FOLDER, CHECKPOINT_FILE, is_scene, is_unfinished
from splatseg.tasks import MakeSceneOptions, Observer, describe, fit_capture
from support.elsewhere import Elsewhere
from support.observers import Cancelled, Stopping

FIT = FitOptions(minutes=None, steps=40, max_gaussians=600, seed=4)
OFTEN = MakeSceneOptions(checkpoint_steps=5, blocks=2)
GOING_ON = replace(OFTEN, resume=True)


def made_of(small_room: Path, folder: Path, options: MakeSceneOptions = OFTEN, **more):
    given = {"fit_options": FIT, "backend": "cpu"} | more
    return fit_capture(small_room, folder, options=options, **given)


@pytest.fixture(scope="module")
def straight(small_room, tmp_path_factory) -> Path:
    """A scene in two blocks that nobody stopped."""
    folder = tmp_path_factory.mktemp("straight") / "scene"
    made = made_of(small_room, folder)
    assert made.blocks is not None
    assert not made.interrupted
    assert made.scores is not None
    return folder


def gaussians(folder: Path) -> bytes:
    return (folder / "gaussians.ply").read_bytes()


def test_the_scene_remembers_its_blocks(small_room, straight):
    scene = load_scene(straight)
    record = scene.provenance["blocks"]
    assert len(record["views"]) == len(record["low"]) == len(record["high"]) == 2
    names = {view.name for view in read_capture(small_room).train_views}
    assert set.union(*map(set, record["views"])) == names
    views = sum(map(len, record["views"]))
    fits = 40 * views / len(names)
    assert 1.2 * fits - 2 < scene.provenance["steps"] < 1.5 * fits, "a fifth again, of more views"
    assert 0 < len(scene.gaussians) <= 600
    assert not (straight / "fit").exists(), "a finished fit leaves no checkpoint"
    report = json.loads((straight / "reports" / "fit.json").read_text())
    assert any("2 blocks of" in note for note in report["notes"])
    assert [view.split for view in scene.views].count("test") == 2


def test_a_cancelled_fit_goes_on_from_the_block_it_was_at(small_room, straight, tmp_path):
    folder, stopping = tmp_path / "scene", Stopping("fit", after=50)
    with pytest.raises(Cancelled):
        made_of(small_room, folder, observer=stopping)
    assert sum(" training views, " in line for line in stopping.heard) >= 2
    assert not is_scene(folder), "no scene that is half of one"
    assert is_unfinished(folder)
    assert not (folder / CHECKPOINT_FILE).exists()
    told = describe(folder)
    assert (told["kind"], told["blocks"]) == ("unfinished fit", 2)
    assert 0.5 < told["progress"] < 1
    assert 40 < told["steps"] < load_scene(straight).provenance["steps"]
    hearing = Stopping()
    made_of(small_room, folder, GOING_ON, observer=hearing)
    assert any("going on, 1 of 2 blocks are fitted" in line for line in hearing.heard)
    assert gaussians(folder) == gaussians(straight)
    assert not (folder / BLOCKS_FOLDER).exists()


def test_who_asks_it_to_end_is_told_how_it_goes_on(small_room, straight, tmp_path):
    folder, stopping = tmp_path / "scene", Stopping("fit", after=12, error=KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt, match="0 of 2 blocks are fitted; `resume` goes on"):
        made_of(small_room, folder, observer=stopping)
    assert not is_scene(folder)
    made_of(small_room, folder, GOING_ON)
    assert gaussians(folder) == gaussians(straight)


def test_progress_goes_on_from_fits_to_refinements(small_room, straight, tmp_path):
    class Listening(Observer):
        def __init__(self) -> None:
            self.heard: list[float] = []

        def progress(self, stage: str, done: int, total: int) -> None:
            if stage == "fit":
                self.heard.append(done / total)

    told = Listening()
    made_of(small_room, tmp_path / "scene", observer=told)
    views = load_scene(straight).provenance["blocks"]["views"]
    fits = sum(round(8 * len(one)) for one in views)
    assert told.heard == sorted(told.heard)
    assert told.heard[fits - 1] == pytest.approx(0.8, abs=1e-3)
    assert told.heard[-1] == 1.0


def test_who_stops_a_refinement_loses_no_block(small_room, straight, tmp_path):
    provenance = load_scene(straight).provenance
    fits = sum(round(8 * len(views)) for views in provenance["blocks"]["views"])
    assert fits + 5 < provenance["steps"]
    folder, stopping = tmp_path / "scene", Stopping("fit", after=fits + 5)
    with pytest.raises(Cancelled):
        made_of(small_room, folder, observer=stopping)
    assert not is_scene(folder)
    with pytest.raises(InputError, match="that was stopped at the refinement of its 2 blocks; `re"):
        made_of(small_room, folder)
    hearing = Stopping("fit", after=1000)
    made_of(small_room, folder, GOING_ON, observer=hearing)
    assert any("going on, 2 of 2 blocks are fitted" in line for line in hearing.heard)
    assert hearing.calls == provenance["steps"] - fits
    assert gaussians(folder) == gaussians(straight)


@pytest.fixture
def stopped(small_room, tmp_path) -> Path:
    """A folder in which a fit in two blocks was stopped."""
    with pytest.raises(Cancelled):
        made_of(small_room, tmp_path / "scene", observer=Stopping("fit", after=50))
    return tmp_path / "scene"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {},
            r"got a fit that was stopped at block 2 of 2 \(\d\d %\); `resume` continues it",
        ),
        ({"blocks": "off"}, "got a fit that was stopped at block 2 of 2"),
        ({"blocks": "off", "resume": True}, "expected `blocks` 2, as the fit that is to go on has"),
        (
            {"blocks": 3, "resume": True},
            "expected `blocks` 2, as the fit that is to go on has, got",
        ),
    ],
)
def test_a_stopped_fit_is_not_lost(small_room, stopped, changes, message):
    files = {path.name: path.read_bytes() for path in (stopped / BLOCKS_FOLDER).iterdir()}
    with pytest.raises(InputError, match=message):
        made_of(small_room, stopped, replace(OFTEN, **changes))
    assert files == {path.name: path.read_bytes() for path in (stopped / BLOCKS_FOLDER).iterdir()}


def test_with_overwrite_it_begins_again(small_room, stopped):
    whole = replace(OFTEN, blocks="off", overwrite=True)
    made = made_of(small_room, stopped, whole)
    assert made.blocks is None
    assert "blocks" not in load_scene(stopped).provenance
    assert not (stopped / "fit").exists()


def test_other_options_are_not_gone_on_with(small_room, stopped):
    with pytest.raises(InputError, match="sh_degree 2 instead of 1"):
        made_of(small_room, stopped, GOING_ON, fit_options=replace(FIT, sh_degree=1))


def test_a_fit_as_a_whole_is_not_gone_on_with_in_blocks(small_room, tmp_path):
    whole = replace(OFTEN, blocks="off")
    with pytest.raises(Cancelled):
        made_of(small_room, tmp_path / "scene", whole, observer=Stopping("fit", after=20))
    with pytest.raises(InputError, match="expected no `blocks`, as the fit that is to go on has"):
        made_of(small_room, tmp_path / "scene", GOING_ON)


def test_kept_checkpoints_make_it_longer(small_room, tmp_path):
    folder = tmp_path / "scene"
    made_of(small_room, folder, replace(OFTEN, keep_checkpoint=True))
    assert len(list((folder / BLOCKS_FOLDER).iterdir())) == 2
    assert not any("fit" in note for note in describe(folder)["notes"])
    longer = made_of(small_room, folder, GOING_ON, fit_options=replace(FIT, steps=50))
    views = [len(block.capture.views) for block in longer.blocks.blocks]
    fits = [round(50 * own / 5) for own in views]
    again = sum(map(refined_steps, longer.blocks.blocks, fits))
    assert longer.result.steps == sum(fits) + again
    assert not (folder / BLOCKS_FOLDER).exists()


def test_objects_are_learnt_in_blocks_too(small_room, straight, tmp_path):
    with pytest.raises(InputError, match="nothing_like_it"):
        made_of(small_room, tmp_path / "none", replace(OFTEN, evidence="nothing_like_it"))
    made_of(small_room, tmp_path / "scene", replace(OFTEN, evidence="labels_semantic"))
    assert gaussians(tmp_path / "scene") != gaussians(straight)


def test_the_command_line(small_room, straight, tmp_path, capsys):
    words = ["fit", str(small_room), "--steps", "40", "--max-gaussians", "600", "--seed", "4"]
    words += ["--backend", "cpu"]
    assert main([*words, "-o", str(tmp_path / "scene"), "--blocks", "2", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["blocks"] == 2
    one, other = (load_scene(folder).gaussians for folder in (tmp_path / "scene", straight))
    assert torch.equal(one.means, other.means)
    assert main([*words, "-o", str(tmp_path / "auto"), "--blocks", "auto", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["blocks"] == 1
    assert main([*words, "-o", str(tmp_path / "whole"), "--json"]) == 0
    assert "blocks" not in json.loads(capsys.readouterr().out)
    assert main([*words, "-o", str(tmp_path / "small"), "--longest", "24", "--json"]) == 0
    assert load_scene(tmp_path / "small").provenance["options"]["longest"] == 24
    for wrong in ("0", "6", "many"):
        assert main([*words, "-o", str(tmp_path / "wrong"), "--blocks", wrong]) == 2
        assert "blocks" in capsys.readouterr().err
        assert not (tmp_path / "wrong").exists()


def test_blocks_that_are_fitted_elsewhere_have_the_same_bytes(small_room, straight, tmp_path):
    folder, executor, told = tmp_path / "scene", Elsewhere(), Stopping()
    made_of(small_room, folder, executor=executor, observer=told)
    assert gaussians(folder) == gaussians(straight)
    shared, refining = executor.shared
    assert shared.progress is shared.refining is refining.refining is None
    assert shared.joined is None
    assert refining.joined is not None
    assert shared.checkpoints is not None
    assert shared.checkpoints.path == folder / BLOCKS_FOLDER
    assert shared.checkpoints.steps == 5
    assert shared.checkpoints.failed is not told.note
    assert not (folder / "fit").exists()


@pytest.mark.parametrize("count", [0, -3, 1.5, "some"])
def test_a_number_of_blocks_that_is_none_is_refused_in_words(count):
    words = "blocks: expected one of auto, off or a whole number, at least 1, got "
    with pytest.raises(InputError, match=words):
        MakeSceneOptions(blocks=count)
