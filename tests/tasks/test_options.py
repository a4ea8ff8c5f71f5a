"""Options of tasks: each does something, and what cannot be is said in one sentence."""

import json

import pytest
import torch

from splatseg.edit import load_document
from splatseg.errors import InputError
from splatseg.fit import FitOptions
from splatseg.io.scene import load_scene, scene_layer_names
from splatseg.io.scene_folder import CHECKPOINT_FILE
from splatseg.io.splats import read_splats, write_splats
from splatseg.tasks import (
    AttachLayersOptions,
    DemoOptions,
    EditOptions,
    ImportOptions,
    MakeSceneOptions,
    SharpenSceneOptions,
    attach_layers,
    edit_scene,
    fit_capture,
    import_scene,
    see,
    sharpen_scene,
)
from splatseg.tasks.work import check_new_folder, check_replaceable_scene
from support.observers import Stopping

QUICK = FitOptions(minutes=None, steps=6, max_gaussians=300)


@pytest.mark.parametrize(
    ("kind", "values", "says"),
    [
        (MakeSceneOptions, {"checkpoint_every": 0.0}, "checkpoint_every: expected more than 0"),
        (MakeSceneOptions, {"checkpoint_steps": 0}, "checkpoint_steps: expected at least 1"),
        (MakeSceneOptions, {"frames": 0}, "frames: expected at least 1"),
        (SharpenSceneOptions, {"layer": "x", "measure": -1}, "measure: expected at least 0"),
        (ImportOptions, {"max_views": 0}, "max_views: expected at least 1"),
        (ImportOptions, {"width": 8}, "width: expected at least 16"),
        (ImportOptions, {"as_is": True}, "as_is: goes with `data`"),
        (AttachLayersOptions, {"min_found": 1.5}, "min_found: expected a value in"),
        (DemoOptions, {"train_views": 3}, "train_views: expected at least 4"),
        (DemoOptions, {"width": 31}, "width: expected at least 32"),
        (EditOptions, {}, "expected something to do"),
        (EditOptions, {"remove": True, "undo": True}, "remove, undo: expected one of the two"),
        (EditOptions, {"remove": True}, "remove: expected `layer`, `box` or another condition"),
        (EditOptions, {"undo": True, "layer": "x"}, "undo: takes no selection"),
        (EditOptions, {"undo": True, "scale": 2.0}, "undo: takes no `move`"),
        (EditOptions, {"undo": True, "flat_colour": True}, "undo: takes no colours"),
        (EditOptions, {"scale": 2.0, "ids": (1,)}, "ids, names: expected `layer`"),
        (EditOptions, {"scale": 2.0, "invert": True}, "invert: expected `layer`"),
        (EditOptions, {"scale": 2.0, "specks": -1}, "specks: expected at least 0"),
        (EditOptions, {"scale": 2.0, "refit": 3}, "refit, fill: go with `remove` only"),
        (EditOptions, {"undo": True, "fill": "opencv"}, "refit, fill: go with `remove` only"),
        (EditOptions, {"measure": 4}, "measure: this option was removed; pictures=0"),
    ],
)
def test_what_cannot_be_is_refused_before_the_work(kind, values, says) -> None:
    with pytest.raises(InputError, match=says):
        kind(**values)


def test_options_of_making_a_scene(small_room, tmp_path) -> None:
    options = MakeSceneOptions(keep_checkpoint=True, format="nerfstudio")
    made = fit_capture(
        small_room,
        tmp_path / "scene",
        options=options,
        fit_options=QUICK,
        backend="cpu",
        command="splatseg fit words",
    )
    assert made.poses is None
    assert (tmp_path / "scene" / CHECKPOINT_FILE).is_file()
    assert "splatseg fit words" in made.report.read_text(encoding="utf-8")
    with pytest.raises(InputError, match="expected a COLMAP model"):
        fit_capture(small_room, tmp_path / "other", options=MakeSceneOptions(format="colmap"))
    both = MakeSceneOptions(resume=True, overwrite=True)
    with pytest.raises(InputError, match="resume, overwrite: expected one of the two"):
        fit_capture(small_room, tmp_path / "other", options=both)
    sfm = MakeSceneOptions(format="colmap", poses="sfm")
    with pytest.raises(InputError, match="format: expected none with `poses` sfm"):
        fit_capture(small_room, tmp_path / "other", options=sfm)


def test_a_stopped_fit_is_not_lost_by_accident(small_room, tmp_path) -> None:
    folder = tmp_path / "scene"
    stopping = Stopping("fit", after=3, error=KeyboardInterrupt)
    assert fit_capture(small_room, folder, fit_options=QUICK, observer=stopping).interrupted
    with pytest.raises(InputError, match="`resume` continues it, `overwrite` begins again"):
        fit_capture(small_room, folder, fit_options=QUICK)
    again = MakeSceneOptions(overwrite=True)
    assert fit_capture(small_room, folder, fit_options=QUICK, options=again).result.steps == 6


def test_where_a_scene_may_be_written(made, tmp_path) -> None:
    check_new_folder(tmp_path / "new")
    check_replaceable_scene(tmp_path / "new")
    with pytest.raises(InputError, match="a scene with layers"):
        check_replaceable_scene(made)
    with pytest.raises(InputError, match="expected a new folder"):
        check_new_folder(made)
    (tmp_path / "file").write_text("")
    for check in (check_new_folder, check_replaceable_scene):
        with pytest.raises(InputError, match="expected a"):
            check(tmp_path / "file")
        with pytest.raises(InputError, match="expected a place in a folder that is there"):
            check(tmp_path / "no" / "scene")
    fit = tmp_path / "unfinished" / "fit"
    fit.mkdir(parents=True)
    (fit / "checkpoint.npz").write_text("")
    with pytest.raises(InputError, match="expected an empty folder"):
        check_replaceable_scene(fit.parent)


def test_seeing_needs_a_folder(scene) -> None:
    from dataclasses import replace

    with pytest.raises(InputError, match="expected one that was read from its folder"):
        see(replace(scene, root=None), "classical", "masks")


def test_sharpening_measures_and_records(made, tmp_path) -> None:
    from splatseg.lift import SharpenOptions

    done = sharpen_scene(
        load_document(made),
        tmp_path / "new",
        options=SharpenSceneOptions(layer="classes", measure=1, seed=7),
        sharpen_options=SharpenOptions(sharpen_steps=4),
        backend="cpu",
    )
    assert done.measured_views == 1
    assert done.psnr is not None
    facts = load_scene(tmp_path / "new").provenance["sharpened"]
    assert facts["seed"] == 7
    assert facts["scene"] == made.resolve().as_posix()
    assert facts["psnr"] == list(done.psnr)
    assert list(done.agreement) == facts["agreement"]


def test_attaching_takes_the_layers_that_are_named(made, tmp_path) -> None:
    gaussians = read_splats(made / "gaussians.ply")
    edited = tmp_path / "edited.ply"
    write_splats(gaussians[torch.arange(len(gaussians) - 1, -1, -1)], edited)
    done = attach_layers(made, edited, tmp_path / "new")
    assert (done.names, done.table) == (("classes",), None)
    assert done.gaussians == done.attached.report["found"] == len(gaussians)
    names = AttachLayersOptions(layers=("nobody",))
    with pytest.raises(InputError, match="nobody"):
        attach_layers(made, edited, tmp_path / "other", options=names)
    names = AttachLayersOptions(layers=("classes",))
    with pytest.raises(InputError, match="layers: goes with a scene folder"):
        attach_layers(made, edited, tmp_path / "other.ply", options=names)
    names = AttachLayersOptions(layer="classes")
    with pytest.raises(InputError, match="layer: goes with"):
        attach_layers(made, edited, tmp_path / "other", options=names)
    ply = attach_layers(
        made, edited, tmp_path / "l.ply", options=AttachLayersOptions(layer="classes")
    )
    assert ply.table is not None
    assert "class_id" in json.loads(ply.table.read_text())["columns"]
    imported = tmp_path / "imported"
    import_scene(edited, imported, options=ImportOptions(max_views=2, width=32))
    for _ in range(2):
        attach_layers(made, imported, options=AttachLayersOptions(overwrite=True))
    assert scene_layer_names(imported) == ("classes",)
    with pytest.raises(InputError, match="`overwrite` replaces them"):
        attach_layers(made, imported)
    noise = torch.Generator().manual_seed(1)
    count = len(gaussians)
    write_splats(
        gaussians.replace(
            means=torch.rand(count, 3, generator=noise) * 90,
            scales=torch.rand(count, 3, generator=noise) + 0.01,
            opacities=torch.rand(count, generator=noise),
            sh=torch.randn(gaussians.sh.shape, generator=noise),
        ),
        tmp_path / "other.ply",
    )
    strict = AttachLayersOptions(min_found=0.9)
    with pytest.raises(InputError, match="fewer than `min_found` 0.9"):
        attach_layers(made, tmp_path / "other.ply", tmp_path / "x", options=strict)


def test_an_edit_says_what_was_done(made, tmp_path) -> None:
    document = load_document(made)
    layer = document.layers["classes"]
    id = int(layer.ids.mode().values)
    options = EditOptions(extract=True, layer="classes", ids=(id,), cut="off", scale=2.0)
    done = edit_scene(document, tmp_path / "new", options=options, backend="cpu")
    assert [step["kind"] for step in done.operations] == ["extract", "transform"]
    assert done.operations[0]["selected"] == int((layer.ids == id).sum())
    assert done.operations[0]["split"] == 0
    cut = EditOptions(extract=True, layer="classes", ids=(id,), cut="layer")
    done = edit_scene(document, tmp_path / "cut", options=cut, backend="cpu")
    assert done.operations[0]["split"] > 0
    assert done.operations[0]["views"] == 3
    undone = edit_scene(
        load_document(tmp_path / "cut"), tmp_path / "back", options=EditOptions(undo=True)
    )
    assert undone.operations == ({"kind": "undo", "undone": "extract", "edits_left": 0},)
    assert torch.equal(undone.document.scene.gaussians.means, document.scene.gaussians.means)
