"""``splatseg select``: words become prompts, and prompts a layer, splats and pictures."""

import json

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import Labels, Selection
from splatseg.io.scene import load_scene, load_scene_layer, save_scene_layer
from splatseg.io.splats import read_splats

# The red wall is left of column 14 and the blue one right of it, both below row 10.
RED, BLUE, SKY = "8,15", "20,15", "8,3"


@pytest.fixture
def room(small):
    """The scene with a layer of its two walls."""
    scene = load_scene(small.scene)
    ids = torch.where(scene.gaussians.means[:, 0] < 0, 2, 7)
    save_scene_layer(Labels(ids=ids, confidence=torch.ones(len(ids))), small.scene, "walls")
    return small


def ids_of(room, name="selection") -> set[int]:
    selection = load_scene_layer(room.scene, name)
    assert isinstance(selection, Selection)
    assert selection.confidence is not None
    walls = load_scene_layer(room.scene, "walls")
    return set(walls.ids[selection.mask].tolist())


def test_a_click_becomes_a_layer(room, splatseg) -> None:
    status, out, _ = splatseg(
        "select", room.scene, "--view", "train_0", "--point", RED, "--layer", "red", "--json"
    )
    assert status == 0
    facts = json.loads(out)
    assert ids_of(room, "red") == {2}
    assert facts["layer"] == "red"
    assert facts["selected"] == load_scene_layer(room.scene, "red").count
    assert facts["confidence"] == 1
    assert facts["source"] == "layer"
    assert facts["next_click"] is None
    assert set(facts["stage_seconds"]) >= {"see", "layer"}
    assert "confidence 1.00" in splatseg("info", room.scene)[1]


def test_points_of_several_views_and_signs(room, splatseg) -> None:
    words = ("--point", f"train_0:{RED}", "--point", "train_3:20,15")
    assert splatseg("select", room.scene, *words)[0] == 0
    assert ids_of(room) == {2, 7}
    words = ("--view", "train_0", "--point", RED, "--negative", BLUE)
    assert splatseg("select", room.scene, *words)[0] == 0
    assert ids_of(room) == {2}
    info = load_scene_layer(room.scene, "selection").info
    assert info.details["prompts"][0]["negative_points"] == [[20.0, 15.0]]


def test_boxes_masks_and_strokes(room, splatseg, tmp_path) -> None:
    def image(name: str, rows: slice, columns: slice, mode: str = "L"):
        pixels = np.zeros((20, 28), np.uint8)
        pixels[rows, columns] = 255
        path = tmp_path / f"{name}.png"
        clear = np.stack([np.full_like(pixels, 255)] * 3 + [pixels], -1)
        Image.fromarray(pixels if mode == "L" else clear).save(path)
        return path

    blue = image("blue", slice(12, 18), slice(22, 26))
    red = image("red", slice(12, 18), slice(4, 9), "RGBA")
    view = ("--view", "train_0")
    assert splatseg("select", room.scene, *view, "--mask", blue)[0] == 0
    assert ids_of(room) == {7}
    words = ("--scribble", f"train_0:{red}", "--negative-scribble", blue)
    assert splatseg("select", room.scene, *view, *words)[0] == 0
    assert ids_of(room) == {2}
    assert splatseg("select", room.scene, *view, "--box", "0,9,17,20")[0] == 0
    assert ids_of(room) == {2}
    small = tmp_path / "small.png"
    Image.fromarray(np.full((3, 4), 255, np.uint8)).save(small)
    error = splatseg("select", room.scene, *view, "--mask", small)[2]
    assert "mask: expected 28x20 pixels as view train_0 has, got 4x3" in error


def test_places_and_selections_that_change_others(room, splatseg) -> None:
    red = ("--box-3d", -9, -9, -9, 0, 9, 9)
    assert splatseg("select", room.scene, *red, "--layer", "red")[0] == 0
    assert ids_of(room, "red") == {2}
    blue = ("--view", "train_0", "--point", BLUE)
    assert splatseg("select", room.scene, *blue, "--add-to", "red", "--layer", "all")[0] == 0
    assert ids_of(room, "all") == {2, 7}
    assert splatseg("select", room.scene, *blue, "--subtract-from", "all")[0] == 0
    assert ids_of(room) == {2}
    assert splatseg("select", room.scene, *blue, "--intersect", "all")[0] == 0
    assert ids_of(room) == {7}
    assert splatseg("select", room.scene, "--like", "red")[0] == 0
    assert ids_of(room) == {2}
    assert splatseg("select", room.scene, "--sphere", -1, 0.5, 2, 0.6)[0] == 0
    assert ids_of(room) == {2}
    lasso = ("--lasso", "train_0:0,0,10,0,10,20,0,20")
    assert splatseg("select", room.scene, *lasso)[0] == 0
    assert ids_of(room) == {2}
    error = splatseg("select", room.scene, *red, "--add-to", "all", "--intersect", "red")[2]
    assert "expected one of them, got add_to and intersect" in error
    error = splatseg("select", room.scene, *red, "--add-to", "walls")[2]
    assert "--add-to: expected a layer that is a selection, 'walls' is of labels" in error


def test_splats_and_pictures(room, splatseg, tmp_path) -> None:
    view = ("--view", "train_0", "--point", RED, "--box", "0,9,17,20", "--layer", "red")
    words = ("--save", tmp_path / "red.ply", "--picture", tmp_path / "clicks")
    status, out, _ = splatseg("select", room.scene, "--data", room.capture, *view, *words)
    assert status == 0
    assert "splats of the selection alone" in out
    count = load_scene_layer(room.scene, "red").count
    assert len(read_splats(tmp_path / "red.ply")) == count
    picture = np.array(Image.open(tmp_path / "clicks" / "train_0.png"))
    assert picture.shape == (20, 28, 3)
    assert picture[15, 8].tolist() == [52, 199, 89]
    assert (picture == (255, 214, 10)).all(-1).any()
    splatseg("select", room.scene, *view, "--save", tmp_path / "folder")
    assert len(read_splats(tmp_path / "folder" / "red.ply")) == count


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ((), "expected --point, --box"),
        (("--point", RED), "--point: expected --view, or VIEW:8,15, got neither"),
        (("--point", "train_9:1,2"), "there is no 'train_9' among 4 views (close to it: train_"),
        (("--view", "front", "--point", RED), "--view: there is no 'front' among 4 views"),
        (("--view", "train_0", "--point", "8"), "--point: expected 2 numbers joined by commas"),
        (("--view", "train_0", "--point", "8,x"), "--point: expected 2 numbers"),
        (("--view", "train_0", "--point", "99,3"), "pixels of view train_0, 28x20, got (99, 3)"),
        (("--view", "train_0", "--point", SKY), "the sky"),
        (("--view", "train_0", "--point", RED, "--negative", "9,15"), "both on 2"),
        (("--view", "train_0", "--point", RED, "--negative", RED), "contradict each other"),
        (("--view", "train_0", "--negative", RED), "expected a positive point"),
        (("--view", "train_0", "--box", "1,2,3"), "--box: expected 4 numbers"),
        (
            ("--view", "train_0", "--box", "0,9,9,20", "--box", "0,9,9,20"),
            "--box: expected at most one in view train_0, got two",
        ),
        (("--view", "train_0", "--lasso", "1,2,3,4"), "--lasso: expected X,Y of three corners"),
        (("--view", "train_0", "--mask", "none.png"), "none.png: there is no such image"),
        (("--view", "train_0", "--point", RED, "--granularity", "fine"), "--granularity: expected"),
        (("--view", "train_0", "--point", RED, "--source", "magic"), "--source: expected one of"),
        (("--view", "train_0", "--point", RED, "--from-layer", "x"), "layer: expected one of"),
        (("--view", "train_0", "--point", RED, "--save", "/nowhere/x.ply"), "a folder that exists"),
    ],
)
def test_what_cannot_be_is_one_sentence(room, splatseg, words, says) -> None:
    status, _, error = splatseg("select", room.scene, "--quiet", *words)
    assert status == 2
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert says in error
    assert not (room.scene / "layers" / "selection.npz").exists()
