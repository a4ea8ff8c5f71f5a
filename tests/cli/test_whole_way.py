"""From photographs to objects in files: each command on what the one before it left.

The capture is the generated room, with evidence as other programs write it. Bounds are well
below what is reached, and well above what a layer of one id or of chance reaches.
"""

import json
import shutil
from pathlib import Path

import pytest
import torch

from splatseg.core import InstanceTree, Labels
from splatseg.io.captures import read_capture
from splatseg.io.scene import load_scene, load_scene_layer
from splatseg.io.splats import read_splats, write_splats

CPU = ("--backend", "cpu")
TRAINED = ("--steps", 200, "--pixels", 2000)


@pytest.fixture
def room(fitted_room: Path, tmp_path: Path) -> Path:
    """A copy of the fitted scene that a test may change."""
    return shutil.copytree(fitted_room, tmp_path / "room")


@pytest.fixture
def run(splatseg):
    """A command that must succeed; what it printed."""

    def invoke(*words: object) -> str:
        status, out, err = splatseg(*words)
        assert status == 0, (words, err)
        return out

    return invoke


@pytest.fixture
def scored(room, run, generated_room):
    """Figures of a layer in the held-out views."""

    def invoke(layer: str, metric: str = "semantic") -> dict:
        truth = generated_room / ("instance" if metric == "instances" else "semantic")
        words = ("--layer", layer, "--truth", truth, "--metric", metric, "--json", *CPU)
        return json.loads(run("evaluate", room, *words))

    return invoke


@pytest.fixture
def classes(room, run) -> str:
    run("segment", room, "--method", "uplift", "--evidence", "labels_semantic", *CPU)
    return "labels_semantic"


def test_the_fit_shows_held_out_views(room, run) -> None:
    assert json.loads(run("evaluate", room, "--json", *CPU))["PSNR"] > 20
    assert "scene, " in run("info", room)


@pytest.mark.parametrize(
    ("method", "options"),
    [("uplift", ()), ("vote", ()), ("identity", TRAINED)],
)
def test_classes_of_label_maps(room, run, scored, method, options) -> None:
    words = ("--method", method, "--evidence", "labels_semantic", "--layer", "classes")
    run("segment", room, *words, *options, *CPU)
    figures = scored("classes")
    assert figures["accuracy"] > 0.7
    assert figures["mIoU"] > 0.3


@pytest.mark.parametrize(
    ("evidence", "at_least"),
    [
        ("labels_panoptic", 0.35),
        ("labels_tracked", 0.35),
        ("masks_sam", 0.35),  # they overlap
        ("masks_nested", 0.3),  # parts, objects and groups in every view
    ],
)
def test_instances_of_every_kind_of_evidence(room, run, scored, evidence, at_least) -> None:
    run("segment", room, "--method", "associate", "--evidence", evidence, *CPU)
    figures = scored(evidence, "instances")
    assert figures["predicted_instances"] > 10
    assert figures["mIoU"] > at_least


def test_a_tree_has_levels_that_find_what_the_default_cut_takes_together(room, run, scored) -> None:
    run("segment", room, "--method", "associate", "--evidence", "masks_nested", *CPU)
    tree = load_scene_layer(room, "masks_nested")
    assert isinstance(tree, InstanceTree)
    assert {node.level for node in tree.nodes} >= {"object", "part"}
    finer = scored("masks_nested@part", "instances")
    assert finer["mIoU"] > 0.45
    counts = [len(tree.cut(level).present) for level in ("group", "object", "part")]
    assert counts == sorted(counts)
    assert counts[2] > counts[1]


def test_votes_of_masks_are_sharpened_unless_that_is_switched_off(room, run) -> None:
    masks = ("--method", "associate", "--evidence", "masks_sam", *CPU)
    run("segment", room, *masks, "--layer", "sharpened")
    run("segment", room, *masks, "--layer", "votes", "--no-sharpen-votes")
    sharpened, votes = (load_scene_layer(room, name) for name in ("sharpened", "votes"))
    assert isinstance(sharpened, InstanceTree)
    assert isinstance(votes, InstanceTree)
    assert sharpened.labels.shares is not None
    assert votes.labels.shares is None
    assert {node.id for node in sharpened.nodes} == {node.id for node in votes.nodes}


def test_masks_of_a_model_become_instances(room, run) -> None:
    some = ("--views", "train_0000,train_0001,train_0002")
    run("see", room, "--model", "classical", "--evidence", "masks", *some)
    run("segment", room, "--method", "associate", "--evidence", "masks", *CPU)
    layer = load_scene_layer(room, "masks")
    assert isinstance(layer, InstanceTree)
    assert len(layer.cut().present) > 3


def test_sharpened_gaussians_agree_more_with_their_labels(room, run, classes, tmp_path) -> None:
    quick = ("--sharpen-steps", 40)
    plain = (*quick, "--no-correct-confusion", *CPU)
    run("sharpen", room, "-o", tmp_path / "sharp", "--layer", classes, *plain)
    first, last = load_scene(tmp_path / "sharp").provenance["sharpened"]["agreement"]
    assert last > first


def test_objects_leave_in_files_and_come_back(room, run, classes, tmp_path) -> None:
    """Export, import, attach and edit: the floor by itself, labels on a cropped file, no floor."""
    scene, layer = load_scene(room), load_scene_layer(room, classes)
    assert isinstance(layer, Labels)
    floor = layer.ids == 2
    assert 50 < int(floor.sum()) < len(layer) - 50
    run("export", room, "--what", "objects", "--layer", classes, "-o", tmp_path / "objects")
    (file,) = (tmp_path / "objects").rglob("*floor*.ply")
    assert len(read_splats(file)) == int(floor.sum())
    run("import", file, "-o", tmp_path / "floor", "--max-views", 13, "--width", 64)
    assert len(load_scene(tmp_path / "floor").gaussians) == int(floor.sum())

    kept = torch.randperm(len(layer), generator=torch.Generator().manual_seed(3))[: len(layer) // 2]
    write_splats(scene.gaussians[kept], tmp_path / "cropped.ply")
    run("attach", room, tmp_path / "cropped.ply", "-o", tmp_path / "attached")
    again = load_scene_layer(tmp_path / "attached", classes)
    assert isinstance(again, Labels)
    assert torch.equal(again.ids, layer.ids[kept])

    words = ("--remove", "--layer", classes, "--names", "floor", "--cut", "off")
    run("edit", room, "-o", tmp_path / "bare", *words)
    left = load_scene_layer(tmp_path / "bare", classes)
    assert isinstance(left, Labels)
    assert torch.equal(left.ids, layer.ids[~floor])


def test_a_path_through_the_room(room, run, classes, tmp_path) -> None:
    words = ("--split", "path", "--frames", 3, "--what", f"rgb,depth,{classes}")
    run("render", room, *words, "-o", tmp_path / "path", *CPU)
    assert len(read_capture(tmp_path / "path").views) == 3
    for what in ("rgb", "depth", classes):
        assert len(list((tmp_path / "path" / what).glob("*.png"))) == 3
