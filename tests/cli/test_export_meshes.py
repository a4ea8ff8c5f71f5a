"""export --what meshes: a ball of Gaussians on a floor, as the shell runs it."""

import json
import sys

import numpy as np
import pytest
import torch
import trimesh

from splatseg.core import Features, Labels, LayerInfo
from splatseg.io.scene import load_scene, save_scene_layer

BALL, FLOOR, STRAY, HIDDEN = 11, 2, 12, 13
CENTRE, RADIUS = np.array([0.0, 0.0, 0.3]), 0.3


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A ball of small, opaque Gaussians on a floor, seen from above by eight cameras."""
    from splatseg.core import ClassInfo, ClassTable, Gaussians, Scene, View
    from splatseg.io.scene import save_scene
    from support.mesh_maps import ring

    rng = np.random.default_rng(0)
    directions = rng.normal(size=(1500, 3))
    ball = CENTRE + RADIUS * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    ground = np.stack(np.meshgrid(np.linspace(-1.5, 1.5, 50), np.linspace(-1.5, 1.5, 50)), -1)
    floor = np.concatenate((ground.reshape(-1, 2), np.zeros((2500, 1))), axis=1)
    stray = np.array([[0.9, 0.0, 0.02]])
    hidden = CENTRE + 0.02 * rng.normal(size=(12, 3))  # within the ball
    means = np.concatenate((ball, floor, stray, hidden))
    ids = np.repeat([BALL, FLOOR, STRAY, HIDDEN], [1500, 2500, 1, 12])
    scales = np.full((len(means), 3), 0.015)
    scales[ids == FLOOR] = (0.04, 0.04, 0.004)
    sh = np.zeros((len(means), 1, 3))
    sh[ids == BALL] = (1.5, -1.5, -1.5)
    gaussians = Gaussians(
        means=torch.from_numpy(means).float(),
        rotations=torch.tensor([1.0, 0, 0, 0]).expand(len(means), 4).clone(),
        scales=torch.from_numpy(scales).float(),
        opacities=torch.full((len(means),), 0.97),
        sh=torch.from_numpy(sh).float(),
    )
    cameras = ring((0.0, 0.0, 0.25), distance=1.6, count=8)
    views = tuple(View(name=f"v{i}", camera=c, split="train") for i, c in enumerate(cameras))
    root = tmp_path_factory.mktemp("ball") / "scene"
    classes = ClassTable(rows=(ClassInfo(id=5, name="toy", colour=(1, 2, 3)),))
    save_scene(Scene(gaussians=gaussians, views=views, up=(0.0, 0.0, 1.0), classes=classes), root)
    info = LayerInfo(names={BALL: "red ball", FLOOR: "floor", STRAY: "stray"}, class_of={BALL: 5})
    layer = Labels(ids=torch.from_numpy(ids).int(), confidence=torch.ones(len(ids)), info=info)
    save_scene_layer(layer, root, "objects")
    return root


ONLY = ("--what", "meshes", "--layer", "objects", "--only", "red ball", "--resolution", "32")


@pytest.fixture(scope="module")
def made(scene, tmp_path_factory):
    """The ball as GLB, with hulls."""
    from splatseg.cli import main

    out = tmp_path_factory.mktemp("made") / "meshes"
    assert main(["export", str(scene), *ONLY, "--hulls", "-o", str(out)]) == 0
    return out


def test_a_glb_is_closed_textured_and_named(made) -> None:
    loaded = trimesh.load(made / "011_red-ball.glb", process=False)
    (mesh,) = loaded.geometry.values()
    wanted = {"object_id": BALL, "name": "red ball", "class_id": 5, "class": "toy"}
    assert {key: mesh.metadata[key] for key in wanted} == wanted
    # Charts double vertices; without that it is closed, and the ball is found below, too.
    merged = trimesh.Trimesh(mesh.vertices, mesh.faces)
    assert merged.is_watertight
    # Gaussians of a standard deviation of 0.015 are seen a bit above their centres.
    assert merged.volume == pytest.approx(4 / 3 * np.pi * (RADIUS + 0.015) ** 3, rel=0.1)
    assert np.allclose(merged.bounds.mean(axis=0), CENTRE, atol=0.03)
    colours = np.asarray(mesh.visual.material.baseColorTexture)[..., :3].reshape(-1, 3)
    red = (colours[:, 0] > 150) & (colours[:, 1] < 80)
    assert red.mean() > 0.9
    entry = json.loads((made / "meshes.json").read_text())["objects"][0]
    assert entry["mesh"]["watertight"]
    assert entry["mesh"]["triangles"] == len(mesh.faces)
    assert 0.4 < entry["mesh"]["seen"] < 1
    assert entry["mesh"]["hulls"] == len(trimesh.load(made / entry["hulls"]).geometry) > 0


def test_formats_and_options(scene, made, splatseg, tmp_path) -> None:
    out = tmp_path / "meshes"
    finer = (*ONLY[:-1], "64")
    status, text, err = splatseg("export", scene, *finer, "--mesh-format", "ply", "-o", out)
    assert (status, err) == (0, "")
    assert "a mesh and meshes.json" in text
    # Another resolution, and no hulls that nobody asked for; the folder is replaced as a whole.
    assert sorted(p.name for p in out.iterdir()) == ["011_red-ball.ply", "meshes.json"]
    coarse, fine = (
        json.loads((folder / "meshes.json").read_text())["objects"][0]["mesh"]
        for folder in (made, out)
    )
    assert fine["voxel"] < coarse["voxel"]
    status, _, err = splatseg("export", scene, *ONLY, "--mesh-format", "obj", "-o", out)
    assert (status, err) == (0, "")
    assert sorted(p.name for p in out.iterdir()) == [
        "011_red-ball.mtl", "011_red-ball.obj", "011_red-ball.png", "meshes.json",
    ]  # fmt: skip


def test_the_same_scene_gives_the_same_file(scene, made, splatseg, tmp_path) -> None:
    out = tmp_path / "meshes"
    assert splatseg("export", scene, *ONLY, "--hulls", "-o", out)[0] == 0
    for path in made.glob("*.glb"):
        assert path.read_bytes() == (out / path.name).read_bytes()


def test_objects_that_cannot_be_are_skipped_with_a_note(scene, splatseg, tmp_path) -> None:
    out = tmp_path / "meshes"
    words = ("--what", "meshes", "--layer", "objects", "--resolution", "16", "-o", out)
    status, text, err = splatseg("export", scene, *words)
    assert status == 0, err
    assert "2 meshes" in text
    assert "12 stray (1 Gaussians where 10 are needed)" in err
    assert "13 (no view sees its surface)" in err
    content = json.loads((out / "meshes.json").read_text())
    assert [row["id"] for row in content["objects"]] == [FLOOR, BALL]
    assert [row["id"] for row in content["without_mesh"]] == [STRAY, HIDDEN]


def test_mistakes_get_one_sentence(scene, splatseg, tmp_path, monkeypatch) -> None:
    loaded = load_scene(scene)
    count = len(loaded.gaussians)
    save_scene_layer(
        Features(values=torch.zeros(count, 3), weights=torch.ones(count)), scene, "features"
    )
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "x").touch()
    out = ("-o", tmp_path / "out")
    cases = [
        (("--what", "meshes", *out), "--layer, --instances: expected the labels"),
        (("--what", "meshes", "--layer", "features", *out), "features, which have no ids"),
        (("--what", "meshes", "--layer", "objects", "-o", mine), "other files"),
        ((*ONLY, "--mesh-format", "fbx", *out), "glb"),
        ((*ONLY[:-1], "8", *out), "16"),
        (("--what", "meshes", "--layer", "objects", "--only", "stray", *out), "surface is seen"),
        (("--what", "table", "--layer", "objects", "--hulls", *out), "--hulls"),
        (("--what", "table", "--layer", "objects", "--resolution", "64", *out), "--resolution"),
        (("--what", "table", "--layer", "objects", "--mesh-format", "ply", *out), "--mesh-format"),
    ]  # fmt: skip
    before = sorted(tmp_path.rglob("*"))
    for arguments, word in cases:
        status, _, err = splatseg("export", scene, *arguments)
        assert status == 2, (arguments, err)
        assert word in err, (arguments, err)
        assert "Traceback" not in err
    for package in ("coacd", "skimage"):
        with monkeypatch.context() as patched:
            patched.setitem(sys.modules, package, None)
            status, _, err = splatseg("export", scene, *ONLY, "--hulls", *out)
        assert status != 0
        assert f"({package}). Try: pip install 'splatseg[mesh]'" in err
    assert sorted(tmp_path.rglob("*")) == before
