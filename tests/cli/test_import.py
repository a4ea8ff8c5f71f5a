"""``splatseg import`` as the shell runs it."""

import json

import pytest
import torch

from splatseg.core import Labels, Similarity
from splatseg.io.scene import load_scene, save_scene_layer
from splatseg.io.splats import read_splats, write_splats

SMALL = ("--max-views", 13, "--width", 64)


@pytest.fixture
def splat_file(small, tmp_path):
    gaussians = load_scene(small.scene).gaussians
    write_splats(gaussians, tmp_path / "wall.ply")
    return tmp_path / "wall.ply"


def test_without_photographs(splat_file, splatseg, tmp_path) -> None:
    status, out, err = splatseg("import", splat_file, "-o", tmp_path / "s", *SMALL)
    assert status == 0, err
    assert "13 virtual cameras around an object" in out
    scene = load_scene(tmp_path / "s")
    assert (len(scene.train_views), len(scene.test_views)) == (11, 2)
    assert scene.source is None
    assert scene.up == (0.0, -1.0, 0.0)
    assert scene.provenance["virtual_views"]["kind"] == "object"
    assert all(view.image is None for view in scene.views)
    assert torch.equal(scene.gaussians.means, read_splats(splat_file).means)
    arguments = ("--split", "all", "--what", "rgb,depth,alpha", "-o", tmp_path / "out")
    assert splatseg("render", tmp_path / "s", *arguments)[0] == 0
    assert len(list((tmp_path / "out" / "rgb").glob("virtual_*.png"))) == 13


def test_with_its_capture(small, splat_file, splatseg, tmp_path) -> None:
    status, out, err = splatseg(
        "import", splat_file, "-o", tmp_path / "s", "--data", small.scene / "cameras"
    )
    assert status == 0, err
    assert "the splats fit the photographs" in out
    scene = load_scene(tmp_path / "s")
    assert [view.name for view in scene.test_views] == ["test_2"]
    assert scene.provenance["alignment"]["moved"] is None


def test_a_capture_that_lacks_photographs(small, splat_file, splatseg, tmp_path) -> None:
    (small.capture / "images" / "train_1.png").unlink()
    words = ("import", splat_file, "-o", tmp_path / "s", "--data", small.scene / "cameras")
    status, _, err = splatseg(*words, "--strict")
    assert status == 2
    assert "1 of 4 photographs that it lists are not there, expected all of them" in err
    assert not (tmp_path / "s").exists()
    status, _, err = splatseg(*words)
    assert status == 0, err
    assert "1 of 4 photographs that the capture lists is not there and left out" in err
    assert "train_1.png" in err
    assert len(load_scene(tmp_path / "s").views) == 3


def test_a_wrong_frame_is_found_and_undone(small, splat_file, splatseg, tmp_path) -> None:
    turn = Similarity(
        rotation=torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]).double(),
        translation=torch.zeros(3).double(),
    )
    true = read_splats(splat_file)
    write_splats(true.transformed(turn), tmp_path / "turned.ply")
    words = ("import", tmp_path / "turned.ply", "--data", small.scene / "cameras")
    status, out, err = splatseg(*words, "-o", tmp_path / "s")
    assert status == 0, err
    assert "(x, y, z) -> (x, -z, y)" in out
    scene = load_scene(tmp_path / "s")
    assert torch.allclose(scene.gaussians.means, true.means, atol=1e-5)
    assert scene.provenance["alignment"]["correlation"] > 0.9
    status, out, err = splatseg(*words, "-o", tmp_path / "as_is", "--as-is")
    assert status == 0, err
    kept = load_scene(tmp_path / "as_is").gaussians.means
    assert torch.allclose(kept, turn.apply(true.means), atol=1e-5)


def test_up(splat_file, splatseg, tmp_path) -> None:
    status, out, err = splatseg("import", splat_file, "-o", tmp_path / "s", *SMALL, "--up", "+z")
    assert status == 0, err
    assert "up is" not in out + err, "it was said"
    scene = load_scene(tmp_path / "s")
    assert scene.up == (0.0, 0.0, 1.0)
    assert all(abs(float(v.camera.cam_from_world[0, 2])) < 1e-9 for v in scene.views)


def test_gltf_is_y_up(project_root, splatseg, tmp_path) -> None:
    file = project_root / "tests" / "golden" / "tools" / "ring.glb"
    status, out, err = splatseg("import", file, "-o", tmp_path / "s", *SMALL)
    assert status == 0, err
    assert "up is +y, as is usual in such files" in out + err
    assert load_scene(tmp_path / "s").up == (0.0, 1.0, 0.0)


@pytest.mark.parametrize("name", ["ring.ply", "ring.splat", "ring.spz", "ring.sog"])
def test_files_of_other_tools(name, project_root, splatseg, tmp_path) -> None:
    check_coverage(project_root / "tests" / "golden" / "tools" / name, splatseg, tmp_path)


@pytest.mark.parametrize("name", ["inria_point_cloud_9080.ply", "lastchance_14007.splat"])
def test_large_files_of_other_tools(name, shared_data, splatseg, tmp_path) -> None:
    check_coverage(shared_data / "splats" / name, splatseg, tmp_path)


def check_coverage(file, splatseg, tmp_path) -> None:
    """Virtual cameras see nearly all Gaussians of the file."""
    status, _, err = splatseg("import", file, "-o", tmp_path / "s", *SMALL)
    assert status == 0, err
    record = json.loads((tmp_path / "s" / "scene.json").read_text())
    assert record["provenance"]["virtual_views"]["coverage"] > 0.9


def test_bad_input_is_one_sentence(small, splat_file, splatseg, tmp_path) -> None:
    (tmp_path / "broken.ply").write_bytes(splat_file.read_bytes()[:-500])
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("x")
    layered = small.scene
    n = len(load_scene(layered).gaussians)
    labels = Labels(ids=torch.ones(n, dtype=torch.int32), confidence=torch.ones(n))
    save_scene_layer(labels, layered, "mine")
    out = ("-o", tmp_path / "s")
    for words, sentence in [
        ((tmp_path / "none.ply", *out), "none.ply: no such file"),
        ((tmp_path / "broken.ply", *out), "broken.ply: "),
        ((splat_file, "-o", tmp_path / "file"), "expected a folder to write to, got a file"),
        ((splat_file, "-o", tmp_path / "no" / "s"), "expected a place in a folder"),
        ((splat_file, "-o", layered), "got a scene with layers (mine)"),
        ((splat_file, *out, "--data", tmp_path / "empty"), "expected a capture"),
        ((splat_file, *out, "--as-is"), "--as-is: goes with --data"),
        ((splat_file, *out, "--max-views", 0), "--max-views: expected at least 1"),
    ]:
        status, _, err = splatseg("import", *words)
        assert status == 2, words
        assert err.startswith("error: "), err
        assert sentence in err, err
        assert len(err.strip().splitlines()) == 1
        assert not (tmp_path / "s").exists()


def test_an_interrupted_import_leaves_nothing(splat_file, splatseg, tmp_path, monkeypatch) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("splatseg.io.scene.write_json", interrupt)
    before = sorted(p.name for p in tmp_path.iterdir())
    status, _, err = splatseg("import", splat_file, "-o", tmp_path / "s", *SMALL)
    assert (status, err.strip().splitlines()[-1]) == (1, "interrupted")
    assert sorted(p.name for p in tmp_path.iterdir()) == before
