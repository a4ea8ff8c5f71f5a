"""The method as `segment` runs it, on a generated room."""

import shutil
from pathlib import Path

import pytest
import torch

from splatseg.cli import main
from splatseg.core import Features, Labels
from splatseg.io.evidence import open_evidence
from splatseg.io.scene import load_scene, load_scene_layer
from splatseg.methods.cosseg import CossegOptions
from splatseg.methods.cosseg.network import RandlaEncoder
from splatseg.methods.cosseg.pyramid import PointInputs, RandlaConfig
from splatseg.tasks.segment import SegmentOptions, segment
from splatseg_bench.point_network import save_point_encoder
from support.checkpoints import saved

LABELS = SegmentOptions(evidence="labels_semantic")


@pytest.fixture(scope="module")
def scene(fitted_room, tmp_path_factory) -> Path:
    return Path(shutil.copytree(fitted_room, tmp_path_factory.mktemp("cosseg") / "scene"))


def test_the_decoder_of_features_alone(scene) -> None:
    options = CossegOptions(features="features_dino", spatial="none", steps=5, readout="rendered")
    layer = segment(load_scene(scene), "cosseg", options=LABELS, method_options=options).layer
    assert isinstance(layer, Features)
    assert layer.info.details["blocks"] == ["block3", "block6", "block9", "block12"]


@pytest.fixture(scope="module")
def small_encoder(tmp_path_factory) -> Path:
    """A point network that a view of few Gaussians has points enough for."""
    config = RandlaConfig(first_width=4, widths=(4, 4), neighbours=4, ratios=(4, 2))
    path = tmp_path_factory.mktemp("encoder") / "small.safetensors"
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)
        encoder = RandlaEncoder(config)
    save_point_encoder(encoder, path, inputs=PointInputs(grid_size=0.04), facts={})
    return path


def test_the_published_setting_on_features_of_a_network(
    scene, small_encoder, tmp_path, monkeypatch, capsys
) -> None:
    """From DINO, with its class token and blocks wider than 64 channels, to a page of the layer."""
    pytest.importorskip("transformers")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)

    def run(*words: object) -> None:
        status = main([str(word) for word in words])
        assert status == 0, capsys.readouterr().err

    weights = saved("dino_wide", tmp_path)
    run("see", scene, "--model", "dino", "--weights", weights, "--evidence", "dino", "--device",
        "cpu", "--size", 64)  # fmt: skip
    found = open_evidence(scene / "evidence" / "dino").deep_features("train_0000")
    assert found.class_token is not None
    assert [one.channels for one in found.maps] == [96] * 4
    run("segment", scene, "--method", "cosseg", "--published", "--evidence", "labels_semantic",
        "--features", "dino", "--encoder", small_encoder, "--steps", 3, "--layer", "published",
        "--report")  # fmt: skip
    layer = load_scene_layer(scene, "published")
    assert isinstance(layer, Features)
    assert layer.info.details["skipped"] == []
    said = "published, 3 of 10000 steps of 8 views x 512 pixels"
    assert layer.info.details["trained"] == said
    page = (scene / "reports" / "published.html").read_text()
    assert "How it was trained" in page
    assert said in page


def test_help_says_in_what_the_published_setting_differs(capsys) -> None:
    def said(method: str) -> str:
        assert main(["segment", "--method", method, "--help"]) == 0
        return " ".join(capsys.readouterr().out.split())

    published = CossegOptions.published()
    views, pixels = published.views_per_step, published.batch // published.views_per_step
    for words in (
        f"It differs: a step is of {views} views x {pixels} pixels",
        f"without weights below {published.min_weight:g}",
        "trained on generated rooms, not on S3DIS",
        "mean of what is decoded of it",
    ):
        assert words in said("cosseg"), words
    assert "It differs" not in said("identity")


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
    panoptic = decoded(scene, "labels_panoptic")
    assert panoptic.info.class_of
