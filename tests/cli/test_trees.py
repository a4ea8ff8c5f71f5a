"""Trees of instances in every command that takes a layer, as the shell runs it."""

import csv
import json
import shutil

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import InstanceTree, Labels, MaskSet, TreeNode
from splatseg.io.evidence import save_masks
from splatseg.io.scene import load_scene, load_scene_layer, save_scene_layer
from splatseg.io.splats import read_splats
from splatseg.lift import label_map

LEFT, RIGHT = 2, 7
TRAIN = ("train_0", "train_1", "train_3")
CPU = ("--backend", "cpu")
# A wall of two, of which the left one has an upper and a lower half.
NODES = (
    TreeNode(id=1, parent=4, name="left", support=0.5, segments=3, views=3),
    TreeNode(id=2, parent=4, name="right"),
    TreeNode(id=4, level="group", name="wall"),
    TreeNode(id=5, parent=1, level="part", name="upper"),
    TreeNode(id=6, parent=1, level="part", name="lower"),
)
HALF = 0.45  # y between the halves


def tree_in(scene) -> InstanceTree:
    layer = load_scene_layer(scene, "things")
    assert isinstance(layer, InstanceTree)
    return layer


@pytest.fixture
def run(splatseg):
    """A command that must succeed; what it printed."""

    def invoke(*words: object) -> str:
        status, out, err = splatseg(*words)
        assert (status, err.strip()) == (0, ""), err
        return out

    return invoke


@pytest.fixture
def treed(small):
    """The small scene with a layer `things` that is a tree, and one `flat` that is none."""
    means = load_scene(small.scene).gaussians.means
    x, y = means[:, 0], means[:, 1]
    ids = torch.where(x > 0, 2, torch.where(y < HALF, 5, 6)).int()
    ids[0] = -1
    labels = Labels(ids=ids, confidence=torch.full((len(ids),), 0.75))
    save_scene_layer(InstanceTree(nodes=NODES, labels=labels), small.scene, "things")
    save_scene_layer(labels, small.scene, "flat")
    return small


@pytest.fixture
def nested(small):
    """Masks of both walls, of the upper and lower half of each, and of the two together."""
    for name in TRAIN:
        ids = np.array(Image.open(small.capture / "semantic" / f"{name}.png"))
        upper = np.arange(len(ids))[:, None] < 10 + 12 * HALF
        walls = [ids == LEFT, ids == RIGHT]
        halves = [wall & half for wall in walls for half in (upper, ~upper)]
        masks = torch.from_numpy(np.stack([*walls, *halves, walls[0] | walls[1]]))
        save_masks(MaskSet.from_dense(masks), small.scene / "evidence" / "masks", name)
    return small


def test_nested_masks_become_a_tree_with_files_and_a_report(nested, run) -> None:
    words = ("--method", "associate", "--evidence", "masks", "--layer", "things")
    out = run("segment", nested.scene, *words, "--export", "--report", *CPU)
    tree = tree_in(nested.scene)
    levels = [node.level for node in tree.nodes]
    assert sorted(levels) == ["group", "object", "object", *["part"] * 4]

    exports = nested.scene / "exports" / "things"
    assert "7 groups, objects and parts" in out
    with (exports / "nodes.csv").open(encoding="utf-8-sig") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["id"]) for row in rows] == [node.id for node in tree.nodes]
    assert [int(row["parent"]) for row in rows] == [max(node.parent, 0) for node in tree.nodes]
    assert [row["level"] for row in rows] == levels
    total = {int(row["id"]): int(row["gaussians"]) for row in rows}
    for level in ("group", "object"):
        cut = tree.cut(level).ids
        for id in cut[cut > 0].unique().tolist():
            assert total[id] == int((cut == id).sum())
    (group,) = (int(row["id"]) for row in rows if row["level"] == "group")
    assert {int(row["parent"]) for row in rows if row["level"] == "object"} == {group}
    assert len(list((exports / "objects").glob("*.ply"))) == 2

    scene = load_scene(nested.scene)
    (view,) = scene.test_views
    drawn = {}
    for name, level in (("things", "object"), ("things@part", "part"), ("things@group", "group")):
        drawn[level] = np.array(Image.open(exports / "label_maps" / name / f"{view.name}.png"))
        cut = tree.cut(level)
        expected = label_map(scene.gaussians, view.camera, cut, backend="cpu").ids
        assert np.array_equal(drawn[level], expected.clamp_min(0).numpy())
    assert [len(np.unique(drawn[k][drawn[k] > 0])) for k in ("group", "object", "part")] == [
        1,
        2,
        4,
    ]

    page = (nested.scene / "reports" / "things.html").read_text()
    assert "The tree at three levels" in page
    for node in tree.nodes:
        indent = "\u2003" * (len(tree.path(node.id)) - 1)
        assert f"{indent}{node.name}<" in page
        assert f"\u2003{indent}{node.name}<" not in page
    # Children stand below their parents.
    table = page[page.index("<h2>The tree</h2>") :]
    at = {node.id: table.index(f"{node.name}<") for node in tree.nodes}
    assert all(at[node.parent] < at[node.id] for node in tree.nodes if node.parent > 0)


def test_a_report_of_labels_has_no_tree(nested, run) -> None:
    words = ("--method", "associate", "--evidence", "masks", "--layer", "things")
    run("segment", nested.scene, *words, "--level", "part", "--export", "--report", *CPU)
    assert isinstance(load_scene_layer(nested.scene, "things"), Labels)
    assert "The tree" not in (nested.scene / "reports" / "things.html").read_text()
    assert not (nested.scene / "exports" / "things" / "nodes.csv").exists()


def test_info_counts_the_levels(treed, run) -> None:
    assert "tree of 5 nodes (1 groups, 2 objects, 2 parts)" in run("info", treed.scene)


@pytest.mark.parametrize(
    ("address", "level"),
    [("things", "object"), ("things@part", "part"), ("things@group", "group"), ("things@0.5", 0.5)],
)
def test_render_draws_the_level_that_is_asked_for(treed, run, tmp_path, address, level) -> None:
    run("render", treed.scene, "--what", address, "-o", tmp_path / "out", *CPU)
    scene = load_scene(treed.scene)
    (view,) = scene.test_views
    drawn = np.array(Image.open(tmp_path / "out" / address / f"{view.name}.png"))
    cut = tree_in(treed.scene).cut(level)
    expected = label_map(scene.gaussians, view.camera, cut, backend="cpu").ids.clamp_min(0)
    assert np.array_equal(drawn, expected.numpy())
    wanted = {"object": {1, 2}, "part": {2, 5, 6}, "group": {4}, 0.5: {1, 2}}[level]
    assert set(np.unique(drawn).tolist()) - {0} == wanted


def test_evaluate_scores_the_level_that_is_asked_for(treed, run, tmp_path) -> None:
    tree = tree_in(treed.scene)
    truth = tmp_path / "truth"
    truth.mkdir()
    for path in (treed.capture / "semantic").glob("*.png"):
        ids = np.array(Image.open(path))
        Image.fromarray(np.where(ids > 1, 1, 0).astype(np.uint8)).save(truth / path.name)
    figures = {}
    for level in ("group", "object", "part"):
        save_scene_layer(tree.cut(level), treed.scene, f"cut_{level}")
        scored = [
            json.loads(
                run(
                    "evaluate", treed.scene, "--layer", layer, "--truth", truth,
                    "--metric", "instances", "--json", *CPU,
                )
            )
            for layer in (f"things@{level}", f"cut_{level}")
        ]  # fmt: skip
        assert scored[0]["mIoU"] == scored[1]["mIoU"]
        assert scored[0]["predicted_instances"] == scored[1]["predicted_instances"]
        figures[level] = scored[0]
    assert [figures[k]["predicted_instances"] for k in figures] == [1, 2, 3]
    assert figures["group"]["mIoU"] > 0.8 > 0.6 > figures["object"]["mIoU"]


def test_export_writes_the_level_that_is_asked_for(treed, run, tmp_path) -> None:
    words = ("--what", "objects", "--layer", "things@part", "-o", tmp_path / "parts")
    run("export", treed.scene, *words)
    names = sorted(path.name for path in (tmp_path / "parts").glob("*.ply"))
    assert names == ["002_right.ply", "005_upper.ply", "006_lower.ply"]
    gaussians = load_scene(treed.scene).gaussians
    ids = tree_in(treed.scene).labels.ids
    for name in names:
        part = read_splats(tmp_path / "parts" / name)
        assert torch.equal(part.means, gaussians.means[ids == int(name[:3])])
    run("export", treed.scene, "--what", "objects", "--layer", "things", "-o", tmp_path / "whole")
    names = sorted(path.name for path in (tmp_path / "whole").glob("*.ply"))
    assert names == ["001_left.ply", "002_right.ply"]


def test_edit_takes_a_part_and_the_tree_stays_in_step(treed, run, tmp_path) -> None:
    before = tree_in(treed.scene)
    words = ("--remove", "--layer", "things@part", "--names", "upper", "--cut", "off")
    run("edit", treed.scene, "-o", tmp_path / "bare", *words)
    after = tree_in(tmp_path / "bare")
    assert after.nodes == before.nodes
    # The Gaussian without a label touches the upper half alone: a speck that goes along.
    stays = before.labels.ids != 5
    assert torch.equal(after.labels.ids, before.labels.ids[stays & (before.labels.ids >= 0)])
    run("edit", treed.scene, "-o", tmp_path / "all", *words, "--specks", 0)
    assert torch.equal(tree_in(tmp_path / "all").labels.ids, before.labels.ids[stays])

    words = ("--extract", "--layer", "things", "--ids", 1, "--cut", "off")
    run("edit", treed.scene, "-o", tmp_path / "left", *words)
    left = tree_in(tmp_path / "left").labels.ids
    assert torch.equal(left, before.labels.ids[before.cut().ids == 1])
    assert left.unique().tolist() == [5, 6]


def test_an_object_cut_at_its_border_keeps_its_parts(treed, run, tmp_path) -> None:
    """What is split along the border goes to both sides, with the deepest node that it had."""
    words = ("--remove", "--layer", "things", "--ids", 1, "--cut", "layer", *CPU)
    before = tree_in(treed.scene)
    run("edit", treed.scene, "-o", tmp_path / "bare", *words)
    after = tree_in(tmp_path / "bare")
    assert len(after) == len(load_scene(tmp_path / "bare").gaussians)
    assert after.nodes == before.nodes
    assert int((after.cut().ids == 2).sum()) >= int((before.cut().ids == 2).sum())
    assert 1 not in after.cut().ids.tolist()


def test_merged_trees_stand_side_by_side(treed, run, tmp_path) -> None:
    other = shutil.copytree(treed.scene, tmp_path / "other")
    run("edit", treed.scene, "-o", tmp_path / "both", "--merge", other, "--move", 9, 0, 0)
    one, both = tree_in(treed.scene), tree_in(tmp_path / "both")
    count, shift = len(one), max(node.id for node in one.nodes)
    assert len(both) == 2 * count
    assert both.nodes[: len(NODES)] == one.nodes
    for node, moved in zip(one.nodes, both.nodes[len(NODES) :], strict=True):
        assert moved.id == node.id + shift
        assert moved.parent == (node.parent + shift if node.parent > 0 else -1)
        assert (moved.name, moved.level) == (node.name, node.level)
    for level in ("group", "object", "part"):
        whole, cut = both.cut(level).ids, one.cut(level).ids
        assert torch.equal(whole[:count], cut)
        assert torch.equal(whole[count:], torch.where(cut > 0, cut + shift, cut))


@pytest.mark.parametrize(
    ("address", "message"),
    [
        (
            "things@whole",
            "level: expected group, object, part or a number from 0 to 1, got 'whole'",
        ),
        ("things@1.5", "level: expected group, object, part or a number from 0 to 1, got '1.5'"),
        ("flat@part", "layer 'flat': expected a tree, of which part is a level, got none"),
    ],
)
@pytest.mark.parametrize("command", ["render", "evaluate", "export", "edit"])
def test_levels_that_are_not_there_get_one_sentence(
    treed, splatseg, tmp_path, command, address, message
) -> None:
    out = tmp_path / "out"
    words = {
        "render": ("--what", address, "-o", out, *CPU),
        "evaluate": ("--layer", address, "--truth", treed.capture / "semantic", *CPU),
        "export": ("--what", "objects", "--layer", address, "-o", out),
        "edit": ("--remove", "--layer", address, "--ids", 5, "--cut", "off", "-o", out),
    }[command]
    status, printed, err = splatseg(command, treed.scene, *words)
    assert status == 2
    assert message in " ".join(err.split())
    assert "Traceback" not in err
    assert printed == ""
    assert not out.exists()
