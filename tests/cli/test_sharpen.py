"""`splatseg sharpen` as a person types it."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import (
    Labels,
    LayerInfo,
    Selection,
)
from splatseg.errors import InputError
from splatseg.fit import recorded_exposures
from splatseg.io.evidence import open_evidence
from splatseg.io.images import save_png
from splatseg.io.scene import load_scene, load_scene_layer, save_scene_layer
from splatseg.render import render

QUICK = ("--sharpen-steps", 60, "--no-correct-confusion")


@pytest.fixture(autouse=True)
def rates_of_a_fit_that_begins(monkeypatch) -> None:
    """Few steps move much."""
    monkeypatch.setattr("splatseg.lift.boundaries.sharpen._RATES_FROM", 0.0)
    monkeypatch.setattr("splatseg.lift.boundaries.sharpen.DECIDE_EVERY", 30)


@pytest.fixture
def labelled(small, splatseg):
    """The small scene with a layer of its recorded classes, and a selection beside it."""
    status, _, said = splatseg(
        "segment", small.scene, "--method", "uplift", "--evidence", "labels_semantic", "--data",
        small.capture, "--layer", "classes",
    )  # fmt: skip
    assert status == 0, said
    count = len(load_scene(small.scene).gaussians)
    save_scene_layer(Selection(mask=torch.arange(count) < 5), small.scene, "picked")
    return small


def sharpened(splatseg, labelled, out, *more):
    return splatseg(
        "sharpen", labelled.scene, "-o", out, "--layer", "classes", "--data", labelled.capture,
        *QUICK, *more,
    )  # fmt: skip


def test_a_new_scene_with_all_layers_and_what_was_done(labelled, splatseg, tmp_path) -> None:
    status, out, said = sharpened(splatseg, labelled, tmp_path / "new", "--label-weight", 1)
    assert status == 0, said
    assert "light of labelled pixels that comes from Gaussians of their label" in out
    assert "PSNR in 1 views" in out
    before, after = load_scene(labelled.scene), load_scene(tmp_path / "new")
    assert len(before.gaussians) == len(after.gaussians)
    assert not torch.equal(before.gaussians.means, after.gaussians.means)
    assert [view.name for view in after.views] == [view.name for view in before.views]
    facts = after.provenance["sharpened"]
    assert facts["layer"] == "classes"
    first, last = facts["agreement"]
    assert last > first
    assert facts["psnr"][0] > 20
    assert facts["psnr"][1] > 20
    old, new = (load_scene_layer(root, "classes") for root in (labelled.scene, tmp_path / "new"))
    assert isinstance(old, Labels)
    assert isinstance(new, Labels)
    assert new.info.names == old.info.names
    assert new.info.evidence == "labels_semantic"
    assert new.info.edit("sharpen")["agreement"] == [first, last]
    assert float((new.ids == old.ids).float().mean()) > 0.9
    picked = load_scene_layer(tmp_path / "new", "picked")
    assert isinstance(picked, Selection)
    assert picked.count == 5


def test_the_same_again_and_never_over_what_is_there(labelled, splatseg, tmp_path) -> None:
    for name in ("one", "two"):
        assert sharpened(splatseg, labelled, tmp_path / name)[0] == 0
    one, two = (load_scene(tmp_path / name).gaussians for name in ("one", "two"))
    assert torch.equal(one.means, two.means)
    assert torch.equal(one.opacities, two.opacities)
    status, _, said = sharpened(splatseg, labelled, tmp_path / "one")
    assert status == 2
    assert "expected a new folder" in said


def test_segments_of_views_take_the_ids_of_the_layer(labelled, splatseg, tmp_path) -> None:
    """Panoptic segments whose own ids differ from view to view."""
    scene = load_scene(labelled.scene, data=labelled.capture)
    found = open_evidence(labelled.capture / "labels_semantic")
    folder = labelled.capture / "labels_panoptic"
    folder.mkdir()
    tables = {}
    for index, view in enumerate(scene.train_views):
        ids = found.label_map(view.name).ids.numpy()
        own = np.where(ids > 0, (ids * 7 + 31 * index) % 251 + 1, 0)
        rows = [{"id": int(i), "category_id": 0} for i in np.unique(own) if i]
        tables[view.name] = {"segments_info": rows}
        Image.fromarray(own.astype(np.uint16)).save(folder / f"{view.name}.png")
    (folder / "segments.json").write_text(json.dumps(tables))
    segments, wide = ("--evidence", "labels_panoptic"), ("--label-weight", 1)
    status, out, said = sharpened(splatseg, labelled, tmp_path / "new", *segments, *wide)
    assert status == 0, said + out
    assert sharpened(splatseg, labelled, tmp_path / "maps", *wide)[0] == 0
    first, second = (load_scene(tmp_path / name) for name in ("new", "maps"))
    # Segments that were once these maps say what the maps say.
    agreement = first.provenance["sharpened"]["agreement"]
    assert agreement == pytest.approx(second.provenance["sharpened"]["agreement"], abs=0.02)
    layer = load_scene_layer(tmp_path / "new", "classes")
    assert isinstance(layer, Labels)
    assert set(layer.present.tolist()) <= {1, 2, 7}


def test_an_edited_scene_begins_anew(labelled, splatseg, tmp_path) -> None:
    """Edits are done again on the scene that was edited first, which is not the sharpened one."""
    edit = ("edit", labelled.scene, "-o", tmp_path / "red", "--colour-scale", 1.1, 1, 1)
    assert splatseg(*edit, "--data", labelled.capture)[0] == 0
    status, _, said = splatseg(
        "sharpen", tmp_path / "red", "-o", tmp_path / "new", "--layer", "classes", "--data",
        labelled.capture, *QUICK,
    )  # fmt: skip
    assert status == 0, said
    assert "edits" in load_scene(tmp_path / "red").provenance
    assert "edits" not in load_scene(tmp_path / "new").provenance
    assert "edited_from" not in load_scene(tmp_path / "new").provenance


def test_evidence_of_the_scene_itself_comes_along(labelled, splatseg, tmp_path) -> None:
    """So that the new scene can be segmented again; evidence of the capture is there anyway."""
    assert sharpened(splatseg, labelled, tmp_path / "first")[0] == 0
    assert not (tmp_path / "first" / "evidence" / "labels_semantic").exists()
    own = labelled.scene / "evidence" / "labels_semantic"
    shutil.move(labelled.capture / "labels_semantic", own)
    assert sharpened(splatseg, labelled, tmp_path / "second")[0] == 0
    copied = tmp_path / "second" / "evidence" / "labels_semantic"
    names = sorted(path.name for path in own.iterdir())
    assert sorted(path.name for path in copied.iterdir()) == names
    assert all((copied / name).read_bytes() == (own / name).read_bytes() for name in names)
    again = ("segment", tmp_path / "second", "--method", "uplift", "--data", labelled.capture)
    status, _, said = splatseg(*again, "--evidence", "labels_semantic", "--layer", "again")
    assert status == 0, said


def test_views_are_those_of_the_layer(labelled) -> None:
    from splatseg.tasks.sharpen import views_to_learn_from as _views

    scene = load_scene(labelled.scene, data=labelled.capture)
    every = open_evidence(labelled.capture / "semantic")
    layer = load_scene_layer(labelled.scene, "classes")
    assert isinstance(layer, Labels)
    train = [view.name for view in scene.train_views]
    assert [view.name for view in _views(scene, layer, every)] == train
    assert len(train) < len(scene.views)
    test = replace(layer, info=LayerInfo(views=("test_2", "train_0")))
    assert [view.name for view in _views(scene, test, every)] == ["train_0", "test_2"]
    unknown = replace(layer, info=LayerInfo())
    assert [view.name for view in _views(scene, unknown, every)] == train
    with pytest.raises(InputError, match="expected evidence of a view"):
        _views(scene, replace(layer, info=LayerInfo(views=("nobody",))), every)


def test_label_maps_of_something_else_are_refused(labelled, splatseg, tmp_path) -> None:
    """Whether their ids mean what the layer's do is not known."""
    shutil.copytree(labelled.capture / "labels_semantic", labelled.capture / "labels_other")
    status, _, said = sharpened(splatseg, labelled, tmp_path / "new", "--evidence", "labels_other")
    assert status == 2
    assert "labels_other is labels" in said


def test_the_fit_goes_on_as_it_was(labelled) -> None:
    from splatseg.tasks.sharpen import fit_options_of as _fit_options

    scene = load_scene(labelled.scene, data=labelled.capture)
    unknown = _fit_options(scene, scene.views)
    assert (unknown.background, unknown.masks) == ("black", "off")
    said = {"options": {"masks": "ignore", "depth": "metric"}}
    known = replace(scene, provenance=said)
    assert _fit_options(known, scene.views).depth == "off", "no view has a depth map"
    measured = tuple(replace(view, depth=view.image) for view in scene.views)
    assert _fit_options(known, measured).depth == "metric"


def cut_out(scene_folder, data):
    """The scene as if it had been fitted with --masks alpha before a yellow backdrop."""
    record = scene_folder / "scene.json"
    content = json.loads(record.read_text())
    content["provenance"] = {"options": {"masks": "alpha", "background": "random"}}
    record.write_text(json.dumps(content))
    scene = load_scene(scene_folder, data=data)
    cameras = scene_folder / "cameras" / "transforms.json"
    frames = json.loads(cameras.read_text())
    (scene_folder / "masks").mkdir()
    for view, frame in zip(scene.views, frames["frames"], strict=True):
        drawn = render(scene.gaussians, view.camera, backend="cpu")
        alpha, backdrop = drawn.alpha.unsqueeze(-1), torch.tensor([1.0, 0.9, 0.2])
        colour = torch.where(alpha > 0.02, drawn.image / alpha.clamp_min(0.02), backdrop)
        save_png(colour.clamp(0, 1), view.image)
        save_png(drawn.alpha, scene_folder / "masks" / f"{view.name}.png")
        frame["mask_path"] = f"../masks/{view.name}.png"
    cameras.write_text(json.dumps(frames))


def test_a_scene_that_was_cut_out_by_its_masks_stays_what_it_is(
    labelled, splatseg, tmp_path
) -> None:
    """Its backdrop is not in the scene: compared with it, everything would turn yellow."""
    cut_out(labelled.scene, labelled.capture)
    status, _, said = sharpened(splatseg, labelled, tmp_path / "new", "--label-weight", 0.1)
    assert status == 0, said
    before, after = load_scene(tmp_path / "new").provenance["sharpened"]["psnr"]
    assert before > 50
    assert after > 35


def test_exposures_of_the_fit_are_gone_on_from_and_kept(labelled, splatseg, tmp_path) -> None:
    """Photographs of half the brightness: the scene does not darken, as its exposures say so."""
    record = labelled.scene / "scene.json"
    content = json.loads(record.read_text())
    scene = load_scene(labelled.scene, data=labelled.capture)
    half = {"gain": [0.5, 0.5, 0.5], "bias": [0.0, 0.0, 0.0]}
    content["provenance"] = {
        "options": {"background": "black", "masks": "off", "exposure": True},
        "exposures": {view.name: half for view in scene.train_views},
    }
    record.write_text(json.dumps(content))
    for view in scene.train_views:
        Image.fromarray(np.asarray(Image.open(view.image)) // 2).save(view.image)
    status, _, said = sharpened(splatseg, labelled, tmp_path / "new")
    assert status == 0, said
    provenance = load_scene(tmp_path / "new").provenance
    assert provenance["sharpened"]["psnr"][1] > 35
    found = recorded_exposures(provenance)
    assert sorted(found) == sorted(view.name for view in scene.train_views)
    gains = torch.tensor([one.gain for one in found.values()])
    assert float(gains.log().mean().exp()) == pytest.approx(0.5, abs=1e-4)
    assert bool((gains != 0.5).all()), "those learned are written, not those that were there"


def test_nothing_is_measured_if_not_asked(labelled, splatseg, tmp_path) -> None:
    status, out, _ = sharpened(splatseg, labelled, tmp_path / "new", "--measure", 0)
    assert status == 0
    assert "PSNR" not in out


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--layer", "none"), "expected one of the scene (classes, picked), got 'none'"),
        (("--layer", "picked"), "expected labels"),
        (("--evidence", "nowhere"), "nowhere"),
        (("--measure", -1), "--measure"),
        (("-o", "{tmp}/no/such/place"), "expected a place in a folder that is there"),
    ],
)
def test_refused_in_one_sentence(labelled, splatseg, tmp_path, arguments, says) -> None:
    given = {"--layer": "classes", "-o": f"{tmp_path}/new"}
    given |= {str(arguments[0]): str(arguments[1]).format(tmp=tmp_path)}
    flat = [part for pair in given.items() for part in pair]
    status, _, said = splatseg("sharpen", labelled.scene, "--data", labelled.capture, *QUICK, *flat)
    assert status == 2
    assert says in said
    assert len(said.strip().splitlines()) <= 2
    assert not (tmp_path / "new").exists()


def test_a_layer_of_unknown_origin_needs_evidence(labelled, splatseg, tmp_path) -> None:
    count = len(load_scene(labelled.scene).gaussians)
    ids = torch.ones(count, dtype=torch.int32)
    save_scene_layer(Labels(ids=ids, confidence=torch.ones(count)), labelled.scene, "hand")
    arguments = ("sharpen", labelled.scene, "-o", tmp_path / "new", "--layer", "hand")
    status, _, said = splatseg(*arguments, "--data", labelled.capture)
    assert status == 2
    assert "does not say what it was made from" in said
    status, _, said = splatseg(
        *arguments, "--data", labelled.capture, "--evidence", "labels_semantic"
    )
    assert status == 2
    assert "expected the label maps that layer hand was made from" in said


def test_an_interruption_leaves_nothing(labelled, splatseg, tmp_path, monkeypatch) -> None:
    from splatseg.tasks import sharpen as command

    def stopped(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "sharpen", stopped)
    status, _, _ = sharpened(splatseg, labelled, tmp_path / "new")
    assert status == 1
    assert not (tmp_path / "new").exists()
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


def test_what_no_pixel_shows_keeps_its_label(labelled) -> None:
    from splatseg.lift import Sharpened
    from splatseg.tasks.sharpen import merged

    old = Labels(
        ids=torch.tensor([2, 7, 7], dtype=torch.int32),
        confidence=torch.tensor([0.9, 0.8, 0.3]),
        evidence=torch.tensor([5.0, 4.0, 0.0]),
        inferred=torch.tensor([False, True, True]),
        info=LayerInfo(names={2: "wall"}),
    )
    new = Labels(
        ids=torch.tensor([2, 2, -1], dtype=torch.int32),
        confidence=torch.tensor([1.0, 0.7, 0.0]),
        evidence=torch.tensor([6.0, 3.0, 0.0]),
        info=LayerInfo().with_edit("sharpen", {}),
    )
    scene = load_scene(labelled.scene).gaussians
    found = merged(old, Sharpened(gaussians=scene, labels=new, agreement=(0.5, 0.6)))
    assert found.ids.tolist() == [2, 2, 7]
    torch.testing.assert_close(found.confidence, torch.tensor([1.0, 0.7, 0.3]))
    assert found.evidence is not None
    assert found.evidence.tolist() == [6.0, 3.0, 0.0]
    assert found.inferred is not None
    assert found.inferred.tolist() == [False, False, True]
    assert found.info.names == {2: "wall"}
