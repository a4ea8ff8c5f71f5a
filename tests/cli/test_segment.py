"""segment: every method, completion, exports and the report, as the shell runs it."""

import csv
import json

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import InstanceTree, Labels, MaskSet, Rle, Segment
from splatseg.io.evidence import save_masks, save_segments
from splatseg.io.scene import load_scene, load_scene_layer
from splatseg.io.splats import read_splats

LEFT, RIGHT = 2, 7
TRAIN = ("train_0", "train_1", "train_3")


def layer_of(scene, name: str) -> Labels:
    layer = load_scene_layer(scene, name)
    if isinstance(layer, InstanceTree):
        return layer.cut()
    assert isinstance(layer, Labels)
    return layer


def sides(scene) -> torch.Tensor:
    """The wall that each Gaussian belongs to, by its place; -1 near the border."""
    x = load_scene(scene).gaussians.means[:, 0]
    side = torch.where(x < 0, LEFT, RIGHT)
    return torch.where(x.abs() < 0.25, -1, side)


@pytest.fixture
def masks(small):
    """Masks of the two walls in each view, in no order."""
    for index, name in enumerate(TRAIN):
        ids = np.array(Image.open(small.capture / "semantic" / f"{name}.png"))
        wanted = [LEFT, RIGHT] if index % 2 else [RIGHT, LEFT]
        found = MaskSet(
            height=ids.shape[0],
            width=ids.shape[1],
            masks=tuple(Rle.encode(torch.from_numpy(ids == i)) for i in wanted),
            scores=torch.ones(2),
            levels=torch.zeros(2, dtype=torch.int64),
        )
        save_masks(found, small.scene / "evidence" / "masks", name)
    return small


@pytest.fixture
def panoptic(small):
    """The same as label maps with ids of each view's own."""
    folder = small.capture / "labels_panoptic"
    folder.mkdir()
    table = {}
    for index, name in enumerate(TRAIN):
        ids = np.array(Image.open(small.capture / "semantic" / f"{name}.png"))
        out = np.zeros(ids.shape, np.uint16)
        rows: list[Segment] = []
        for kind in (LEFT, RIGHT):
            own = 1 + (kind == (LEFT, RIGHT)[index % 2])
            out[ids == kind] = own
            rows.append(Segment(id=own, category=kind, isthing=True, score=0.9))
        Image.fromarray(out).save(folder / f"{name}.png")
        table[name] = rows
    save_segments(table, folder)
    return small


@pytest.mark.parametrize("method", ["uplift", "vote", "identity"])
def test_labels_that_mean_the_same_in_all_views(small, splatseg, method) -> None:
    quick = ("--steps", 300, "--batch", 400) if method == "identity" else ()
    if method == "identity":
        quick += ("--rate", 0.05, "--classifier-rate", 0.02)
    status, out, err = splatseg("segment", small.scene, "--method", method, *quick)
    assert (status, err.strip()) == (0, ""), err
    layer = layer_of(small.scene, "labels_semantic")
    assert layer.info.method == method
    assert layer.info.names[LEFT] == "left wall"
    expected = sides(small.scene)
    certain = (expected >= 0) & (layer.ids >= 0)
    assert certain.sum() > 100
    assert float((layer.ids == expected)[certain].double().mean()) > 0.95
    assert f"{int((layer.ids != -1).sum())} of {len(layer)} Gaussians labelled" in out


def test_masks_become_instances(masks, splatseg) -> None:
    arguments = ("segment", masks.scene, "--method", "associate", "--evidence", "masks")
    status, _, err = splatseg(*arguments)
    assert (status, err.strip()) == (0, ""), err
    layer = layer_of(masks.scene, "masks")
    assert layer.present.tolist() == [1, 2]
    assert sorted(layer.info.names.values()) == ["object 1", "object 2"]
    expected = sides(masks.scene)
    known = (expected >= 0) & (layer.ids >= 0)
    left = int(layer.ids[expected == LEFT].mode().values)
    assert torch.equal((layer.ids == left)[known], (expected == LEFT)[known])
    # Nothing is random, and a second run replaces the first.
    assert splatseg(*arguments)[0] == 0
    assert torch.equal(layer_of(masks.scene, "masks").ids, layer.ids)


def test_instances_have_classes_where_segments_do(panoptic, splatseg) -> None:
    status, _, err = splatseg(
        "segment", panoptic.scene, "--method", "associate", "--evidence", "labels_panoptic",
        "--layer", "things",
    )  # fmt: skip
    assert (status, err.strip()) == (0, ""), err
    layer = layer_of(panoptic.scene, "things")
    assert sorted(layer.info.class_of.values()) == [LEFT, RIGHT]
    names = {layer.info.class_of[i]: n for i, n in layer.info.names.items()}
    assert names[LEFT].startswith("left wall ")
    assert layer.info.details["associate"]["instances"] == 2


def test_instances_and_classes_merge(panoptic, splatseg) -> None:
    classes = ("segment", panoptic.scene, "--method", "uplift", "--evidence", "labels_semantic")
    assert splatseg(*classes, "--layer", "classes")[0] == 0
    associate = ("segment", panoptic.scene, "--method", "associate", "--evidence")
    status, _, err = splatseg(
        *associate, "labels_panoptic", "--classes", "classes", "--layer", "whole", "--report"
    )
    assert (status, err.strip()) == (0, ""), err
    layer = layer_of(panoptic.scene, "whole")
    assert sorted(layer.info.class_of.values()) == [LEFT, RIGHT]
    assert layer.info.edit("merge_panoptic")["things"] == 2
    kinds = layer.info.class_of
    expected = sides(panoptic.scene)
    known = (expected >= 0) & (layer.ids >= 0)
    found = torch.tensor([kinds.get(i, -1) for i in layer.ids.tolist()])
    assert torch.equal(found[known], expected[known])
    for arguments, word in (
        ((*classes, "--classes", "classes"), "--classes: goes with evidence of instances"),
        ((*associate, "labels_panoptic", "--classes", "other"), "other"),
    ):
        status, _, err = splatseg(*arguments)
        assert status == 2
        assert word in err


def test_completion_marks_what_it_infers(small, splatseg) -> None:
    cut = ("segment", small.scene, "--method", "uplift", "--min-weight", 3)
    assert splatseg(*cut, "--no-complete", "--layer", "seen")[0] == 0
    status, out, _ = splatseg(*cut, "--layer", "all")
    assert status == 0
    seen, whole = layer_of(small.scene, "seen"), layer_of(small.scene, "all")
    assert seen.inferred is None
    assert whole.inferred is not None
    blank = seen.ids == -1
    assert 0 < int(blank.sum()) < len(blank)
    assert torch.equal(whole.inferred, blank)
    assert torch.equal(whole.ids[~blank], seen.ids[~blank])
    assert bool((whole.ids[blank] != -1).all())
    assert f"{int(blank.sum())} of them inferred from neighbours" in out


def test_confusion_is_corrected_unless_told_not_to(small, splatseg) -> None:
    command = ("segment", small.scene, "--method", "uplift")
    assert splatseg(*command)[0] == 0
    layer = layer_of(small.scene, "labels_semantic")
    said = layer.info.edit("correct_confusion")
    assert said["options"]["effective_views"] == 10
    assert said["view_correlation"] == layer.info.view_correlation
    assert layer.effective_views is not None
    assert layer.candidates is None
    assert splatseg(*command, "--candidates", 3, "--effective-views", 4, "--layer", "soft")[0] == 0
    soft = layer_of(small.scene, "soft")
    assert soft.info.edit("correct_confusion")["options"]["effective_views"] == 4
    assert soft.candidates is not None
    assert soft.candidates.shape[1] == 3
    for words in (("--no-correct-confusion",), ("--label-rule", "flashsplat")):
        assert splatseg(*command, *words, "--layer", "plain")[0] == 0
        assert layer_of(small.scene, "plain").info.edit("correct_confusion") is None


def test_files_and_report_of_one_command(masks, splatseg) -> None:
    command = (
        "segment", masks.scene, "--method", "associate", "--evidence", "masks", "--export",
        "--report", "--layer", "walls", "--truth", masks.capture / "semantic",
    )  # fmt: skip
    for _ in range(2):  # the second run replaces the first
        status, out, err = splatseg(*command)
        assert (status, err.strip()) == (0, ""), err
    layer = layer_of(masks.scene, "walls")
    exports = masks.scene / "exports" / "walls"
    objects = sorted((exports / "objects").glob("*.ply"))
    assert len(objects) == 2
    assert sorted(len(read_splats(path)) for path in objects) == sorted(
        int((layer.ids == i).sum()) for i in (1, 2)
    )
    with (exports / "objects.csv").open(encoding="utf-8-sig") as file:
        rows = list(csv.DictReader(file))
    assert {int(row["gaussians"]) for row in rows} == {int((layer.ids == i).sum()) for i in (1, 2)}
    for row in rows:
        assert row["file"].startswith(f"objects/{int(row['id']):03d}")
        assert len(read_splats(exports / row["file"])) == int(row["gaussians"])
    whole = read_splats(exports / "labelled.ply")
    assert torch.equal(whole.extra["class_id"], layer.ids.clamp_min(0))
    drawn = np.array(Image.open(exports / "label_maps" / "walls" / "test_2.png"))
    assert set(np.unique(drawn[12:]).tolist()) == {1, 2}
    views = {path.stem for path in (exports / "label_maps" / "walls").glob("*.png")}
    assert views == {"train_0", "train_1", "test_2", "train_3"}, "all photographs"
    assert "label maps of 4 views" in out
    record = json.loads((masks.scene / "reports" / "walls.json").read_text())
    assert {row["file"] for row in record["objects"] if row["gaussians"]} == {
        f"exports/walls/{row['file']}" for row in rows
    }
    legend = json.loads((exports / "label_maps" / "walls" / "legend.json").read_text())["ids"]
    assert {int(id): row["colour"] for id, row in legend.items()} == {
        row["id"]: row["colour"] for row in record["objects"]
    }, "one colour an object, whatever shows it"
    labelled = json.loads((exports / "labelled.json").read_text())["columns"]["class_id"]["ids"]
    assert all(labelled[id]["colour"] == row["colour"] for id, row in legend.items())
    page = (masks.scene / "reports" / "walls.html").read_text()
    assert f"report: {masks.scene / 'reports' / 'walls.html'}" in out
    assert "object 1" in page
    assert "data:image" in page
    assert "http://" not in page.replace("http://www.w3.org", "")


def test_missing_views_are_told(small, splatseg) -> None:
    command = ("segment", small.scene, "--method", "uplift")
    assert "note:" not in splatseg(*command)[2]
    assert "note:" not in splatseg(*command, "--views", "all")[2], "held-out views need none"
    (small.capture / "labels_semantic" / "train_1.png").unlink()
    status, _, err = splatseg(*command)
    assert status == 0
    assert "note: 1 of 3 views have no such evidence, the first is train_1" in err


def test_mistakes_cost_one_sentence_and_nothing_else(masks, splatseg, tmp_path) -> None:
    scene = masks.scene
    (tmp_path / "file").write_text("x")
    before = sorted(scene.rglob("*"))
    for arguments, word in (
        (
            ("--method", "uplift", "--evidence", "masks"),
            "method uplift takes evidence of labels or tracked",
        ),
        (
            ("--method", "identity", "--evidence", "masks"),
            "method identity takes evidence of labels or tracked",
        ),
        (
            ("--method", "associate", "--evidence", "labels_semantic"),
            "associate takes evidence of masks",
        ),
        (("--method", "uplift"), "--evidence: expected a name (labels_semantic, masks)"),
        (("--method", "uplift", "--evidence", "nothing"), "nothing"),
        (("--method", "associate", "--evidence", "masks", "--layer", "a/b"), "--layer"),
        (("--method", "associate", "--evidence", "masks", "--truth", tmp_path / "no"), "no"),
        (("--method", "associate", "--evidence", "masks", "--agreement", "2"), "agreement"),
        (("--method", "associate", "--evidence", "masks", "--views", "test_2"), "test_2"),
    ):
        status, _, err = splatseg("segment", scene, *arguments, "--report", "--export")
        assert status == 2, (arguments, err)
        assert word in err, (arguments, err)
        assert "Traceback" not in err
        assert sorted(scene.rglob("*")) == before, arguments
    (scene / "exports").write_text("a file in the way")
    status, _, err = splatseg(
        "segment", scene, "--method", "associate", "--evidence", "masks", "--export"
    )
    assert status == 2
    assert "expected a folder for exports" in err
    assert not (scene / "layers" / "masks.npz").exists()
