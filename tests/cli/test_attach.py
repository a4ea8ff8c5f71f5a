"""attach: labels back on what an editor left, as the shell runs it."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseg.core import (
    Features,
    Labels,
    LayerInfo,
    Selection,
    Similarity,
)
from splatseg.core.rigid import rotation_from_quaternion
from splatseg.io.scene import load_scene, load_scene_layer, save_scene_layer, scene_layer_names
from splatseg.io.splats import read_splats, write_splats
from splatseg.render import render


@pytest.fixture
def labelled(small, rng):
    """The small scene, its Gaussians told apart, with a layer of each kind."""
    from dataclasses import replace

    from splatseg.io.scene import save_scene

    scene = load_scene(small.scene)
    n = len(scene.gaussians)
    noise = torch.from_numpy(rng.normal(0, 1, (n, 9))).float()
    gaussians = scene.gaussians.replace(
        means=scene.gaussians.means + 0.02 * noise[:, :3],
        scales=scene.gaussians.scales * (0.2 * noise[:, 3:6]).exp(),
        opacities=(0.9 + 0.05 * noise[:, 6]).clamp(0, 1),
        antialiased=True,
        extra={"height": noise[:, 8]},
    )
    save_scene(replace(scene, gaussians=gaussians, up=(0.0, -1.0, 0.0)), small.scene)
    ids = torch.arange(n) % 5
    save_scene_layer(
        Labels(
            ids=torch.where(ids == 0, -1, ids),
            confidence=noise[:, 7].abs().clamp(0, 1),
            info=LayerInfo(names={3: "third"}),
        ),
        small.scene,
        "fifths",
    )
    save_scene_layer(Selection(mask=noise[:, 8] > 0), small.scene, "high")
    save_scene_layer(Features(values=noise[:, :2]), small.scene, "vectors")
    return small


@pytest.fixture
def kept(labelled, rng) -> torch.Tensor:
    n = len(load_scene(labelled.scene).gaussians)
    return torch.from_numpy(rng.permutation(n)[: n * 2 // 3])


@pytest.fixture
def edited(labelled, kept, tmp_path) -> Path:
    """Cropped and reordered, without columns and comments."""
    g = load_scene(labelled.scene).gaussians[kept]
    path = tmp_path / "edited.ply"
    write_splats(g.replace(extra={}, antialiased=False), path)
    return path


def test_a_new_scene(labelled, kept, edited, splatseg, tmp_path) -> None:
    new = tmp_path / "new"
    status, out, err = splatseg("attach", labelled.scene, edited, "-o", new)
    assert (status, err) == (0, "")
    assert f"{len(kept)} of {len(kept)} Gaussians found (100.00 %)" in out
    before, after = load_scene(labelled.scene), load_scene(new)
    assert torch.equal(after.gaussians.means, before.gaussians.means[kept])
    assert after.gaussians.antialiased
    assert torch.equal(after.gaussians.extra["height"], before.gaussians.extra["height"][kept])
    assert [view.name for view in after.views] == [view.name for view in before.views]
    assert after.views[0].image is not None
    assert after.views[0].image.is_file()
    assert scene_layer_names(new) == ("fifths", "high", "vectors")
    for name in scene_layer_names(new):
        old, got = load_scene_layer(labelled.scene, name), load_scene_layer(new, name)
        assert type(got) is type(old)
        for field in {"fifths": ("ids", "confidence"), "high": ("mask",), "vectors": ("values",)}[
            name
        ]:
            assert torch.equal(getattr(got, field), getattr(old, field)[kept])
        assert got.info.edit("attach")["found"] == len(kept)
    assert load_scene_layer(new, "fifths").info.names == {3: "third"}
    assert after.provenance["command"] == "attach"
    # The command never replaces a scene.
    status, _, err = splatseg("attach", labelled.scene, edited, "-o", new)
    assert status == 2
    assert "new folder" in err
    some = ("--layers", "high, fifths", "-o", tmp_path / "some")
    assert splatseg("attach", labelled.scene, edited, *some)[0] == 0
    assert scene_layer_names(tmp_path / "some") == ("fifths", "high")


def test_cameras_go_along(labelled, kept, splatseg, tmp_path) -> None:
    move = Similarity(
        rotation=rotation_from_quaternion(torch.tensor([0.9, 0.1, 0.4, -0.2]).double()),
        translation=torch.tensor([3.0, 4.0, -5.0]).double(),
        scale=2.5,
    )
    before = load_scene(labelled.scene)
    path = tmp_path / "moved.ply"
    write_splats(before.gaussians.transformed(move), path)
    new = tmp_path / "new"
    status, out, err = splatseg("attach", labelled.scene, path, "-o", new)
    assert (status, err) == (0, "")
    assert "were moved: turned by" in out
    assert "scaled by 2.5" in out
    after = load_scene(new)
    for view in before.views:
        old = render(before.gaussians, view.camera, backend="cpu").image
        got = render(after.gaussians, after.view(view.name).camera, backend="cpu").image
        assert float((old - got).abs().max()) < 1e-3
    assert after.up == pytest.approx(tuple((-move.rotation[:, 1]).tolist()), abs=1e-5)


def test_a_ply_with_columns(labelled, kept, edited, splatseg, tmp_path) -> None:
    out = tmp_path / "again.ply"
    layers = ("--layer", "fifths", "--instances", "fifths", "-o", out)
    for _ in range(2):  # the second run replaces the first
        status, text, err = splatseg("attach", labelled.scene, edited, *layers)
        assert (status, err) == (0, "")
    assert "class_id, confidence, instance_id" in text
    layer = load_scene_layer(labelled.scene, "fifths")
    expected = torch.where(layer.ids < 0, 0, layer.ids)[kept]
    again = read_splats(out)
    assert torch.equal(again.extra["class_id"], expected)
    assert torch.equal(again.extra["instance_id"], expected)
    assert torch.equal(again.extra["confidence"], layer.confidence[kept])
    assert again.antialiased
    table = json.loads(out.with_suffix(".json").read_text())
    assert table["columns"]["class_id"]["ids"]["3"] == {
        "name": "third",
        "colour": table["columns"]["class_id"]["ids"]["3"]["colour"],
        "gaussians": int((expected == 3).sum()),
    }
    # Without the scene: the columns of the file that was exported are enough.
    third = tmp_path / "third.ply"
    back = edited.with_name("back.ply")
    write_splats(read_splats(edited)[torch.arange(len(kept) - 1, -1, -1)], back)
    status, _, err = splatseg("attach", out, back, "-o", third)
    assert (status, err) == (0, "")
    assert torch.equal(read_splats(third).extra["class_id"], expected.flip(0))
    names = json.loads(third.with_suffix(".json").read_text())["columns"]["class_id"]["ids"]
    assert names["3"]["name"] == "third"


def test_an_imported_scene(labelled, kept, edited, splatseg, tmp_path) -> None:
    scene = tmp_path / "imported"
    command = ("import", edited, "-o", scene, "--max-views", 2, "--width", 64)
    assert splatseg(*command)[0] == 0
    status, _out, err = splatseg("attach", labelled.scene, scene, "--layers", "fifths")
    assert (status, err) == (0, "")
    assert scene_layer_names(scene) == ("fifths",)
    got = load_scene_layer(scene, "fifths")
    assert isinstance(got, Labels)
    assert torch.equal(got.ids, load_scene_layer(labelled.scene, "fifths").ids[kept])
    status, _, err = splatseg("attach", labelled.scene, scene)
    assert status == 2
    assert "fifths already" in err
    assert splatseg("attach", labelled.scene, scene, "--overwrite")[0] == 0
    assert scene_layer_names(scene) == ("fifths", "high", "vectors")


def test_what_is_no_edit_is_refused(labelled, edited, splatseg, rng, tmp_path) -> None:
    other = read_splats(edited)
    n = len(other)
    # All that tells Gaussians apart is drawn anew.
    means, scales = rng.random((n, 3)) * 9, np.exp(rng.normal(-3, 1, (n, 3)))
    turns = rng.normal(0, 1, (n, 4))
    write_splats(
        other.replace(
            means=torch.from_numpy(means).float(),
            scales=torch.from_numpy(scales).float(),
            rotations=torch.from_numpy(turns / np.linalg.norm(turns, axis=1)[:, None]).float(),
            opacities=torch.from_numpy(rng.random(n)).float(),
            sh=torch.from_numpy(rng.normal(0, 1, tuple(other.sh.shape))).float(),
        ),
        tmp_path / "other.ply",
    )
    arguments = ("attach", labelled.scene, tmp_path / "other.ply", "-o", tmp_path / "new")
    status, _, err = splatseg(*arguments)
    assert status == 2
    assert "is it an edit of that scene?" in err
    assert not (tmp_path / "new").exists()


def test_mistakes_get_one_sentence(labelled, edited, splatseg, tmp_path) -> None:
    scene = labelled.scene
    write_splats(load_scene(scene).gaussians[:0], tmp_path / "none.ply")
    (tmp_path / "bytes.ply").write_bytes(b"not a splat file")
    out = ("-o", tmp_path / "new")
    ply = ("-o", tmp_path / "new.ply")
    cases = [
        ((scene, edited), "--output: needed"),
        ((scene, tmp_path / "no.ply", *out), "no.ply"),
        ((scene, tmp_path / "bytes.ply", *out), "bytes.ply"),
        ((scene, tmp_path / "none.ply", *out), "file of none"),
        ((tmp_path / "nowhere", edited, *ply), "nowhere"),
        ((edited, edited, *out), "scene folder"),
        ((edited, edited, *ply), "columns of labels"),
        ((edited, edited, *ply, "--layer", "fifths"), "--layer"),
        ((scene, edited, *ply), "fifths, high, vectors"),
        ((scene, edited, *ply, "--layer", "vectors"), "labels"),
        ((scene, edited, *ply, "--instances", "high"), "labels"),
        ((scene, edited, *out, "--layers", "eighths"), "fifths, high, vectors"),
        ((scene, edited, *out, "--instances", "fifths"), "--instances"),
        ((scene, edited, "-o", tmp_path / "x.spz"), "x.spz: expected a scene folder or a .ply"),
        ((scene, edited, "-o", tmp_path / "x.compressed.ply"), "expected a scene folder or a .ply"),
        ((scene, edited, "-o", tmp_path / "no" / "x"), "folder to write in"),
        ((scene, edited, "-o", labelled.capture), "new folder"),
        ((scene, edited, "-o", edited, "--layer", "fifths"), "is what is read"),
        ((scene, edited, *out, "--min-found", 2), "--min-found"),
        ((scene, edited, *out, "--moves", -1), "moves"),
    ]  # fmt: skip
    before = sorted(p for p in tmp_path.rglob("*"))
    for arguments, word in cases:
        status, _, err = splatseg("attach", *arguments)
        assert status == 2, (arguments, err)
        assert word in err, (arguments, err)
        assert "Traceback" not in err
    assert sorted(p for p in tmp_path.rglob("*")) == before
