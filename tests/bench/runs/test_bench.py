"""Protocols end to end on a generated room, by the command; figures held to another scorer's."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.cli import main
from splatseg.core.scans import LabelledPoints
from splatseg.evaluate import SurfaceField
from splatseg.io.evidence import create_evidence, save_label_map
from splatseg_bench.layouts import read_benchmark
from splatseg_bench.results import load_result
from splatseg_bench.scene import BenchmarkScene, TrueMaps
from support.arrays import arrays_of

DataSet = Callable[[str], Path]
EVIDENCE = ("masks_sam", "labels_semantic", "labels_panoptic", "features_text", "features_dino")
BESIDE = ("--companion", "masks_sam")
HALF = ("--option", "view_share=0.5")
STEPS = ("--steps", "60", "--max-gaussians", "4000", "--quiet")


@pytest.fixture(scope="session")
def bench(data_set: DataSet, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Runs a protocol on a layout once; the folder, which is shared by those of a layout."""
    folders: dict[str, Path] = {}
    done: set[tuple[str, ...]] = set()

    def run(protocol: str, layout: str, *words: str) -> Path:
        data = data_set(layout)
        out = folders.setdefault(layout, tmp_path_factory.mktemp(f"bench-{layout}") / "out")
        asked = (protocol, layout, *words)
        if asked not in done:
            named = [evidence(data, word) if word in EVIDENCE else word for word in words]
            command = ("bench", protocol, "--data", data, "-o", out, *STEPS, *named)
            assert main([str(word) for word in command]) == 0
            done.add(asked)
        return out

    return run


def evidence(data: Path, name: str) -> str:
    return str(data / "evidence" / "{scene}" / name)


def scene_of(layout: str, data: Path) -> BenchmarkScene:
    (scene,) = read_benchmark(layout, data)
    return scene


def content(out: Path, protocol: str) -> dict[str, Any]:
    return json.loads((out / f"{protocol}.json").read_text())


def save_masks(scene: BenchmarkScene, folder: Path) -> None:
    """True masks as files that the other scorer reads."""
    for task in scene.tasks:
        for true in task.truth:
            path = folder / task.name / f"{true.view}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(true.read().numpy().astype(np.uint8) * 255).save(path)


def save_maps(maps: TrueMaps, views: list[str], folder: Path) -> None:
    folder.mkdir(parents=True)
    for view in views:
        ids = maps.read[view]().ids.clamp_min(0).numpy().astype(np.uint16)
        Image.fromarray(ids).save(folder / f"{view}.png")


@pytest.mark.parametrize(
    ("protocol", "layout", "words"),
    [
        ("spin-nerf", "spin-nerf", ("--method", "uplift")),
        ("spin-nerf-ludvig", "spin-nerf", ("--method", "associate", "--model", "masks_sam")),
        ("nvos", "nvos", ("--method", "uplift")),
        ("lerf-ovs-2d", "lerf-ovs", ("--method", "features", "--model", "features_text")),
        ("lerf-ovs-3d", "lerf-ovs", ("--method", "features", "--model", "features_text")),
        ("lerf-ovs-2d", "lerf-ovs", ("--method", "objects", "--model", "features_text", *BESIDE)),
        ("lerf-ovs-3d", "lerf-ovs", ("--method", "objects", "--model", "features_text", *BESIDE)),
        ("lerf-ovs-2d", "lerf-ovs", ("--method", "voxels", "--model", "features_text")),
        ("spin-nerf-words", "spin-nerf", ("--method", "features", "--model", "features_text")),
        ("lerf-mask", "lerf-mask", ("--method", "features", "--model", "features_text")),
        ("3d-ovs", "3d-ovs", ("--method", "features", "--model", "features_text")),
    ],
)
def test_masks(protocol: str, layout: str, words, bench, data_set, tmp_path, score) -> None:
    """Every protocol of things asked for, with a method of each kind that can answer it."""
    data, out = data_set(layout), bench(protocol, layout, *words)
    found = content(out, protocol)
    (method,) = found["methods"]
    scores = found["methods"][method]["scores"]
    scene = scene_of(layout, data)
    result = load_result(out / "results" / protocol / method / f"{scene.name}.json")
    assert result.switches == found["switches"]
    assert {"command", "seed", "gaussians", "versions", "options"} <= set(result.made)
    save_masks(scene, tmp_path / "truth")
    predictions = out / "predictions" / protocol / method / scene.name
    ious: dict[str, float] = {}
    for task in scene.tasks:
        views = sorted(path.stem for path in (predictions / task.name).glob("*.png"))
        rows = [row for row in result.rows if row["task"] == task.name]
        assert views == sorted(row["view"] for row in rows)
        truth = tmp_path / "scored" / task.name
        truth.mkdir(parents=True)
        for view in views:
            (tmp_path / "truth" / task.name / f"{view}.png").rename(truth / f"{view}.png")
        theirs = score("binary", "--pred", predictions / task.name, "--truth", truth)
        ious[task.name] = theirs["IoU_mean_over_views"]
        assert np.mean([row["iou"] for row in rows]) == pytest.approx(
            theirs["IoU_mean_over_views"], abs=1e-6
        )
        assert np.mean([row["accuracy"] for row in rows]) == pytest.approx(
            theirs["accuracy"], abs=1e-6
        )
    if found["switches"]["averaging"] in ("tasks", "scenes"):
        assert scores["iou"] == pytest.approx(np.mean(list(ious.values())), abs=1e-6)
    # Chance of a mask as large as these is a few percent; a poor fit reaches more.
    assert scores["iou"] > 0.1


@pytest.mark.parametrize(
    ("protocol", "layout", "words"),
    [
        ("spin-nerf", "spin-nerf", ("--model", "masks_sam")),
        ("spin-nerf", "spin-nerf", ("--model", "masks_sam", "--published")),
        ("spin-nerf-words", "spin-nerf", ("--model", "features_text", *BESIDE, *HALF)),
        ("lerf-ovs-2d", "lerf-ovs", ("--model", "features_text", *BESIDE)),
    ],
)
def test_a_method_that_is_asked_for_each_thing(
    protocol: str, layout: str, words, data_set, tmp_path
) -> None:
    """Prompts of a protocol become points by hand, or words, of the method."""
    data, out = data_set(layout), tmp_path / "out"
    named = [evidence(data, word) if word in EVIDENCE else word for word in words]
    command = ("bench", protocol, "--data", data, "-o", out, *STEPS, "--method", "prompt", *named)
    assert main([str(word) for word in command]) == 0
    found = content(out, protocol)["methods"]
    (method,) = found
    (scene,) = read_benchmark(layout, data)
    result = load_result(out / "results" / protocol / method / f"{scene.name}.json")
    masks = out / "predictions" / protocol / method / scene.name
    drawn = [path for task in scene.tasks for path in (masks / task.name).glob("*.png")]
    told = [note for note in result.notes if "nothing was selected" in note]
    assert len(drawn) + len(told) > 0
    assert result.made["options"]["view_share"] == (
        0.5 if "--published" in words or "--option" in words else 1.0
    )
    if "--published" not in words:
        assert drawn
        assert found[method]["scores"]["iou"] > 0.1


def test_classes_and_instances_of_views(bench, data_set, tmp_path, score) -> None:
    data, models = data_set("replica"), ("labels_semantic", "labels_panoptic")
    out = bench("replica", "replica", "--method", "uplift,associate", "--model", *models)
    found = content(out, "replica")["methods"]
    scene = scene_of("replica", data)
    assert scene.semantic is not None
    assert scene.instances is not None
    tests = [view.name for view in scene.capture.test_views if view.name in scene.semantic.read]
    save_maps(scene.semantic, tests, tmp_path / "semantic")
    save_maps(scene.instances, tests, tmp_path / "instance")
    predictions = out / "predictions" / "replica"
    classes = predictions / "uplift" / scene.name / "classes"
    theirs = score("semantic", "--pred", classes, "--truth", tmp_path / "semantic")
    ours = found["uplift"]["scores"]
    assert ours["miou"] == pytest.approx(theirs["mIoU"], abs=1e-6)
    assert ours["fwiou"] == pytest.approx(theirs["fwIoU"], abs=1e-6)
    assert ours["accuracy"] == pytest.approx(theirs["accuracy"], abs=1e-6)
    assert ours["miou"] > 0.1
    instances = predictions / "associate" / scene.name / "instances"
    theirs = score("instances", "--pred", instances, "--truth", tmp_path / "instance")
    ours = found["associate"]["scores"]
    assert ours["pooled_instance_miou"] == pytest.approx(theirs["mIoU"], abs=1e-6)
    assert {"pq_scene", "pq", "ap50", "instance_miou", "precision", "recall"} <= set(ours)
    assert ours["pq_scene"] > 0.05
    # The same predictions under the protocol that counts what has no instance as one.
    bench("replica-gaga", "replica", "--method", "associate", "--model", models[1])
    gaga = content(out, "replica-gaga")["methods"]["associate"]["scores"]
    assert gaga["instance_miou"] != ours["instance_miou"]


def test_classes_of_views_whose_truth_is_a_labelled_scan(bench, data_set, tmp_path) -> None:
    """Truth is drawn from the scan; photographs are fisheye ones, and so is the evidence."""
    data = data_set("scannetpp")
    scene = scene_of("scannetpp", data)
    assert scene.semantic is None
    assert scene.points is not None
    field = SurfaceField(
        LabelledPoints(points=scene.points.points, labels={"label": scene.points.labels.ids})
    )
    folder = create_evidence(tmp_path / "labels", kind="labels", classes=scene.points.table)
    for view in scene.capture.train_views:
        with field.view(view.camera) as drawn:
            save_label_map(drawn.label_map("label"), folder, view.name)
    out = bench("scannetpp", "scannetpp", "--method", "uplift", "--model", str(folder))
    result = load_result(out / f"results/scannetpp/uplift/{scene.name}.json")
    assert result.scores["miou"] > 0.3
    assert len(result.rows) == len(scene.capture.test_views)
    # Recorded evidence, seen through the lens as the photographs are: of classes, and of words.
    bench("scannetpp", "scannetpp", "--method", "vote", "--model", "labels_semantic")
    result = load_result(out / f"results/scannetpp/vote/{scene.name}.json")
    assert result.scores["miou"] > 0.25
    for method, beside in (("objects", BESIDE), ("voxels", ()), ("voxels", ("--published",))):
        bench("scannetpp", "scannetpp", "--method", method, "--model", "features_text", *beside)
        result = load_result(out / f"results/scannetpp/{method}/{scene.name}.json")
        assert result.scores["miou"] > 0.02


@pytest.mark.parametrize("method", ["uplift", "features", "objects", "voxels"])
def test_classes_of_points(method: str, bench, data_set, tmp_path, score) -> None:
    data = data_set("scannet")
    name = "labels_semantic" if method == "uplift" else "features_text"
    words = ("--method", method, "--model", name, "--switch", "frame_step=1")
    words += BESIDE if method == "objects" else ()
    out = bench("scannet-19", "scannet", *words)
    scene = scene_of("scannet", data)
    ours = load_result(out / f"results/scannet-19/{method}/{scene.name}.json").scores
    path = out / "predictions" / "scannet-19" / method / f"{scene.name}.npz"
    arrays = arrays_of(path)
    np.savez(tmp_path / "truth.npz", semantic=arrays["truth"])
    theirs = score("points", "--pred", path, "--truth", tmp_path / "truth.npz")
    assert ours["miou"] == pytest.approx(theirs["mIoU"], abs=1e-6)
    assert ours["miou"] > 0.1
    assert scene.points is not None
    wanted = torch.isin(scene.points.labels.ids, torch.tensor(range(1, 41)))
    assert (arrays["truth"] > 0).sum() <= int(wanted.sum())
