"""SAGA through the command: 2D features by name, what is no features, and renders of its layer."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from splatseg.cli import main
from splatseg.core import Features
from splatseg.errors import InputError
from splatseg.io.layers import load_layer
from splatseg.io.scene import load_scene
from splatseg.lift.affinity import AffinityHead
from splatseg.methods import find_method
from splatseg.methods.saga import SagaOptions
from splatseg.tasks.segment_inputs import with_companions
from splatseg.tasks.work import Work


@pytest.fixture
def scene(fitted_room, tmp_path) -> Path:
    return shutil.copytree(fitted_room, tmp_path / "scene")


def run(capsys, *words: object) -> tuple[int, str]:
    status = main([str(word) for word in words])
    output = capsys.readouterr()
    return status, output.out + output.err


QUICK = ("--steps", 6, "--batch", 200, "--held-out", 0, "--views", "train")


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


def test_the_published_setting_is_guided_by_what_is_at_hand(scene, capsys) -> None:
    """The features that are taken are said and recorded; selections follow the paper."""
    asked = ("segment", scene, "--method", "saga", "--evidence", "masks_sam", "--backend", "cpu")
    few = ("--published", "--steps", 3, "--grid", 12)
    status, said = run(capsys, *asked, *few, "--layer", "paper")
    assert status == 0, said
    assert "guidance: features_dino, of " in said
    layer = load_layer(scene / "layers" / "paper.npz")
    assert layer.info.options["guidance"] == "features_dino"
    assert AffinityHead.of(layer).projector
    assert str(layer.info.details["trained"]).startswith("published, 3 steps")
    status, said = run(capsys, *asked, *few, "--layer", "alone", "--guidance", "None")
    assert status == 0, said
    assert not AffinityHead.of(load_layer(scene / "layers" / "alone.npz")).projector


def test_what_is_at_hand_is_taken_by_name_or_asked_for(scene) -> None:
    told: list[str] = []
    observer = Told(told)
    method = find_method("saga")
    options = SagaOptions.published(steps=3)
    room = load_scene(scene)
    work = Work(scene=room, observer=observer)
    found = with_companions(work, method, options)
    assert found.guidance == "features_dino"
    shutil.copytree(room.source / "features_dino", scene / "evidence" / "features_sam2")
    assert with_companions(work, method, options).guidance == "features_sam2"
    assert [line.split(",")[0] for line in told] == [
        "guidance: features_dino",
        "guidance: features_sam2",
    ]
    named = replace(options, guidance="features_dino")
    assert with_companions(work, method, named) is named
    bare = replace(room, root=None, source=None)
    with pytest.raises(InputError, match=r"guidance: .*splatseg see SCENE.*--guidance None\."):
        with_companions(Work(scene=bare), method, options)


class Told:
    """Keeps what it is told."""

    def __init__(self, lines: list[str]) -> None:
        self.note = lines.append
