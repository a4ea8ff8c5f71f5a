"""splatseg info: one line for whatever is there, JSON for scripts."""

import json

import numpy as np
import pytest

from splatseg.cli import main
from splatseg.io.captures import read_capture
from support.layouts import write_idr, write_llff


def line(capsys, *words: str) -> str:
    assert main(["info", *words]) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize(
    ("path", "words"),
    [
        (".", "nerfstudio capture, 19 views 320x240 (16 train, 3 test), pinhole; 4000 start"),
        (".", "evidence features_dino, features_text, labels_panoptic"),
        ("labels_panoptic", "evidence of the kind panoptic of 16 views"),
        ("features_text", "30 x 40 cells of 8 pixels, 16 channels"),
        ("masks_sam", "evidence of the kind masks of 16 views; train_0000 has "),
        ("images", "19 photographs, 320x240; no poses"),
        ("semantic", "evidence of the kind labels of 19 views"),
        ("sparse/0", "colmap capture, 19 views"),
    ],
)
def test_one_line_of_a_capture(capsys, generated_room, path, words) -> None:
    out = line(capsys, str(generated_room / path))
    assert words in out
    assert out.count("\n") == 1


def test_one_line_of_other_layouts(capsys, generated_room, tmp_path) -> None:
    capture = read_capture(generated_room)
    out = line(capsys, str(write_llff(capture, tmp_path / "fern")))
    assert "intrinsics of 1280x960 were scaled to photographs of 320x240" in out
    assert "idr capture, 19 views 320x240" in line(capsys, str(write_idr(capture, tmp_path / "a")))
    words = "folder of captures or scenes (a, fern)"
    assert words in line(capsys, str(tmp_path))


@pytest.mark.parametrize(
    ("path", "words"),
    [
        (".", "splat files (1 compressed.ply, 2 gltf, 1 ksplat, 1 ply, 2 sog, 1 splat, 3 spz)"),
        ("three.splat", "3 Gaussians, harmonics of degree 0"),
        ("three.ply", "ply splats, 3 Gaussians, harmonics of degree 1"),
        ("three.v2.sog", "sog splats, 3 Gaussians"),
    ],
)
def test_one_line_of_splats(capsys, project_root, path, words) -> None:
    assert words in line(capsys, str(project_root / "tests/golden/splats" / path))


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
def test_one_line_of_large_scenes(capsys, shared_data, path, words) -> None:
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


def test_json_has_the_same_facts(capsys, generated_room) -> None:
    facts = json.loads(line(capsys, str(generated_room), "--json"))
    assert (facts["kind"], facts["format"], facts["views"]) == ("capture", "nerfstudio", 19)
    assert facts["split"] == {"train": 16, "test": 3}
    assert (facts["points"], facts["classes"], facts["up"]) == (4000, 16, [0, 0, 1])
    assert facts["other_formats"] == ["colmap"]
    other = json.loads(line(capsys, str(generated_room), "--json", "--format", "colmap"))
    assert (other["format"], other["split"]) == ("colmap", facts["split"])


def test_details_come_a_line_each(capsys, generated_room) -> None:
    out = line(capsys, str(generated_room), "--verbose").splitlines()
    assert "  points: 4000" in out
    assert "  splats: none" in out
    names = next(each for each in out if each.startswith("  view_names: ")).split(": ")[1]
    assert sorted(names.split(", ")) == sorted(v.name for v in read_capture(generated_room).views)


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
