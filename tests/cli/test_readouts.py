"""Layers of features with a classifier, from the command line: rendered, scored and reported."""

import json

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import Features
from splatseg.io.scene import load_scene, load_scene_layer, save_scene_layer
from splatseg.lift import GaussianField, label_map
from splatseg.lift.label_maps import ClassifierHead

CPU = ("--backend", "cpu")
FAST = ("--steps", 40, "--pixels", 200, "--held-out", 0)
LAYERS = {"identity": (), "features": ("--blend", "features")}
"""Layers, and how each is trained."""


@pytest.fixture
def trained(small, splatseg):
    """A layer of rendered readout of each kind."""
    for layer, options in LAYERS.items():
        status, _, err = splatseg(
            "segment", small.scene, "--method", "identity", "--evidence", "labels_semantic",
            "--layer", layer, "--readout", "rendered", *options, *FAST, *CPU,
        )  # fmt: skip
        assert status == 0, err
    return small


def ids_of(path) -> np.ndarray:
    return np.array(Image.open(path)).astype(np.int64)


def test_render_draws_the_layers_own_readout(trained, splatseg, tmp_path) -> None:
    names = [*LAYERS, "identity@hard"]
    status, text, err = splatseg(
        "render", trained.scene, "--what", ",".join(names), "--split", "all", "--coloured",
        "-o", tmp_path / "out", "--json", *CPU,
    )  # fmt: skip
    assert status == 0, err
    entries = json.loads(text)["entries"]
    assert entries == [*names, *(f"{name}_coloured" for name in names)]
    scene = load_scene(trained.scene)
    for name in LAYERS:
        layer = load_scene_layer(trained.scene, name)
        assert isinstance(layer, Features)
        head = ClassifierHead.of(layer)
        for view in scene.views:
            shown = head.label_map(scene.gaussians, view.camera, layer, backend="cpu").ids
            written = ids_of(tmp_path / "out" / name / f"{view.name}.png")
            assert np.array_equal(written, shown.clamp_min(0).numpy())
        legend = json.loads((tmp_path / "out" / name / "legend.json").read_text())
        assert {id: row["name"] for id, row in legend["ids"].items()} == {
            "1": "sky", "2": "left wall", "7": "right wall",
        }  # fmt: skip
    view = scene.views[0]
    layer = load_scene_layer(trained.scene, "identity")
    hard = ClassifierHead.of(layer).labels(layer)
    expected = label_map(scene.gaussians, view.camera, hard, backend="cpu").ids
    written = ids_of(tmp_path / "out" / "identity@hard" / f"{view.name}.png")
    assert np.array_equal(written, expected.clamp_min(0).numpy())


@pytest.mark.parametrize("layer", ["identity", "features", "identity@hard"])
def test_scores_agree_with_the_scorer_on_what_was_written(
    trained, splatseg, score, tmp_path, layer
) -> None:
    out, truth = tmp_path / "out", trained.capture / "semantic"
    status, _, err = splatseg(
        "render", trained.scene, "--what", layer, "--split", "all", "-o", out, *CPU
    )
    assert status == 0, err
    status, text, err = splatseg(
        "evaluate", trained.scene, "--layer", layer, "--truth", truth, "--split", "all",
        "--json", *CPU,
    )  # fmt: skip
    assert status == 0, err
    ours = json.loads(text)
    theirs = score("semantic", "--pred", out / layer, "--truth", truth)
    assert 0.2 < theirs["mIoU"] < 1
    for key in ("mIoU", "fwIoU", "accuracy", "mAcc"):
        assert ours[key] == pytest.approx(theirs[key], abs=1e-9), key
    assert ours["learned_from"] == 3
    status, text, err = splatseg(
        "evaluate", trained.scene, "--layer", layer, "--truth", truth, "--split", "all",
        "--metric", "instances", "--json", *CPU,
    )  # fmt: skip
    assert status == 0, err
    ours, theirs = json.loads(text), score("instances", "--pred", out / layer, "--truth", truth)
    assert ours["mIoU"] == pytest.approx(theirs["mIoU"], abs=1e-9)


def test_points_take_labels_by_the_readout(trained, splatseg, tmp_path) -> None:
    scene = load_scene(trained.scene)
    xyz = scene.gaussians.means[::3].numpy()
    layer = load_scene_layer(trained.scene, "identity")
    found = GaussianField(scene.gaussians, {"p": layer}).labels_at(scene.gaussians.means[::3], "p")
    truth = np.where(xyz[:, 0] < 0, 2, 7)
    np.savez(tmp_path / "points.npz", xyz=xyz, semantic=truth)
    status, text, err = splatseg(
        "evaluate", trained.scene, "--layer", "identity",
        "--points", tmp_path / "points.npz", "--json",
    )  # fmt: skip
    assert status == 0, err
    figures = json.loads(text)
    assert figures["points_accuracy"] == pytest.approx((found.ids.numpy() == truth).mean())


def test_segment_exports_and_reports_rendered_readouts(small, splatseg) -> None:
    status, text, err = splatseg(
        "segment", small.scene, "--method", "identity", "--evidence", "labels_semantic",
        "--layer", "who", "--readout", "rendered", *FAST, "--export", "--report",
        "--truth", small.capture / "semantic", "--json", *CPU,
    )  # fmt: skip
    assert status == 0, err
    made = json.loads(text)
    assert made["kind"] == "features"
    page = (small.scene / "reports" / "who.html").read_text()
    for words in ("Segmentation who", "left wall", "errors in red", "Gaussians with a label"):
        assert words in page, words
    scene, layer = load_scene(small.scene), load_scene_layer(small.scene, "who")
    view = scene.view("test_2")
    shown = ClassifierHead.of(layer).label_map(scene.gaussians, view.camera, layer, backend="cpu")
    truth = ids_of(small.capture / "semantic" / "test_2.png")
    right = (shown.ids.numpy() == truth).mean()
    assert f"{right:.1%} right" in page
    maps = small.scene / "exports" / "who" / "label_maps" / "who" / "test_2.png"
    assert np.array_equal(ids_of(maps), shown.ids.clamp_min(0).numpy())
    assert (small.scene / "exports" / "who" / "labelled.ply").is_file()


def test_what_has_no_labels_is_refused(small, splatseg, tmp_path) -> None:
    count = len(load_scene(small.scene).gaussians)
    save_scene_layer(Features(values=torch.zeros(count, 3)), small.scene, "plain")
    status, _, err = splatseg("render", small.scene, "--what", "plain", "-o", tmp_path / "o")
    assert status == 2
    assert "plain holds features without a classifier, which are no image" in err
    truth = small.capture / "semantic"
    status, _, err = splatseg("evaluate", small.scene, "--layer", "plain", "--truth", truth)
    assert status == 2
    assert "plain holds features without a classifier, which have no score" in err
    status, _, err = splatseg("render", small.scene, "--what", "plain@hard", "-o", tmp_path / "o")
    assert status == 2
