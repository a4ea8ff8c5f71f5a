"""export: every kind of file, from the small scene with two walls, as the shell runs it."""

import csv
import json

import laspy
import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import (
    Labels,
    LayerInfo,
    Selection,
)
from splatseg.io.scene import load_scene, load_scene_layer, save_scene_layer
from splatseg.io.splats import read_splats
from splatseg.lift import label_map

LEFT, RIGHT, SKY = 2, 7, 1


@pytest.fixture
def labelled(small):
    """Walls as classes with the sky behind; the right wall in two pieces as instances."""
    gaussians = load_scene(small.scene).gaussians
    x, y = gaussians.means[:, 0], gaussians.means[:, 1]
    wall = torch.where(x < 0, LEFT, RIGHT)
    wall[0] = -1
    save_scene_layer(
        Labels(ids=wall, confidence=torch.where(y > 1, 0.3, 0.9), background=SKY),
        small.scene,
        "walls",
    )
    piece = torch.where(x < 0, -1, torch.where(x < 1, 11, 300))
    save_scene_layer(
        Labels(
            ids=piece,
            confidence=torch.full((len(x),), 0.5),
            info=LayerInfo(names={11: "near piece", 300: "far piece"}),
        ),
        small.scene,
        "pieces",
    )
    save_scene_layer(Selection(mask=x > 0), small.scene, "chosen")
    return small


def test_objects(labelled, splatseg, tmp_path) -> None:
    out = tmp_path / "objects"
    arguments = ("--what", "objects", "--layer", "walls", "--instances", "pieces", "-o", out)
    status, text, err = splatseg("export", labelled.scene, *arguments)
    assert (status, err) == (0, "")
    assert "2 objects" in text
    names = ["011_near-piece.ply", "300_far-piece.ply"]
    assert sorted(p.name for p in out.iterdir()) == [*names, "objects.json"]
    scene = load_scene(labelled.scene)
    piece = load_scene_layer(labelled.scene, "pieces")
    for name, id in zip(names, (11, 300), strict=True):
        part = read_splats(out / name)
        assert torch.equal(part.means, scene.gaussians[piece.ids == id].means)
        assert set(part.extra["class_id"].tolist()) == {RIGHT}
        assert set(part.extra["instance_id"].tolist()) == {id}
    content = json.loads((out / "objects.json").read_text())
    assert content["layer"] == "walls"
    assert [row["class"] for row in content["objects"]] == ["right wall"] * 2
    # Another format and fewer objects: the folder is replaced as a whole.
    again = ("--what", "objects", "--instances", "pieces", "--only", "far piece", "-o", out)
    assert (
        splatseg("export", labelled.scene, *again, "--splat-format", "spz", "--unlabelled")[0] == 0
    )
    assert sorted(p.name for p in out.iterdir()) == [
        "300_far-piece.spz", "objects.json", "unlabelled.spz",
    ]  # fmt: skip
    # A selection is one object.
    status, _, err = splatseg(
        "export", labelled.scene, "--what", "objects", "--layer", "chosen", "-o", out
    )
    assert status == 0, err
    assert sorted(p.name for p in out.iterdir()) == ["001_chosen.ply", "objects.json"]


def test_points(labelled, splatseg, tmp_path) -> None:
    layers = ("--layer", "walls", "--instances", "pieces")
    for name in ("a.ply", "b.las", "c.laz"):
        status, _, err = splatseg(
            "export", labelled.scene, "--what", "points", *layers, "-o", tmp_path / name
        )
        assert status == 0, err
    classes = load_scene_layer(labelled.scene, "walls")
    las = laspy.read(tmp_path / "b.las")
    expected = torch.where(classes.ids < 0, 0, classes.ids).numpy()
    assert np.array_equal(las["class_id"], expected)
    table = json.loads((tmp_path / "b.json").read_text())
    assert table["las_classification"] == {"2": 65, "7": 70}
    assert table["columns"]["instance_id"]["ids"]["11"]["name"] == "near piece"
    assert "las_classification" not in json.loads((tmp_path / "a.json").read_text())
    # Nothing is as opaque as this, and a cloud of nothing is a cloud.
    few = ("--what", "points", "--min-opacity", "0.98", "-o", tmp_path / "d.ply")
    status, text, _ = splatseg("export", labelled.scene, *few)
    assert status == 0
    assert text.startswith("0 points")
    assert not (tmp_path / "d.json").exists()


def test_table(labelled, splatseg, tmp_path) -> None:
    for name in ("a.csv", "a2.json"):
        status, text, err = splatseg(
            "export", labelled.scene, "--what", "table", "--layer", "walls", "-o", tmp_path / name
        )
        assert status == 0, err
        assert text.startswith("2 objects")
    with (tmp_path / "a.csv").open(encoding="utf-8-sig", newline="") as file:
        rows = list(csv.DictReader(file))
    content = json.loads((tmp_path / "a2.json").read_text())["objects"]
    assert [row["name"] for row in rows] == ["left wall", "right wall"]
    assert [row["name"] for row in content] == ["left wall", "right wall"]
    walls = load_scene_layer(labelled.scene, "walls")
    assert int(rows[1]["gaussians"]) == int((walls.ids == RIGHT).sum()) == content[1]["gaussians"]
    assert content[0]["centroid"][0] == pytest.approx(-content[1]["centroid"][0], abs=0.05)


def test_min_confidence(labelled, splatseg, tmp_path) -> None:
    walls = load_scene_layer(labelled.scene, "walls")
    arguments = ("--layer", "walls", "--min-confidence", 0.5, "-o", tmp_path / "a.ply")
    assert splatseg("export", labelled.scene, *arguments)[0] == 0
    ids = read_splats(tmp_path / "a.ply").extra["class_id"]
    sure = (walls.confidence >= 0.5) & (walls.ids >= 0)
    assert torch.equal(ids > 0, sure)
    assert bool(sure.any())
    assert not bool(sure.all())


def decoded(path) -> np.ndarray:
    with Image.open(path) as image:
        rgb = np.asarray(image).astype(np.int64)
    return rgb[..., 0] + 256 * rgb[..., 1] + 65536 * rgb[..., 2]


def test_coco_of_classes(labelled, splatseg, tmp_path) -> None:
    out = tmp_path / "coco"
    arguments = ("--what", "coco", "--layer", "walls", "--split", "all", "-o", out)
    status, text, err = splatseg("export", labelled.scene, *arguments, "--backend", "cpu")
    assert status == 0, err
    assert "4 views" in text
    scene = load_scene(labelled.scene)
    walls = load_scene_layer(labelled.scene, "walls")
    content = json.loads((out / "panoptic.json").read_text())
    assert [row["name"] for row in content["categories"]] == ["sky", "left wall", "right wall"]
    assert {image["file_name"] for image in content["images"]} == {
        f"{view.name}.png" for view in scene.views
    }
    for annotation in content["annotations"]:
        name = annotation["file_name"].removesuffix(".png")
        shown = label_map(scene.gaussians, scene.view(name).camera, walls, backend="cpu").ids
        ids = decoded(out / "panoptic" / annotation["file_name"])
        assert np.array_equal(ids, torch.where(shown < 0, 0, shown).numpy())
        for segment in annotation["segments_info"]:
            assert segment["area"] == int((ids == segment["id"]).sum())
            assert segment["category_id"] == segment["id"]


def test_coco_of_instances_and_classes_along_a_path(labelled, splatseg, tmp_path) -> None:
    out = tmp_path / "coco"
    arguments = ("--what", "coco", "--layer", "walls", "--instances", "pieces", "-o", out)
    arguments += ("--split", "path", "--frames", 3, "--backend", "cpu")
    for _ in range(2):  # the second run replaces the first
        status, _, err = splatseg("export", labelled.scene, *arguments)
        assert status == 0, err
    content = json.loads((out / "panoptic.json").read_text())
    assert len(content["images"]) == 3
    kinds = {
        (s["id"], s["category_id"], s["name"], s["iscrowd"])
        for annotation in content["annotations"]
        for s in annotation["segments_info"]
    }
    # Objects keep their ids; classes of what is no object come after the largest, 300. The
    # table does not say that the sky is no thing, so it is a crowd too.
    assert kinds <= {
        (11, RIGHT, "near piece", 0), (300, RIGHT, "far piece", 0),
        (301, SKY, "", 1), (302, LEFT, "", 1), (307, RIGHT, "", 1),
    }  # fmt: skip
    assert {11, 301, 302} <= {kind[0] for kind in kinds}


def test_coco_of_instances_alone(labelled, splatseg, tmp_path) -> None:
    out = tmp_path / "coco"
    arguments = ("--what", "coco", "--instances", "pieces", "-o", out, "--backend", "cpu")
    assert splatseg("export", labelled.scene, *arguments)[0] == 0
    content = json.loads((out / "panoptic.json").read_text())
    assert [(c["name"], c["isthing"]) for c in content["categories"]] == [("object", 1)]
    # A layer that says what class its objects are.
    piece = load_scene_layer(labelled.scene, "pieces")
    said = Labels(
        ids=piece.ids, confidence=piece.confidence, info=LayerInfo(class_of={11: 2, 300: 7})
    )
    save_scene_layer(said, labelled.scene, "said")
    arguments = ("--what", "coco", "--instances", "said", "-o", out, "--backend", "cpu")
    assert splatseg("export", labelled.scene, *arguments)[0] == 0
    content = json.loads((out / "panoptic.json").read_text())
    assert [c["id"] for c in content["categories"]] == [2, 7]


def test_only(labelled, splatseg, tmp_path) -> None:
    walls = load_scene_layer(labelled.scene, "walls")
    arguments = ("--layer", "walls", "--only", "left wall", "-o", tmp_path / "left.spz")
    status, _, err = splatseg("export", labelled.scene, *arguments)
    assert status == 2  # labels still need a PLY
    arguments = ("--layer", "walls", "--only", "2, left wall", "-o", tmp_path / "left.ply")
    status, _, err = splatseg("export", labelled.scene, *arguments)
    assert status == 0, err
    assert len(read_splats(tmp_path / "left.ply")) == int((walls.ids == LEFT).sum())


def test_mistakes_get_one_sentence(labelled, splatseg, tmp_path) -> None:
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "x").touch()
    scene = labelled.scene
    empty = Labels(
        ids=torch.full((len(load_scene(scene).gaussians),), -1),
        confidence=torch.zeros(len(load_scene(scene).gaussians)),
    )
    save_scene_layer(empty, scene, "empty")
    out = ("-o", tmp_path / "out")
    cases = [
        (("--what", "objects", *out), "--layer, --instances: expected the labels"),
        (("--what", "objects", "--layer", "walls", "-o", mine), "other files"),
        (("--what", "coco", "--layer", "walls", "-o", mine), "other files"),
        (("--what", "objects", "--layer", "walls", "-o", scene), "other files"),
        (("--what", "objects", "--layer", "empty", *out), "no Gaussian has an id"),
        (("--what", "table", "--layer", "walls", "-o", tmp_path / "t.xls"), ".csv or .json"),
        (("--what", "points", "--layer", "walls", "-o", tmp_path / "t.xyz"), ".las"),
        (("--what", "points", "--splat-format", "ply", "-o", tmp_path / "t.ply"), "--splat-format"),
        (("--what", "table", "--unlabelled", *out), "--unlabelled"),
        (("--what", "coco", "--layer", "walls", "--split", "none", *out), "test, train"),
        (("--what", "statue", *out), "objects"),
        (("--layer", "walls", "--only", "door", "-o", tmp_path / "a.ply"), "left wall"),
        (("--layer", "walls", "--min-confidence", 2, "-o", tmp_path / "a.ply"), "in [0, 1]"),
        (("--instances", "chosen", "-o", tmp_path / "a.ply"), "labels"),
        (("--layer", "walls", "-o", scene / "gaussians.ply"), "the scene's own"),
        (("--layer", "walls", "-o", scene / "scene.ply"), "scene.json"),
        (("--what", "objects", "--layer", "walls", "-o", tmp_path / "no" / "x"), "folder"),
        (("-o", tmp_path / "x.obj"), ".ply"),
    ]  # fmt: skip
    before = sorted(p for p in tmp_path.rglob("*"))
    for arguments, word in cases:
        status, _, err = splatseg("export", scene, *arguments)
        assert status == 2, (arguments, err)
        assert word in err, (arguments, err)
        assert "Traceback" not in err
    assert sorted(p for p in tmp_path.rglob("*")) == before
