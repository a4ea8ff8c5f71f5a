"""Photographs are added to a scene that was fitted, and its layers updated."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseg.cli import main
from splatseg.core import Features, Labels
from splatseg.errors import InputError
from splatseg.fit import FitOptions
from splatseg.io.scene import load_scene, load_scene_layer, save_scene, scene_layer_names
from splatseg.methods import method_names
from splatseg.tasks import (
    MakeSceneOptions,
    SegmentOptions,
    fit_capture,
    save_segmentation,
    segment,
)
from support.observers import Cancelled, Stopping

NEW = ("train_0003", "train_0010")
STEPS = FitOptions(steps=6, minutes=None)


@pytest.fixture(scope="module")
def known(fitted_room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The fitted room without two of its views, with a layer of each kind that can be updated."""
    root = tmp_path_factory.mktemp("known") / "scene"
    scene = load_scene(fitted_room)
    views = tuple(view for view in scene.views if view.name not in NEW)
    save_scene(replace(scene, views=views, root=None), root)
    scene = load_scene(root)
    for method, evidence, layer in (
        ("uplift", "labels_semantic", "classes"),
        ("features", "features_dino", "dino"),
        ("associate", "masks_sam", "things"),
    ):
        options = SegmentOptions(evidence=evidence, layer=layer)
        save_segmentation(segment(scene, method, options=options), root)
    return root


@pytest.fixture(scope="module")
def photographs(generated_room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("more")
    for name in NEW:
        shutil.copy(generated_room / "images" / f"{name}.jpg", folder)
    return folder


@pytest.fixture(scope="module")
def grown(known: Path, photographs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("grown") / "scene"
    fit_capture(photographs, folder, options=MakeSceneOptions(add=known), fit_options=STEPS)
    return folder


def test_photographs_are_placed_and_learnt_and_layers_come_along(known, grown, fitted_room) -> None:
    before, after, whole = load_scene(known), load_scene(grown), load_scene(fitted_room)
    assert [view.name for view in after.views] == [view.name for view in before.views] + [*NEW]
    for name in NEW:
        found, true = after.view(name).camera, whole.view(name).camera
        between = found.cam_from_world[:3, :3] @ true.cam_from_world[:3, :3].T
        assert np.degrees(np.arccos((float(between.trace()) - 1) / 2)) < 1.5
        assert float((found.centre - true.centre).norm()) < 0.15
        assert after.view(name).split == "train"
    count = len(before.gaussians)
    assert len(after.gaussians) >= count
    # Every Gaussian keeps its row, and moves a little.
    moved = (after.gaussians.means[:count] - before.gaussians.means).norm(dim=1)
    assert 0 < float(moved.median()) < 0.05
    assert scene_layer_names(grown) == scene_layer_names(known)
    for name in scene_layer_names(known):
        old, new = load_scene_layer(known, name), load_scene_layer(grown, name)
        column, taken = ("values", "values") if isinstance(old, Features) else ("ids", "ids")
        if not isinstance(old, Labels | Features):
            old, new = old.labels, new.labels
        assert torch.equal(getattr(new, taken)[:count], getattr(old, column))
    (record,) = after.provenance["added"]
    assert record["views"] == [*NEW]
    assert record["steps"] == 6
    assert record["gaussians"] == len(after.gaussians) - count


def test_the_number_of_steps_counts(known, photographs, grown, tmp_path) -> None:
    other = tmp_path / "scene"
    options = replace(STEPS, steps=1)
    made = fit_capture(photographs, other, options=MakeSceneOptions(add=known), fit_options=options)
    assert made.result.steps == 201
    one, six = load_scene(other).gaussians, load_scene(grown).gaussians
    assert len(one) == len(six)
    assert not torch.equal(one.means, six.means)


def test_a_capture_of_the_same_world_keeps_its_poses(known, generated_room, tmp_path) -> None:
    folder = tmp_path / "scene"
    fit_capture(
        generated_room,
        folder,
        options=MakeSceneOptions(add=known, format="nerfstudio"),
        fit_options=replace(STEPS, steps=1),
    )
    after, true = load_scene(folder), load_scene(known)
    assert {view.name for view in after.views} == {view.name for view in true.views} | {*NEW}
    written = json.loads((generated_room / "transforms.json").read_text())
    assert len(written["frames"]) == len(after.views)


def test_another_world_nothing_new_and_other_options_are_refused(
    known, generated_room, photographs, tmp_path
) -> None:
    folder = tmp_path / "scene"

    def refused(match: str, data: Path, **options) -> None:
        with pytest.raises(InputError, match=match):
            fit_capture(
                data, folder, options=MakeSceneOptions(add=known, **options), fit_options=STEPS
            )
        assert not folder.exists()

    moved = tmp_path / "moved"
    shutil.copytree(generated_room, moved)
    content = json.loads((moved / "transforms.json").read_text())
    for frame in content["frames"]:
        frame["transform_matrix"][0][3] += 1.0
    (moved / "transforms.json").write_text(json.dumps(content))
    refused("where the scene has it, got another pose", moved, format="nerfstudio")
    old = tmp_path / "old"
    old.mkdir()
    shutil.copy(generated_room / "images" / "train_0000.jpg", old)
    refused("expected a photograph whose name no view of the scene has", old)
    refused("scans: expected none with `add`", photographs, scans=Path("scans"))
    refused("resume: expected none with `add`", photographs, resume=True)
    folder.mkdir()
    (folder / "file").write_text("mine")
    with pytest.raises(InputError, match="expected a new folder"):
        fit_capture(photographs, folder, options=MakeSceneOptions(add=known), fit_options=STEPS)
    assert (folder / "file").read_text() == "mine"


def test_the_command_adds_in_steps(known, photographs, tmp_path, capsys) -> None:
    folder = tmp_path / "scene"
    words = ["fit", str(photographs), "--add", str(known), "-o", str(folder)]
    assert main([*words, "--minutes", "1"]) == 2
    assert "photographs are added in steps (`--steps`), got minutes" in capsys.readouterr().err
    assert not folder.exists()
    assert main([*words, "--steps", "1", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["train_views"] == 16
    assert (folder / "reports" / "fit.html").is_file()


def update(root: Path, method: str, evidence: str, layer: str):
    options = SegmentOptions(evidence=evidence, layer=layer, update=True)
    return segment(load_scene(root), method, options=options)


@pytest.mark.parametrize(
    ("method", "evidence", "layer"),
    [
        ("uplift", "labels_semantic", "classes"),
        ("features", "features_dino", "dino"),
        ("associate", "masks_sam", "things"),
    ],
)
def test_a_layer_is_updated_by_the_new_views_alone(grown, method, evidence, layer) -> None:
    before = load_scene_layer(grown, layer)
    made = update(grown, method, evidence, layer)
    assert [view.name for view in made.views] == [*NEW]
    assert made.layer.info.views == (*before.info.views, *NEW)
    assert made.layer.info.method == before.info.method
    scene = load_scene(grown)
    options = SegmentOptions(evidence=evidence, layer=layer)
    again = segment(scene, method, options=options).layer
    if isinstance(again, Features):
        # Means with weights: what both say is the same up to rounding, but for what has moved.
        apart = (made.layer.values - again.values).norm(dim=1) / again.values.norm(dim=1).clamp_min(
            1e-6
        )
        assert float(apart.median()) < 0.05
        assert not torch.equal(made.layer.values, before.values)
        return
    known, anew = made.labels.ids, (again if isinstance(again, Labels) else again.cut()).ids
    if method == "uplift":
        seen = (made.labels.evidence > 0) & (anew > 0)
        assert float((known == anew)[seen].float().mean()) > 0.9
    assert not torch.equal(
        made.labels.evidence, (before if isinstance(before, Labels) else before.labels).evidence
    )


def test_updates_of_what_cannot_be_updated_are_refused(known, grown) -> None:
    def refused(match: str, root: Path, *how: str) -> None:
        with pytest.raises(InputError, match=match):
            update(root, *how)

    refused("has all 14 views with evidence already", known, "uplift", "labels_semantic", "classes")
    refused("'things' was made by associate", grown, "uplift", "labels_semantic", "things")
    refused("update: expected one of", grown, "uplift", "labels_semantic", "none_such")
    refused("vote starts again", grown, "vote", "labels_semantic", "classes")


def test_methods_that_update_say_so() -> None:
    from splatseg.methods import find_method

    updating = {name for name in method_names() if find_method(name).update is not None}
    assert updating == {"uplift", "features", "associate"}


def test_progress_is_told_and_who_stops_it_finds_nothing_written(
    known, photographs, tmp_path
) -> None:
    folder = tmp_path / "scene"
    told = Stopping("fit", after=3)
    with pytest.raises(Cancelled):
        fit_capture(
            photographs,
            folder,
            options=MakeSceneOptions(add=known),
            fit_options=STEPS,
            observer=told,
        )
    assert not folder.exists()
    assert any("2 of 2 photographs placed" in line for line in told.heard)
    assert any("2 new views" in line for line in told.heard)
    assert told.heard.index("finished poses") < told.heard.index("started fit")
