"""evaluate: every metric equals the independent scorer's on the maps that render writes."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import (
    InstanceFacts,
    Labels,
    LayerInfo,
    Selection,
)
from splatseg.io.scene import load_scene, load_scene_layer, save_scene_layer
from splatseg.lift import labels_of_points

CPU = ("--backend", "cpu")
CLASSES = [
    {"id": 1, "name": "sky", "isthing": False},
    {"id": 2, "name": "left wall", "isthing": True},
    {"id": 7, "name": "right wall", "isthing": True},
]


def labels_of(ids: torch.Tensor, background: int = -1) -> Labels:
    return Labels(
        ids=ids,
        confidence=torch.ones(len(ids)),
        background=background,
        info=LayerInfo(views=("train_0",)),
    )


@pytest.fixture
def labelled(small):
    """Layers of classes and of instances with mistakes, and the true instances of every view."""
    means = load_scene(small.scene).gaussians.means
    x, y = means[:, 0], means[:, 1]
    classes = torch.where(x < 0.15, 2, 7)
    classes[(x > 1.2) & (y > 0.5)] = -1
    classes[(x < -1.4) & (y > 0.9)] = 7
    instances = torch.where(x < -0.3, 4, torch.where(x < 0.7, 5, 600))
    save_scene_layer(labels_of(classes, background=1), small.scene, "classes")
    save_scene_layer(labels_of(instances), small.scene, "objects")
    (small.capture / "instance").mkdir()
    for path in sorted((small.capture / "semantic").iterdir()):
        truth = np.array(Image.open(path))
        ids = np.where(truth == 2, 21, np.where(truth == 7, 22, 0))
        ids[:, 24:] = np.where(truth[:, 24:] == 7, 23, ids[:, 24:])
        Image.fromarray(ids.astype(np.uint16)).save(small.capture / "instance" / path.name)
    (small.capture / "metadata.json").write_text(json.dumps({"classes": CLASSES}))
    return small


@pytest.fixture
def both(labelled, splatseg, score, tmp_path):
    """Run evaluate, and the scorer on what render writes of the same views."""
    out = tmp_path / "out"
    words = ("--split", "all", "--what", "classes,objects", "-o", out, *CPU)
    assert splatseg("render", labelled.scene, *words)[0] == 0

    def run(ours: tuple, theirs: tuple) -> tuple[dict, dict]:
        status, text, err = splatseg(
            "evaluate", labelled.scene, *ours, "--split", "all", "--json", *CPU
        )
        assert status == 0, err
        return json.loads(text), score(*theirs)

    run.out = out
    return run


def test_instances_agree_with_the_scorer(labelled, both) -> None:
    truth = labelled.capture / "instance"
    ours, theirs = both(
        ("--layer", "objects", "--truth", truth, "--metric", "instances"),
        ("instances", "--pred", both.out / "objects", "--truth", truth),
    )
    assert 0.3 < theirs["mIoU"] < 0.95, "the case must test something"
    for key, value in theirs.items():
        assert ours[key] == pytest.approx(value, abs=1e-9), key
    assert ours["learned_from"] == 1


def test_panoptic_agrees_with_the_scorer(labelled, both) -> None:
    capture, metadata = labelled.capture, labelled.capture / "metadata.json"
    ours, theirs = both(
        (
            "--layer", "classes", "--truth", capture / "semantic", "--metric", "panoptic",
            "--instances", "objects", "--truth-instances", capture / "instance",
        ),
        (
            "panoptic", "--pred-instance", both.out / "objects",
            "--pred-semantic", both.out / "classes", "--truth-instance", capture / "instance",
            "--truth-semantic", capture / "semantic", "--metadata", metadata,
        ),
    )  # fmt: skip
    assert 0.1 < theirs["PQ_things"] < 0.95, "the case must test something"
    assert 0.1 < theirs["mAP50"] < 1
    for key, value in theirs.items():
        assert ours[key] == pytest.approx(value, abs=1e-9), key
    assert set(ours["PQ_per_class"]) == {"1", "2", "7"}
    assert set(ours["AP50_per_class"]) == {"2", "7"}


def test_a_layer_that_tells_the_classes_of_its_instances(labelled, both) -> None:
    capture = labelled.capture
    layer = load_scene_layer(labelled.scene, "objects")
    # Of the instance 600 no class is known.
    info = replace(layer.info, class_of={4: 2, 5: 7}, instances={600: InstanceFacts(segments=2)})
    save_scene_layer(replace(layer, info=info), labelled.scene, "objects")
    (both.out / "named").mkdir()
    for path in (both.out / "objects").glob("*.png"):
        ids = np.array(Image.open(path))
        named = np.where(ids == 4, 2, np.where(ids == 5, 7, 0)).astype(np.uint16)
        Image.fromarray(named).save(both.out / "named" / path.name)
    ours, theirs = both(
        (
            "--layer", "objects", "--truth", capture / "semantic", "--metric", "panoptic",
            "--truth-instances", capture / "instance",
        ),
        (
            "panoptic", "--pred-instance", both.out / "objects",
            "--pred-semantic", both.out / "named", "--truth-instance", capture / "instance",
            "--truth-semantic", capture / "semantic", "--metadata", capture / "metadata.json",
        ),
    )  # fmt: skip
    assert theirs["tp"] > 0
    for key, value in theirs.items():
        assert ours[key] == pytest.approx(value, abs=1e-9), key


def test_points_agree_with_the_scorer(labelled, both, rng, tmp_path) -> None:
    gaussians = load_scene(labelled.scene).gaussians
    xyz = gaussians.means[rng.integers(0, len(gaussians), 400)].numpy()
    xyz = (xyz + rng.normal(0, 0.05, xyz.shape)).astype(np.float32)
    semantic = np.where(xyz[:, 0] < 0, 2, 7).astype(np.uint8)
    semantic[:30] = 0
    instance = np.where(xyz[:, 0] < 0, 21, 22).astype(np.uint16)
    np.savez(tmp_path / "points.npz", xyz=xyz, semantic=semantic, instance=instance)
    ids = load_scene_layer(labelled.scene, "classes").ids
    given = labels_of_points(gaussians, ids, torch.from_numpy(xyz)).ids.numpy()
    np.savez(tmp_path / "pred.npz", semantic=given)
    ours, theirs = both(
        ("--layer", "classes", "--points", tmp_path / "points.npz"),
        ("points", "--pred", tmp_path / "pred.npz", "--truth", tmp_path / "points.npz"),
    )
    assert 0.5 < theirs["mIoU"] < 1
    for key in ("mIoU", "fwIoU", "accuracy", "mAcc"):
        assert ours[f"points_{key}"] == pytest.approx(theirs[key], abs=1e-9)
    assert ours["points"] == 370
    assert ours["points_unlabelled"] == pytest.approx((given[semantic > 0] < 0).mean())
    assert "mIoU" not in ours
    ours, _ = both(
        (
            "--layer", "objects", "--points", tmp_path / "points.npz", "--metric", "instances",
        ),
        ("points", "--pred", tmp_path / "pred.npz", "--truth", tmp_path / "points.npz"),
    )  # fmt: skip
    assert ours["points_truth_instances"] == 2


def test_tables_and_a_file(labelled, splatseg, tmp_path) -> None:
    capture = labelled.capture
    status, text, err = splatseg(
        "evaluate", labelled.scene, "--layer", "classes", "--truth", capture / "semantic",
        "--metric", "panoptic", "--instances", "objects",
        "--truth-instances", capture / "instance", "--json-file", tmp_path / "a.json", *CPU,
    )  # fmt: skip
    assert status == 0, err
    for word in ("PQ_scene", "mAP50", "left wall", "SQ", "average precision", " AP50"):
        assert word in text
    figures = json.loads((tmp_path / "a.json").read_text())
    assert figures["metric"] == "panoptic"
    assert figures["views"] == 1
    status, text, _ = splatseg(
        "evaluate", labelled.scene, "--layer", "classes", "--truth", capture / "semantic", *CPU
    )
    assert status == 0
    assert "boundary_mIoU" in text


def test_boundaries_of_a_mask(labelled, splatseg) -> None:
    ids = load_scene(labelled.scene).gaussians.means[:, 0]
    save_scene_layer(Selection(mask=ids > 0.2), labelled.scene, "right")
    words = ("--truth", labelled.capture / "semantic", "--metric", "binary", "--id", 7, "--json")
    status, text, err = splatseg("evaluate", labelled.scene, "--layer", "right", *words, *CPU)
    assert status == 0, err
    figures = json.loads(text)
    # One view: the mean over views is the pooled figure. An outline is harder than an area.
    assert figures["boundary_IoU_pooled"] == figures["boundary_IoU_mean_over_views"]
    assert 0.2 < figures["boundary_IoU_pooled"] < figures["IoU_pooled"] <= 1


def refusals(labelled, tmp_path):
    semantic, instance = labelled.capture / "semantic", labelled.capture / "instance"
    layer = ("--layer", "classes")
    panoptic = (*layer, "--truth", semantic, "--metric", "panoptic")
    whole = (*panoptic, "--instances", "objects", "--truth-instances", instance)
    np.savez(tmp_path / "flat.npz", xyz=np.zeros((3, 2)), semantic=np.ones(3, np.int64))
    np.savez(tmp_path / "floats.npz", xyz=np.zeros((3, 3)), semantic=np.ones(3))
    np.savez(tmp_path / "bare.npz", xyz=np.zeros((3, 3)))
    (tmp_path / "part").mkdir()
    return [
        (("--truth", semantic), "--layer"),
        (layer, "--truth"),
        (panoptic, "--truth-instances"),
        ((*panoptic, "--truth-instances", instance), "tells the class of each instance"),
        ((*layer, "--truth", semantic, "--instances", "objects"), "expected metric panoptic"),
        ((*whole, "--scores", "s.json"), "--scores: this option was removed; AP50 ranks all"),
        ((*whole, "--photographs"), "--photographs: this option was removed; renders are"),
        ((*whole, "--instances", "nothing"), "nothing"),
        ((*whole, "--classes", tmp_path / "no.json"), "or a JSON file, got"),
        ((*whole, "--metadata", "m.json"), "--metadata: this option was removed; --classes takes"),
        ((*whole, "--truth-instances", tmp_path / "part"), "part: expected evidence"),
        ((*layer, "--points", tmp_path / "no.npz"), "no.npz"),
        ((*layer, "--points", tmp_path / "flat.npz"), "flat.npz: expected xyz of n x 3"),
        ((*layer, "--points", tmp_path / "floats.npz"), "floats.npz: expected finite places"),
        ((*layer, "--points", tmp_path / "bare.npz"), "bare.npz: expected an array 'semantic'"),
        ((*layer, "--points", tmp_path / "bare.npz", "--metric", "binary"), "--points"),
    ]


def test_bad_input_gets_one_sentence(labelled, splatseg, tmp_path: Path) -> None:
    for words, told in refusals(labelled, tmp_path):
        status, _, err = splatseg("evaluate", labelled.scene, *words, *CPU)
        assert status == 2, words
        assert told in " ".join(err.split()), err
        assert len(err.strip().splitlines()) <= 3


def test_true_instances_of_every_view_are_needed(labelled, splatseg) -> None:
    (labelled.capture / "instance" / "test_2.png").unlink()
    words = (
        "--layer", "classes", "--truth", labelled.capture / "semantic", "--metric", "panoptic",
        "--instances", "objects", "--truth-instances", labelled.capture / "instance",
    )  # fmt: skip
    status, _, err = splatseg("evaluate", labelled.scene, *words, *CPU)
    assert status == 2
    assert "the first is test_2" in err


def evaluated(labelled, splatseg, *words) -> tuple[dict, str]:
    words = ("evaluate", labelled.scene, "--layer", "classes", "--json", *words, *CPU)
    status, text, err = splatseg(*words)
    assert status == 0, err
    return json.loads(text), " ".join(err.split())


def test_names_pixels_and_confusion(labelled, splatseg, tmp_path) -> None:
    """Counts add up to the truth's pixels, row by row, and give the IoU that is said."""
    truth = labelled.capture / "semantic"
    files = {kind: tmp_path / f"c.{kind}" for kind in ("csv", "md", "tex")}
    for kind, path in files.items():
        table = tmp_path / f"t.{kind}"
        figures, _ = evaluated(
            labelled, splatseg, "--truth", truth, "--split", "all", "--table", table,
            "--confusion", path,
        )  # fmt: skip
    assert figures["names_per_class"] == {"1": "sky", "2": "left wall", "7": "right wall"}
    ids = np.concatenate([np.array(Image.open(p)).ravel() for p in truth.iterdir()])
    pixels = {str(i): int((ids == i).sum()) for i in (1, 2, 7)}
    assert figures["pixels_per_class"] == pixels
    matrix = figures["confusion"]
    assert [sum(row) for row in matrix["counts"]] == list(pixels.values())
    counts = np.array(matrix["counts"])
    row, column = matrix["true"].index(2), matrix["predicted"].index(2)
    hits = counts[row, column]
    iou = hits / (counts[row].sum() + counts[:, column].sum() - hits)
    assert figures["per_class"]["2"] == pytest.approx(iou)

    lines = (tmp_path / "t.csv").read_text().splitlines()
    assert lines[0] == "id,class,pixels,IoU"
    assert lines[2].startswith(f"2,left wall,{pixels['2']},{figures['per_class']['2']}")
    assert lines[-1] == f",mean,{sum(pixels.values())},{figures['mIoU']}"
    markdown = (tmp_path / "t.md").read_text().splitlines()
    assert markdown[:2] == ["| id | class | pixels | IoU |", "| ---: | --- | ---: | ---: |"]
    assert f"| {figures['mIoU']:.4f} |" in markdown[-1]
    latex = (tmp_path / "t.tex").read_text()
    assert latex.startswith("\\begin{tabular}{rlrr}\n")
    assert f"2 & left wall & {pixels['2']} & {figures['per_class']['2']:.4f} \\\\" in latex
    lines = files["csv"].read_text().splitlines()
    assert lines[0].startswith("true class,")
    assert lines[0].endswith("left wall,right wall")
    assert lines[2].split(",")[0] == "left wall"
    assert sum(map(int, lines[2].split(",")[1:])) == pixels["2"]
    assert files["md"].read_text().startswith("| true class | ")
    status, text, _ = splatseg(
        "evaluate", labelled.scene, "--layer", "classes", "--truth", truth, *CPU
    )
    assert status == 0
    assert "pixels" in text
    assert "left wall" in text


def test_classes_scored_against_instances_are_noticed(labelled, splatseg, tmp_path) -> None:
    instance = labelled.capture / "instance"
    _, said = evaluated(labelled, splatseg, "--truth", instance)
    assert "holds instances" in said
    assert "metric instances compares things whatever their ids" in said
    other = tmp_path / "other"
    other.mkdir()
    for path in (labelled.capture / "semantic").iterdir():
        ids = np.array(Image.open(path)).astype(int)
        np.save(other / f"{path.stem}_gt.npy", np.where(ids == 2, 40, np.where(ids == 7, 50, 0)))
    figures, said = evaluated(labelled, splatseg, "--truth", other, "--suffix", "_gt")
    assert figures["mIoU"] == 0
    assert "once ids are matched one to one" in said
    _, said = evaluated(labelled, splatseg, "--truth", labelled.capture / "semantic")
    assert "matched" not in said
    assert "instances" not in said


def test_the_truths_own_table(labelled, splatseg) -> None:
    figures, _ = evaluated(
        labelled, splatseg, "--truth", labelled.capture / "semantic", "--classes", "ade20k"
    )
    assert figures["names_per_class"]["2"] == "building"


def test_tables_are_of_classes(labelled, splatseg, tmp_path) -> None:
    words = ("evaluate", labelled.scene, "--layer", "objects", "--truth")
    instance = labelled.capture / "instance"
    for more, message in (
        (("--table", "t.xls"), "--table: expected a file that ends in .csv, .md or .tex"),
        (("--confusion", tmp_path / "no" / "c.csv"), "--confusion: expected an existing folder"),
        (
            ("--metric", "instances", "--table", tmp_path / "t.md"),
            "expected scores of classes (metric semantic)",
        ),
    ):
        status, _, err = splatseg(*words, instance, *more, *CPU)
        assert status == 2
        assert message in " ".join(err.split())
    assert not (tmp_path / "t.md").exists()
