"""CoSSegGaussians' protocols end to end on tiny rooms: figures held to other scorers'."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.cli import main
from splatseg.errors import InputError
from splatseg.io.evidence import FeatureEvidence
from splatseg.io.scene import load_scene
from splatseg.methods import Method, _method, identity, register_method, uplift
from splatseg.methods.identity import IdentityOptions
from splatseg.methods.uplift import UpliftMethodOptions
from splatseg_bench.layouts import read_benchmark
from splatseg_bench.results import load_result
from splatseg_bench.scene import BenchmarkScene
from splatseg_bench.scenes import walk_splits
from support import recorded
from support.walks import SCENES, copied, fits, models

METHODS = ("uplift", "associate", "identity")
STUFF = ("wall", "floor", "ceiling")


@dataclass(frozen=True, slots=True, kw_only=True)
class FewSteps(IdentityOptions):
    steps: int = 40


@pytest.fixture(autouse=True)
def identity_of_few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Identity by its name, trained for a second."""
    monkeypatch.setattr(identity, "METHOD", replace(identity.METHOD, options=FewSteps))


@pytest.fixture(scope="module")
def done(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, str], Path]:
    """Runs all methods on a layout in a task once, by the command; the folder."""
    out = tmp_path_factory.mktemp("rooms") / "out"
    shutil.copytree(walk / "fits", out.parent / "fits")  # evidence is written beside them
    made: set[tuple[str, str]] = set()

    def run(layout: str, task: str) -> Path:
        if (layout, task) not in made:
            words = ["bench", f"cosseg-{layout}-{task}", "--data", walk / layout, "-o", out]
            words += ["--method", ",".join(METHODS), "--scenes", SCENES[layout], "--quiet"]
            words += ["--model", *models(walk, layout), "--fitted", fits(out.parent, layout)]
            assert main([str(word) for word in words]) == 0
            made.add((layout, task))
        return out

    return run


def only(done: Any) -> dict[str, float]:
    (method,) = done.methods
    return dict(method.scores)


def notes(done: Any) -> str:
    return " ".join(done.methods[0].scenes[0].notes)


def scene_of(walk: Path, layout: str) -> BenchmarkScene:
    (scene,) = read_benchmark(layout, walk / layout)
    return scene


def save_truth(scene: BenchmarkScene, folder: Path) -> list[str]:
    """True maps of the test views as files that another scorer reads, and what classes are."""
    assert scene.semantic is not None
    assert scene.instances is not None
    splits = walk_splits(scene.capture, 5)
    tests = [name for name, split in splits.items() if split == "test"]
    for kind, maps in (("classes", scene.semantic), ("instances", scene.instances)):
        (folder / kind).mkdir(parents=True)
        for view in tests:
            ids = maps.read[view]().ids.clamp_min(0).numpy().astype(np.uint16)
            Image.fromarray(ids).save(folder / kind / f"{view}.png")
    assert scene.semantic.table is not None
    rows = [
        {"id": row.id, "name": row.name, "isthing": row.name not in STUFF}
        for row in scene.semantic.table.rows
    ]
    (folder / "metadata.json").write_text(json.dumps({"classes": rows}))
    return tests


@pytest.mark.parametrize("layout", ["replica", "scannet"])
@pytest.mark.parametrize("method", METHODS)
def test_classes_as_another_scorer_has_them(method, layout, done, walk, tmp_path, score) -> None:
    out = done(layout, "semantic")
    tests = save_truth(scene_of(walk, layout), tmp_path)
    name = f"cosseg-{layout}-semantic"
    predictions = out / "predictions" / name / method / SCENES[layout] / "classes"
    assert sorted(path.stem for path in predictions.glob("*.png")) == sorted(tests)
    theirs = score("semantic", "--pred", predictions, "--truth", tmp_path / "classes")
    result = load_result(out / "results" / name / method / f"{SCENES[layout]}.json")
    assert set(result.scores) == {"miou", "accuracy", "fps", "learned_mb", "scene_mb"}
    assert result.scores["miou"] == pytest.approx(theirs["mIoU"], abs=1e-6)
    assert result.scores["accuracy"] == pytest.approx(theirs["accuracy"], abs=1e-6)
    assert sorted(row["view"] for row in result.rows) == sorted(tests)
    # Chance is a few percent, four training views of ScanNet's walk see a third of the room.
    assert result.scores["miou"] > (0.3 if layout == "replica" else 0.1)


@pytest.mark.parametrize("layout", ["replica", "scannet"])
@pytest.mark.parametrize("method", METHODS)
def test_segments_as_another_scorer_has_them(method, layout, done, walk, tmp_path, score) -> None:
    out = done(layout, "panoptic")
    save_truth(scene_of(walk, layout), tmp_path)
    name = f"cosseg-{layout}-panoptic"
    found = out / "predictions" / name / method / SCENES[layout]
    theirs = score(
        "panoptic", "--pred-instance", found / "instances", "--pred-semantic", found / "classes",
        "--truth-instance", tmp_path / "instances", "--truth-semantic", tmp_path / "classes",
        "--metadata", tmp_path / "metadata.json",
    )  # fmt: skip
    result = load_result(out / "results" / name / method / f"{SCENES[layout]}.json")
    assert list(result.scores) == ["miou", "ap50", "pq_scene", "fps", "learned_mb", "scene_mb"]
    assert result.scores["pq_scene"] == pytest.approx(theirs["PQ_scene"], abs=1e-6)
    assert result.scores["ap50"] == pytest.approx(theirs["mAP50"], abs=1e-6)
    assert result.scores["miou"] == pytest.approx(theirs["mIoU"], abs=1e-6)
    assert result.scores["pq_scene"] > (0.2 if layout == "replica" else 0.03)
    assert {"class", "name", "pq", "ap50", "iou"} <= set(result.rows[0])


@pytest.mark.parametrize("task", ["semantic", "panoptic"])
def test_costs_are_measured(task, done, walk) -> None:
    """Bytes can be counted by hand; a rate is above 0, and its note says of which machine it is."""
    out = done("replica", task)
    gaussians = load_scene(walk / "fits/replica/room_0").gaussians
    count = len(gaussians)
    own = 4 * count * (3 + 4 + 3 + 1 + 3) / 1e6
    content = json.loads((out / f"cosseg-replica-{task}.json").read_text())["methods"]
    for method in ("uplift", "associate"):
        assert content[method]["scores"]["learned_mb"] == pytest.approx(4 * count / 1e6)
        assert content[method]["scores"]["scene_mb"] == pytest.approx(4 * count / 1e6 + own)
    learned = content["identity"]["scores"]["learned_mb"]
    # 16 channels a Gaussian, and a row of weights and a bias for each of at most 60 ids.
    assert 64 * count / 1e6 < learned <= (64 * count + 60 * 17 * 4) / 1e6
    assert content["identity"]["scores"]["scene_mb"] == pytest.approx(learned + own)
    path = f"results/cosseg-replica-{task}/uplift/room_0.json"
    said = load_result(out / path).notes[-1]
    assert said.startswith("fps: label maps of 80x60 pixels drawn per second on this machine")
    assert "median of 15 views" in said
    assert all(one["scores"]["fps"] > 0 for one in content.values())
    table = (out / f"cosseg-replica-{task}.md").read_text()
    assert "680.3" in table or "681.1" in table


def test_the_table_has_the_papers_rows(done) -> None:
    text = (done("replica", "panoptic") / "cosseg-replica-panoptic.md").read_text()
    for method in ("Panoptic Lifting", "Gaussian Grouping", "CoSSegGaussians"):
        assert method in text
    assert "CoSSegGaussians, Table 2" in text


def test_tracks_are_named_by_their_votes(run_room, walk, tmp_path) -> None:
    """Ids of tracks are no classes: what they are is told by the categories under them."""
    data = copied(walk, "replica", tmp_path)
    path = data / "evidence/room_0/labels_tracked/tracks.json"
    content = json.loads(path.read_text())
    for track in content["tracks"].values():
        track["category_votes"] = {"lamp": 5}
    path.write_text(json.dumps(content))
    named = (str(data / "evidence" / "{scene}" / "labels_tracked"),)
    usual = run_room("cosseg-replica-panoptic")
    lamps = run_room("cosseg-replica-panoptic", models=named)
    assert only(lamps)["miou"] < 0.1 < only(usual)["miou"]
    for track in content["tracks"].values():
        track["category_votes"] = {}
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="method uplift: expected instances whose classes are"):
        run_room("cosseg-replica-panoptic", models=named, again=True)


def test_any_registered_method_that_takes_labels(run_room) -> None:
    given: list[Any] = []

    def keep(inputs, options):
        given.append(inputs)
        return uplift.run(inputs, options)

    stranger = Method(
        name="stranger", summary="s", reference="r", evidence=("labels", "tracked"),
        options=UpliftMethodOptions, run=keep, keeps_ids=True,
    )  # fmt: skip
    register_method(stranger)
    try:
        for task, kind in (("semantic", "labels"), ("panoptic", "tracked")):
            protocol = f"cosseg-replica-{task}"
            theirs = only(run_room(protocol, methods=("stranger",)))
            ours = only(run_room(protocol))
            assert theirs | {"fps": 0} == ours | {"fps": 0}
            assert given[-1].evidence.kind == kind
        # Ids that are no tracks have no classes, if the layer does not tell them.
        register_method(replace(stranger, name="other", keeps_ids=False))
        with pytest.raises(InputError, match="method other: expected instances whose classes are"):
            run_room("cosseg-replica-panoptic", methods=("other",))
    finally:
        for name in ("stranger", "other"):
            _method._REGISTERED.pop(name, None)


def test_classes_by_words(run_room, walk) -> None:
    """Features of words are read by the names of the truth's classes."""
    found = run_room("cosseg-replica-semantic", methods=("features",))
    assert only(found)["miou"] > 0.2
    count = len(load_scene(walk / "fits/replica/room_0").gaussians)
    assert only(found)["learned_mb"] == pytest.approx(4 * 16 * count / 1e6), "16 channels"


def test_methods_and_evidence_that_tell_no_classes(run_room, walk) -> None:
    with pytest.raises(InputError, match="method saga: expected one that takes panoptic or tr"):
        run_room("cosseg-replica-semantic", methods=("saga",))
    with pytest.raises(InputError, match="method features: expected one that takes panoptic"):
        run_room("cosseg-replica-panoptic", methods=("features",))
    tracked = models(walk, "replica")[2:3]
    with pytest.raises(InputError, match="method uplift: expected a model that gives labels, got"):
        run_room("cosseg-replica-semantic", models=tracked)


@dataclass(frozen=True, slots=True, kw_only=True)
class GuidedOptions:
    guidance: str | None = None


def test_features_besides_the_evidence(run_room, walk, tmp_path) -> None:
    """A method that takes more is given it, and the result tells."""
    given: list[Any] = []

    def keep(inputs, options):
        given.append((inputs.companions.get("guidance"), options))
        return uplift.run(inputs, UpliftMethodOptions())

    seen = {}
    for path in sorted((walk / "replica/evidence/room_0/labels_semantic").glob("*.png")):
        ids = np.asarray(Image.open(path)).astype(np.int64)
        seen[path.stem] = recorded.Seen(semantic=ids, instance=ids, part=ids)
    folder = tmp_path / "features_dino"
    recorded.write_dino(folder, seen)
    register_method(
        Method(
            name="guided", summary="s", reference="r", evidence=("labels",), options=GuidedOptions,
            run=keep, companions={"guidance": ("features",)}, keeps_ids=True,
        )
    )  # fmt: skip
    try:
        protocol = "cosseg-replica-semantic"
        without = run_room(protocol, methods=("guided",))
        assert given[-1][0] is None
        found = run_room(protocol, methods=("guided",), companions=(str(folder),))
        assert isinstance(given[-1][0], FeatureEvidence)
        assert given[-1][1].guidance == "features_dino"
        assert found.kept == 0, "another experiment"
        made = [one.methods[0].scenes[0].made for one in (without, found)]
        assert [one.get("companions") for one in made] == [None, [str(folder)]]
        with pytest.raises(
            InputError, match="companions: expected a model that gives features, got"
        ):
            run_room(protocol, methods=("guided",), companions=models(walk, "replica")[:1])
        with pytest.raises(
            InputError, match="companions: expected a method that takes more than its"
        ):
            run_room(protocol, companions=(str(folder),))
    finally:
        del _method._REGISTERED["guided"]


def test_companions_of_the_command_reach_the_run(walk, tmp_path, capsys) -> None:
    words = ["bench", "cosseg-replica-semantic", "--data", walk / "replica", "-o", tmp_path / "out"]
    words += ["--method", "uplift", "--companion", "features_dino", "--quiet"]
    assert main([str(word) for word in words]) == 2
    said = capsys.readouterr().err
    assert "companions: expected a method that takes more than its evidence, got uplift" in said


def test_void_of_the_truth_is_left_out(run_room, walk, tmp_path) -> None:
    """0 in a map is none: what lies there is neither right nor wrong."""
    data = copied(walk, "replica", tmp_path)
    folder = data / "room_0/Sequence_1/semantic_class"
    for path in folder.glob("semantic_class_*.png"):
        ids = np.array(Image.open(path))
        ids[:, :60] = 0
        Image.fromarray(ids).save(path)
    found = run_room("cosseg-replica-semantic", data=data)
    (scene,) = read_benchmark("replica", data)
    assert scene.semantic is not None
    tests = [name for name, split in walk_splits(scene.capture, 5).items() if split == "test"]
    right = total = 0
    predictions = tmp_path / "out/predictions/cosseg-replica-semantic/uplift/room_0/classes"
    for name in tests:
        true = scene.semantic.read[name]().ids[:, 60:]
        drawn = torch.from_numpy(np.array(Image.open(predictions / f"{name}.png")).astype(np.int32))
        right += int((drawn[:, 60:] == true).sum())
        total += true.numel()
    assert only(found)["accuracy"] == pytest.approx(right / total)
