"""An observer that raises ends a task: nothing half-written, and what can be resumed goes on."""

from dataclasses import replace

import pytest

from splatseg.edit import load_document
from splatseg.fit import FitOptions
from splatseg.io.evidence import open_evidence
from splatseg.io.scene import load_scene, scene_layer_names
from splatseg.io.scene_folder import CHECKPOINT_FILE, is_scene
from splatseg.tasks import (
    DemoOptions,
    EditOptions,
    ImportOptions,
    MakeSceneOptions,
    SeeOptions,
    SharpenSceneOptions,
    edit_scene,
    fit_capture,
    import_scene,
    make_demo,
    make_scene,
    see,
    sharpen_scene,
)
from support.observers import Cancelled, Stopping

FIT = FitOptions(minutes=None, steps=40, max_gaussians=500, seed=4)
OFTEN = MakeSceneOptions(checkpoint_steps=5)
GOING_ON = replace(OFTEN, resume=True)


def gaussians(folder) -> bytes:
    return (folder / "gaussians.ply").read_bytes()


@pytest.fixture(scope="module")
def straight(small_room, tmp_path_factory) -> bytes:
    """The Gaussians of a scene whose making nobody stopped."""
    folder = tmp_path_factory.mktemp("straight") / "scene"
    made = fit_capture(small_room, folder, fit_options=FIT, options=OFTEN, backend="cpu")
    assert not made.interrupted
    assert made.scores is not None
    assert made.held_out == len(made.scores.views) == 2
    assert made.report.is_file()
    return gaussians(folder)


def test_a_cancelled_fit_goes_on_from_its_last_checkpoint(small_room, straight, tmp_path) -> None:
    folder, stopping = tmp_path / "scene", Stopping("fit", after=17)
    with pytest.raises(Cancelled):
        fit_capture(
            small_room, folder, fit_options=FIT, options=OFTEN, backend="cpu", observer=stopping
        )
    assert stopping.heard[-2:] == ["started fit", "finished fit"]
    assert not is_scene(folder), "no scene that is half of one"
    assert (folder / CHECKPOINT_FILE).is_file()
    hearing = Stopping()
    made = fit_capture(
        small_room, folder, fit_options=FIT, options=GOING_ON, backend="cpu", observer=hearing
    )
    assert any("going on from step 15" in line for line in hearing.heard)
    assert made.result.steps == 40
    assert gaussians(folder) == straight
    assert not (folder / CHECKPOINT_FILE).exists()


def test_a_fit_that_is_stopped_while_it_is_scored_can_be_resumed(
    small_room, straight, tmp_path, monkeypatch
) -> None:
    folder = tmp_path / "scene"
    with monkeypatch.context() as patch:
        patch.setattr(make_scene, "score_and_report", _interrupt)
        with pytest.raises(KeyboardInterrupt):
            fit_capture(small_room, folder, fit_options=FIT, options=OFTEN, backend="cpu")
    assert is_scene(folder)
    assert not (folder / "reports" / "fit.html").exists()
    made = fit_capture(small_room, folder, fit_options=FIT, options=GOING_ON, backend="cpu")
    assert made.report.is_file()
    assert gaussians(folder) == straight
    assert not (folder / CHECKPOINT_FILE).exists()


def _interrupt(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def test_a_fit_that_is_asked_to_end_leaves_a_scene(small_room, straight, tmp_path) -> None:
    folder, stopping = tmp_path / "scene", Stopping("fit", after=17, error=KeyboardInterrupt)
    made = fit_capture(
        small_room, folder, fit_options=FIT, options=OFTEN, backend="cpu", observer=stopping
    )
    assert made.interrupted
    assert made.scores is None
    assert made.result.steps == 18
    assert load_scene(folder).provenance["interrupted"] is True
    fit_capture(small_room, folder, fit_options=FIT, options=GOING_ON, backend="cpu")
    assert gaussians(folder) == straight


def test_seeing_goes_on_where_it_was_stopped(scene, tmp_path) -> None:
    with pytest.raises(Cancelled):
        see(scene, "classical", "masks", observer=Stopping("see", after=2))
    folder = scene.root / "evidence" / "masks"
    assert len(open_evidence(folder, unfinished="allow").view_names) == 2
    assert not list(folder.rglob(".*")), "no file that is half of one"
    seen = see(scene, "classical", "masks")
    assert (seen.views, seen.kept) == (5, 2)
    whole = see(scene, "classical", "again")
    for path in sorted(folder.glob("*.npz")):
        assert path.read_bytes() == (whole.folder / path.name).read_bytes()
    anew = see(scene, "classical", "masks", options=SeeOptions(overwrite=True))
    assert anew.kept == 0


@pytest.mark.parametrize("error", [Cancelled, KeyboardInterrupt])
def test_sharpening_leaves_nothing(made, tmp_path, error) -> None:
    before = sorted(path.name for path in tmp_path.iterdir())
    with pytest.raises(error):
        sharpen_scene(
            load_document(made),
            tmp_path / "new",
            options=SharpenSceneOptions(layer="classes", measure=0),
            backend="cpu",
            observer=Stopping("sharpen", after=3, error=error),
        )
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_editing_leaves_nothing(made, tmp_path) -> None:
    before = sorted(path.name for path in tmp_path.iterdir())
    options = EditOptions(remove=True, layer="classes", ids=(1,))
    with pytest.raises(Cancelled):
        edit_scene(
            load_document(made),
            tmp_path / "new",
            options=options,
            backend="cpu",
            observer=Stopping("remove", after=1),
        )
    assert sorted(path.name for path in tmp_path.iterdir()) == before
    done = edit_scene(load_document(made), tmp_path / "new", options=options, backend="cpu")
    assert done.operations[0]["kind"] == "remove"
    assert scene_layer_names(tmp_path / "new") == ("classes",)


def test_importing_leaves_nothing(made, tmp_path) -> None:
    options = ImportOptions(max_views=3, width=48)
    file = made / "gaussians.ply"
    with pytest.raises(Cancelled):
        import_scene(
            file,
            tmp_path / "new",
            options=options,
            backend="cpu",
            observer=Stopping("placing cameras"),
        )
    assert not (tmp_path / "new").exists()
    done = import_scene(file, tmp_path / "new", options=options, backend="cpu")
    assert len(load_scene(tmp_path / "new").views) == len(done.scene.views) == 3
    assert done.placed is not None
    assert done.alignment is None


def test_a_cancelled_demo_can_be_made_again(tmp_path) -> None:
    options = DemoOptions(steps=12, train_views=4, width=48, max_gaussians=300)
    with pytest.raises(Cancelled):
        make_demo(tmp_path / "demo", options=options, observer=Stopping("see", after=1))
    hearing = Stopping()
    made = make_demo(tmp_path / "demo", options=options, observer=hearing)
    assert made.record["finished"] is True
    assert any(line.startswith("Replacing the earlier demo") for line in hearing.heard)
    assert [line.split()[1] for line in made.record["commands"]].count("segment") == 2


def test_tasks_print_nothing(small_room, made, tmp_path, capsys) -> None:
    options = MakeSceneOptions(checkpoint_steps=10)
    quick = replace(FIT, steps=4)
    fit_capture(small_room, tmp_path / "s", fit_options=quick, options=options, backend="cpu")
    see(load_scene(made), "classical", "masks")
    edit_scene(load_document(made), tmp_path / "e", options=EditOptions(scale=2.0), backend="cpu")
    assert capsys.readouterr() == ("", "")
