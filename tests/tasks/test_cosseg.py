"""The method as `segment` runs it, on a generated room."""

import shutil
from pathlib import Path

import pytest
import torch

from splatseg.cli import main
from splatseg.core import Features, Labels
from splatseg.errors import InputError
from splatseg.io.evidence import open_evidence
from splatseg.io.scene import load_scene, load_scene_layer
from splatseg.methods.cosseg import CossegOptions
from splatseg.tasks.segment import segment
from splatseg.tasks.segment_options import SegmentOptions

LABELS = SegmentOptions(evidence="labels_semantic")


@pytest.fixture(scope="module")
def scene(fitted_room, tmp_path_factory) -> Path:
    return Path(shutil.copytree(fitted_room, tmp_path_factory.mktemp("cosseg") / "scene"))


def test_the_decoder_of_features_alone(scene) -> None:
    options = CossegOptions(features="features_dino", spatial="none", steps=5, readout="rendered")
    layer = segment(load_scene(scene), "cosseg", options=LABELS, method_options=options).layer
    assert isinstance(layer, Features)
    assert layer.info.details["blocks"] == ["block3", "block6", "block9", "block12"]


def joint_words(scene: Path, folder: Path) -> list[str]:
    return [
        "segment", str(scene), "--method", "cosseg", "--evidence", "labels_semantic",
        "--features", "features_dino", "--spatial", "none",
        "--joint", str(folder), "--joint-steps", "3", "--layer", "joint", "--quiet",
    ]  # fmt: skip


def test_gaussians_that_learnt_along_are_a_new_scene(scene, tmp_path, capsys) -> None:
    """The old scene is as it was; the layer belongs to the new one."""
    folder = tmp_path / "new"
    assert main(joint_words(scene, folder)) == 0
    assert str(folder / "layers" / "joint.npz") in capsys.readouterr().out
    old, new = load_scene(scene), load_scene(folder)
    assert len(new.gaussians) == len(old.gaussians)
    assert not torch.equal(new.gaussians.means, old.gaussians.means)
    assert new.provenance["refined"]["layer"] == "joint"
    layer = load_scene_layer(folder, "joint")
    assert isinstance(layer, Labels)
    assert layer.info.details["steps"] == 3
    assert not (scene / "layers" / "joint.npz").exists()
    assert [view.name for view in new.views] == [view.name for view in old.views]


def test_a_new_scene_is_refused_before_the_work(scene, tmp_path, capsys) -> None:
    folder = tmp_path / "new"
    folder.mkdir()
    (folder / "mine").write_text("kept")
    assert main(joint_words(scene, folder)) == 2
    assert "expected a new folder" in capsys.readouterr().err
    words = joint_words(scene, tmp_path / "other")
    assert main([*words, "--resume"]) == 2
    assert "resume: a training with joint keeps nothing to go on from" in capsys.readouterr().err
    assert main([*words, "--report"]) == 2
    assert "with joint the layer is of a new one" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()


def decoded(scene: Path, evidence: str, **change) -> Labels:
    options = CossegOptions(features="features_dino", spatial="none", steps=30, batch=512, **change)
    layer = segment(
        load_scene(scene), "cosseg", options=SegmentOptions(evidence=evidence),
        method_options=options,
    ).layer  # fmt: skip
    assert isinstance(layer, Labels)
    return layer


def test_a_decoder_of_segments_has_ids_that_mean_the_same_in_all_views(scene) -> None:
    """Ids of tracks are as given, those of panoptic segments by association; both have classes."""
    tracks = open_evidence(load_scene(scene).source / "labels_tracked")
    layer = decoded(scene, "labels_tracked")
    given = {track.id for track in tracks.tracks}
    assert {id for id in layer.ids.tolist() if id >= 0} <= given
    assert set(layer.info.class_of) <= given
    assert layer.info.class_of
    linked = decoded(scene, "labels_tracked", link="associate")
    assert linked.info.class_of
    assert linked.info.names != layer.info.names
    panoptic = decoded(scene, "labels_panoptic")
    assert panoptic.info.class_of
    with pytest.raises(InputError, match="link: expected associate, since ids of panoptic"):
        decoded(scene, "labels_panoptic", link="given")
    with pytest.raises(InputError, match="link: expected segments of objects .panoptic, tracked"):
        decoded(scene, "labels_semantic", link="associate")
