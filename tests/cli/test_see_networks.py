"""Segmenters and depth networks from the command line, to a layer and to a fit."""

import json

import numpy as np
import pytest
from PIL import Image

from splatseg.io.evidence import open_evidence
from splatseg.synthetic import cameras, room, write_capture
from support.checkpoints import saved

pytest.importorskip("transformers")

STEPS = ("--steps", 3, "--max-gaussians", 300, "--backend", "cpu", "--quiet")
CPU = ("--device", "cpu", "--size", 64)


def test_from_photographs_to_classes_and_to_a_fit_on_depth(splatseg, tmp_path) -> None:
    capture, scene, weights = tmp_path / "capture", tmp_path / "scene", tmp_path / "weights"
    made = room(seed=2)
    views = cameras(made, train=5, test=2, width=64, height=48)
    write_capture(made, capture, views=views, points=400, seed=2)

    def run(*words: object) -> str:
        status, out, err = splatseg(*words)
        assert status == 0, (words, err)
        return out

    run("fit", capture, "-o", scene, *STEPS)
    words = ("see", scene, "--model", "mask2former", "--weights", saved("mask2former", weights))
    loose = ("--min-score", 0.2, "--min-visible", 0.05, "--mask-threshold", 0.3, "--batch", 2)
    run(*words, "--what", "panoptic,labels", "--evidence", "seen", *loose, *CPU)
    assert open_evidence(scene / "evidence" / "seen").kind == "panoptic"
    run("segment", scene, "--method", "vote", "--evidence", "seen.labels", "--backend", "cpu")
    words = ("see", scene, "--model", "depth-anything", "--weights")
    out = run(*words, saved("depth_anything", weights), "--evidence", "far", *CPU, "--json")
    assert json.loads(out)["kind"] == "depth"
    assert "relative depth on 64x48 pixels" in run("info", scene / "evidence" / "far")
    assert "far" in run("info", scene)
    status, _, err = splatseg("segment", scene, "--method", "vote", "--evidence", "far")
    assert status == 2
    assert "method vote takes evidence of labels or tracked, got depth" in err
    learn = ("--depth", "relative", "--depth-evidence", scene / "evidence" / "far")
    run("fit", capture, "-o", tmp_path / "deeper", *STEPS, *learn)
    status, _, err = splatseg("fit", capture, "-o", tmp_path / "off", *STEPS, *learn[2:])
    assert status == 2
    assert "expected metric or relative with evidence of depth, got off" in err


def test_pictures_of_depth_are_copied_with_their_unit(small, splatseg, tmp_path) -> None:
    folder = tmp_path / "depths"
    folder.mkdir()
    for name in ("train_0", "train_1", "train_3"):
        Image.fromarray(np.full((20, 28), 2500, np.uint16)).save(folder / f"{name}.png")
    words = ("see", small.scene, "--model", folder, "--evidence", "far", "--what", "depth")
    assert splatseg(*words, "--depth-unit", 0.001)[0] == 0
    found = open_evidence(small.scene / "evidence" / "far").depth_map("train_1")
    assert found.kind == "metric"
    assert float(found.values.max()) == 2.5
    status, _, err = splatseg(
        "see", small.scene, "--model", "classical", "--evidence", "e", "--depth-unit", 1
    )
    assert status == 2
    assert "--depth-unit: expected with evidence recorded elsewhere, got model classical" in err


def test_contours_of_a_file_of_weights(small, splatseg, tmp_path) -> None:
    """Learned contours from the command line; the same command again finds its work done."""
    weights = saved("hed", tmp_path)
    words = ("see", small.scene, "--model", "hed", "--weights", weights, "--evidence", "contours")
    status, out, err = splatseg(*words, *CPU, "--json")
    assert status == 0, err
    first = json.loads(out)
    assert (first["kind"], first["model"]) == ("masks", "hed")
    assert first["views"] > first["views_kept"] == 0
    again = json.loads(splatseg(*words, *CPU, "--json")[1])
    assert again["views_kept"] == again["views"] == first["views"]
    status, _, err = splatseg(*words, "--device", "cpu", "--size", 32)
    assert status == 2
    assert "size" in err
