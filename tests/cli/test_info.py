"""splatseg info: one line for whatever is there, JSON for scripts."""

import json

import numpy as np
import pytest

from splatseg.cli import main


def line(capsys, *words: str) -> str:
    assert main(["info", *words]) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("office", "nerfstudio capture, 125 views 512x384 (100 train, 25 test), pinhole; 30000"),
        ("office", "evidence features_dino, features_text, labels_panoptic"),
        ("toys", "80 train, 20 test"),
        ("frontal", "35 train, 6 test"),
        ("real/camvid", "colmap capture, 101 views 480x360 (88 train, 13 test), opencv; 5503"),
        ("real/replica_office0", "180 views 640x480"),
        ("real/llff_fern", "intrinsics of 4032x3024 were scaled to photographs of 706x529"),
        ("real/dtu_scan37", "idr capture, 49 views 800x600"),
        ("real/banana", "16 photographs, 1504x1000; no poses"),
        ("real", "folder of captures or scenes (camvid, dtu_scan37, llff_fern, replica_office0)"),
        ("office/labels_panoptic", "evidence of the kind panoptic of 100 views"),
        ("office/features_text", "48 x 64 cells of 8 pixels, 24 channels"),
        ("office/masks_sam", "evidence of the kind masks of 100 views; train_0000 has 65 masks"),
        ("office/images", "125 photographs, 512x384; no poses"),
        ("office/semantic", "evidence of the kind labels of 125 views"),
        ("real/camvid/sparse/0", "colmap capture, 101 views"),
        ("splats", "splat files (2 compressed.ply, 3 gltf, 1 ply, 1 splat, 1 spz)"),
        ("splats/lastchance_14007.splat", "14007 Gaussians, harmonics of degree 0"),
        ("splats/inria_point_cloud_9080.ply", "ply splats, 9080 Gaussians, harmonics of degree 3"),
        ("splats/sog_playbot_6_0", "sog splats, 1873 Gaussians"),
    ],
)
def test_one_line(capsys, shared_data, path, words) -> None:
    out = line(capsys, str(shared_data / path))
    assert words in out
    assert out.count("\n") == 1


def test_a_scene_and_its_layer(capsys, project_root) -> None:
    root = project_root / "tests/golden/scene-v1"
    out = line(capsys, str(root))
    assert "scene, 3 Gaussians, harmonics of degree 1, further columns mark" in out
    assert "layers chosen (selection of 2), features (features of 2 channels)" in out
    assert "note: 3 photographs are not where they were (see --data)" in out
    assert "layer of labels of 2 ids, 3 rows" in line(capsys, str(root / "layers/semantic.npz"))


def test_json_has_the_same_facts(capsys, shared_data) -> None:
    facts = json.loads(line(capsys, str(shared_data / "office"), "--json"))
    assert (facts["kind"], facts["format"], facts["views"]) == ("capture", "nerfstudio", 125)
    assert facts["split"] == {"train": 100, "test": 25}
    assert (facts["points"], facts["classes"], facts["up"]) == (30000, 91, [0, 0, 1])
    assert facts["other_formats"] == ["colmap"]
    other = json.loads(line(capsys, str(shared_data / "office"), "--json", "--format", "colmap"))
    assert (other["format"], other["split"]) == ("colmap", facts["split"])


def test_details_come_a_line_each(capsys, shared_data) -> None:
    out = line(capsys, str(shared_data / "real/camvid"), "--verbose").splitlines()
    assert "  points: 5503" in out
    assert "  splats: none" in out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["gone"], "there is no such file or folder"),
        (["."], "expected a capture, photographs, a scene, evidence or splats"),
        (["a.txt"], "expected a splat file"),
        (["a.npz"], "expected a layer"),
        ([".", "--format", "rosbag"], "--format: expected one of auto, nerfstudio"),
        ([".", "--format", "colmap"], "expected a COLMAP model"),
    ],
)
def test_what_cannot_be_told(capsys, tmp_path, monkeypatch, words, message) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.txt").write_text("hello")
    np.savez(tmp_path / "a.npz", x=np.zeros(2))
    assert main(["info", *words]) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.err.count("\n") == 1
    assert not captured.out
