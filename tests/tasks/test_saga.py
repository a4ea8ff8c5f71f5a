"""SAGA through the command: 2D features by name, what is no features, and renders of its layer."""

import json
import shutil
from pathlib import Path

import pytest

from splatseg.cli import main
from splatseg.core import Features
from splatseg.io.layers import load_layer
from splatseg.lift.affinity import AffinityHead


@pytest.fixture
def scene(fitted_room, tmp_path) -> Path:
    return shutil.copytree(fitted_room, tmp_path / "scene")


def run(capsys, *words: object) -> tuple[int, str]:
    status = main([str(word) for word in words])
    output = capsys.readouterr()
    return status, output.out + output.err


QUICK = ("--steps", 6, "--batch", 200, "--pixels", 200, "--held-out", 0, "--views", "train")


def test_features_of_a_second_evidence_guide_the_masks(scene, capsys) -> None:
    asked = ("segment", scene, "--method", "saga", "--evidence", "masks_sam", "--backend", "cpu")
    guided = ("--guidance", "features_dino", "--guidance-weight", 1)
    status, said = run(capsys, *asked, *QUICK, *guided, "--layer", "guided", "--json")
    assert status == 0, said
    made = json.loads(said.splitlines()[0])
    layer = load_layer(Path(made["file"]))
    assert isinstance(layer, Features)
    assert layer.info.options["guidance"] == "features_dino"
    head = AffinityHead.of(layer)
    assert head.gated
    assert head.project(layer.values.new_zeros(2, head.projector["weight0"].shape[1])).shape == (
        2,
        32,
    )
    status, said = run(capsys, *asked, *QUICK, "--layer", "x", "--guidance", "masks_nested",
                       "--guidance-weight", 1)  # fmt: skip
    assert status == 2
    assert "guidance: expected evidence of features, got 'masks_nested' of masks" in said
    status, said = run(capsys, *asked, *QUICK, "--layer", "x", "--guidance", "features_no",
                       "--guidance-weight", 1)  # fmt: skip
    assert status == 2
    assert "features_no" in said
    # A layer without a classifier is not rendered as labels.
    status, said = run(capsys, "evaluate", scene, "--layer", "guided", "--truth", scene)
    assert status == 2
