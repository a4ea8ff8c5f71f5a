"""CoSSegGaussians' protocols end to end on tiny rooms, by the command, and by other scorers."""

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
from splatseg.core.benchmark import BenchmarkScene
from splatseg.errors import InputError, MissingFileError
from splatseg.io.benchmarks import read_benchmark
from splatseg.io.benchmarks.replica_classes import REPLICA_CLASSES
from splatseg.io.evidence import FeatureEvidence
from splatseg.io.scene import load_scene
from splatseg.methods import Method, _registry, identity, register_method, uplift
from splatseg.methods.identity import IdentityOptions
from splatseg.methods.uplift import UpliftMethodOptions
from splatseg.tasks.benchmark import BenchOptions, bench, load_result
from splatseg.tasks.benchmark.walks import walk_splits
from support import recorded
from support.walks import EVIDENCE, write_fits, write_walk

METHODS = ("uplift", "associate", "identity")
SCENES = {"replica": "room_0", "scannet": "scene0010_00"}
STUFF = ("wall", "floor", "ceiling")


@dataclass(frozen=True, slots=True, kw_only=True)
class FewSteps(IdentityOptions):
    steps: int = 40


@pytest.fixture(autouse=True)
def identity_of_few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Identity by its name, trained for a second."""
    monkeypatch.setattr(identity, "METHOD", replace(identity.METHOD, options=FewSteps))


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``replica`` and ``scannet`` with evidence, and ``fits`` of both; not to be changed."""
    folder = tmp_path_factory.mktemp("walk")
    write_walk(folder)
    write_fits(folder, lambda capture: walk_splits(capture, 5), fits=folder / "fits")
    return folder


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


@pytest.fixture
def run(walk: Path, tmp_path: Path) -> Callable[..., Any]:
    """Runs uplift with other options than the protocol's; what it found."""

    def go(protocol: str, *switches: str, data: Path | None = None, **options: Any) -> Any:
        layout = protocol.split("-")[1]
        shutil.rmtree(tmp_path / "fits", ignore_errors=True)
        shutil.copytree(walk / "fits", tmp_path / "fits")
        given = {
            "models": models(walk, layout),
            "fitted": fits(tmp_path, layout),
            "scenes": (SCENES[layout],),
            "switches": switches,
            **options,
        }
        where = tmp_path / "out"
        return bench(protocol, data or walk / layout, where, options=BenchOptions(**given))

    return go


def models(walk: Path, layout: str) -> tuple[str, ...]:
    return tuple(str(walk / layout / "evidence" / "{scene}" / name) for name in EVIDENCE)


def fits(walk: Path, layout: str) -> str:
    return str(walk / "fits" / layout / "{scene}")


def copied(walk: Path, layout: str, target: Path) -> Path:
    return Path(shutil.copytree(walk / layout, target / layout))


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


def test_frames_are_divided_as_semantic_nerf_does(walk) -> None:
    scene = scene_of(walk, "replica")
    splits = walk_splits(scene.capture, 5)
    assert len(splits) == 75
    assert {name for name, split in splits.items() if split == "train"} == {
        f"rgb_{i}" for i in range(0, 75, 5)
    }
    assert {name for name, split in splits.items() if split == "test"} == {
        f"rgb_{i}" for i in range(2, 75, 5)
    }
    # Of ScanNet's the numbers have gaps, and places count.
    scans = walk_splits(scene_of(walk, "scannet").capture, 4)
    assert [name for name, split in scans.items() if split == "train"] == [
        "0", "80", "160", "240", "320",
    ]  # fmt: skip
    assert [name for name, split in scans.items() if split == "test"] == [
        "40", "120", "200", "280",
    ]  # fmt: skip
    few = replace(scene.capture, views=scene.capture.views[:2])
    with pytest.raises(InputError, match=r"expected more than 2 frames, got 2; train_every mus"):
        walk_splits(few, 5)


def test_what_is_fitted_and_scored_follows_the_switches(run, walk, tmp_path) -> None:
    with pytest.raises(InputError, match="a fit that did not learn from the 19 views"):
        run("cosseg-replica-semantic", "train_every=4")
    fit = {"fitted": None, "steps": 3, "max_gaussians": 200}
    run("cosseg-scannet-semantic", "train_every=3", **fit)
    made = load_scene(tmp_path / "out/scenes/scannet/scene0010_00")
    assert sorted(int(view.name) for view in made.train_views) == list(range(0, 360, 60))
    with pytest.raises(InputError, match="learned from 6 views|got one of another split"):
        run("cosseg-scannet-semantic", "train_every=3", "scored_in_training=yes", **fit)


def test_scored_views_may_be_fitted(run, walk, tmp_path) -> None:
    """The same views are scored, whether their photographs were fitted or not."""
    write_fits(walk, lambda one: dict.fromkeys(walk_splits(one, 5), "train"), fits=tmp_path / "all")
    held_out = run("cosseg-replica-semantic")
    fitted = {"fitted": str(tmp_path / "all/replica/{scene}")}
    with pytest.raises(InputError, match="a fit that did not learn from the 15 views"):
        run("cosseg-replica-semantic", **fitted)
    learned = run("cosseg-replica-semantic", "scored_in_training=yes", **fitted)
    rows = [[row["view"] for row in one.methods[0].scenes[0].rows] for one in (held_out, learned)]
    assert rows[0] == rows[1]


def test_another_walk_is_read_and_kept_apart(run, walk, tmp_path) -> None:
    data = copied(walk, "replica", tmp_path)
    with pytest.raises(MissingFileError, match=r"there or in Sequence_2, got none"):
        run("cosseg-replica-semantic", "sequence=Sequence_2", data=data)
    scene = data / "room_0"
    shutil.copytree(scene / "Sequence_1", scene / "Sequence_2")
    poses = (scene / "Sequence_2/traj_w_c.txt").read_text().splitlines()
    (scene / "Sequence_2/traj_w_c.txt").write_text("\n".join(poses[:40]))
    for kind in ("semantic_class", "semantic_instance"):
        for i in range(40, 75):
            (scene / "Sequence_2" / kind / f"{kind}_{i}.png").unlink()
    fit = {"fitted": None, "steps": 3, "max_gaussians": 200, "data": data}
    first = run("cosseg-replica-semantic", **fit)
    second = run("cosseg-replica-semantic", "sequence=Sequence_2", **fit)
    views = [len(one.methods[0].scenes[0].rows) for one in (first, second)]
    assert views == [15, 8]
    assert sorted(path.name for path in (tmp_path / "out/scenes").iterdir()) == [
        "replica", "replica-Sequence_2",
    ]  # fmt: skip
    with pytest.raises(InputError, match="sequence: scenes of layout scannet have one, got 'Seque"):
        run("cosseg-scannet-semantic", "sequence=Sequence_1")


def test_scenes_are_those_of_a_list(run, walk, tmp_path) -> None:
    protocol = "cosseg-replica-semantic"
    with pytest.raises(InputError, match=r"7 scenes of the list dm-nerf .* 6 are not there \(off"):
        run(protocol, scenes=())
    with pytest.raises(InputError, match=r"list dm-nerf .*got 'office_1'; scene_list=all takes"):
        run(protocol, scenes=("office_1",))
    with pytest.raises(InputError, match="expected scenes room_0, got 'room_1'"):
        run(protocol, scenes=("room_1",))
    found = run(protocol)
    assert "scenes of the list dm-nerf: the README" in found.notes[0]
    assert found.notes[1] == "1 of the 7 scenes of the protocol are run."
    assert run(protocol, "scene_list=all", scenes=()).notes == ("room_0: of no published list.",)
    with pytest.raises(InputError, match="scene_list: protocol cosseg-replica-semantic has dm-n"):
        run(protocol, "scene_list=gaga")
    eight = run("cosseg-scannet-semantic")
    seven = run("cosseg-scannet-semantic", "scene_list=gaga")
    assert eight.notes[1] == "1 of the 8 scenes of the protocol are run."
    assert seven.notes[1] == "1 of the 7 scenes of the protocol are run."


def test_stuff_is_what_the_switch_says(run) -> None:
    protocol = "cosseg-replica-panoptic"
    usual = only(run(protocol))
    # Without stuff walls are things, whose precision counts.
    assert only(run(protocol, "stuff="))["ap50"] != usual["ap50"]
    # The five chairs become one.
    assert only(run(protocol, "stuff=wall,floor,ceiling,chair"))["pq_scene"] != usual["pq_scene"]
    assert only(run(protocol, "stuff=wall,floor,ceiling")) | {"fps": 0} == usual | {"fps": 0}
    with pytest.raises(InputError, match="stuff: expected names of classes of replica, got 'flor'"):
        run(protocol, "stuff=wall,flor")
    # A name that only the data set's own table knows is one.
    run(protocol, "stuff=wall,floor,ceiling,handrail")


def test_classes_of_other_names_count_by_an_alias(run, walk, tmp_path) -> None:
    data = copied(walk, "replica", tmp_path)
    described = data / "evidence/room_0/metadata.json"
    content = json.loads(described.read_text())
    for row in content["classes"]:
        row["name"] = {"wall": "Partition", "floor": "ground"}.get(row["name"], row["name"])
    described.write_text(json.dumps(content))
    named = tuple(str(data / "evidence" / "{scene}" / name) for name in EVIDENCE)
    usual = run("cosseg-replica-semantic")
    other = run("cosseg-replica-semantic", models=named)
    assert only(other)["miou"] < only(usual)["miou"] - 0.05
    assert "2 of " in notes(other)
    assert "none of the truth's (Partition, ground)" in notes(other)
    pair = "aliases=partition:wall, ground: floor"
    again = run("cosseg-replica-semantic", pair, models=named)
    assert only(again)["miou"] == only(usual)["miou"]
    assert "none of the truth's" not in notes(again)
    with pytest.raises(InputError, match="aliases: expected pairs THERE:HERE of names, got 'wall'"):
        run("cosseg-replica-semantic", "aliases=wall")


def test_tracks_are_named_by_their_votes(run, walk, tmp_path) -> None:
    """Ids of tracks are no classes: what they are is told by the categories under them."""
    data = copied(walk, "replica", tmp_path)
    path = data / "evidence/room_0/labels_tracked/tracks.json"
    content = json.loads(path.read_text())
    for track in content["tracks"].values():
        track["category_votes"] = {"lamp": 5}
    path.write_text(json.dumps(content))
    named = (str(data / "evidence" / "{scene}" / "labels_tracked"),)
    usual = run("cosseg-replica-panoptic")
    lamps = run("cosseg-replica-panoptic", models=named)
    assert only(lamps)["miou"] < 0.1 < only(usual)["miou"]
    for track in content["tracks"].values():
        track["category_votes"] = {}
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="method uplift: expected instances whose classes are"):
        run("cosseg-replica-panoptic", models=named, again=True)


def test_what_is_missing_is_said_before_anything_is_fitted(run, walk, tmp_path) -> None:
    data = copied(walk, "replica", tmp_path)
    shutil.rmtree(data / "room_0/Sequence_1/semantic_instance")
    fit = {"fitted": None, "steps": 3}
    with pytest.raises(MissingFileError, match=r"Sequence_1: expected maps in semantic_instance,"):
        run("cosseg-replica-panoptic", data=data, **fit)
    shutil.rmtree(data / "room_0/Sequence_1/semantic_class")
    with pytest.raises(MissingFileError, match="expected maps in semantic_class or semantic_inst"):
        run("cosseg-replica-semantic", data=data, **fit)
    scans = copied(walk, "scannet", tmp_path)
    (scans / "scannetv2-labels.combined.tsv").unlink()
    with pytest.raises(MissingFileError, match=r"expected maps in label-filt, with scannetv2-labe"):
        run("cosseg-scannet-semantic", data=scans, **fit)
    with pytest.raises(MissingFileError, match="no such folder of a benchmark"):
        run("cosseg-replica-semantic", data=tmp_path / "nowhere", **fit)
    assert not (tmp_path / "out/scenes").exists()


def test_from_the_command_it_is_one_sentence(walk, tmp_path, capsys) -> None:
    words = ["bench", "cosseg-replica-semantic", "--data", walk / "replica", "-o", tmp_path / "out"]
    assert main([str(word) for word in [*words, "--quiet"]]) == 2
    said = capsys.readouterr().err.strip()
    assert said.count("\n") == 0
    assert "6 are not there (office_0, office_2, office_3, office_4, room_1, room_2)" in said


def test_test_views_without_a_truth_are_told(run, walk, tmp_path) -> None:
    data = copied(walk, "replica", tmp_path)
    for kind in ("class", "instance"):
        (data / f"room_0/Sequence_1/semantic_{kind}/semantic_{kind}_7.png").unlink()
    found = run("cosseg-replica-semantic", data=data)
    assert "1 of 15 test views have no truth." in notes(found)
    assert len(found.methods[0].scenes[0].rows) == 14


def test_a_scene_without_names_of_classes_has_those_of_the_data_set(run, walk, tmp_path) -> None:
    """Replica's 101, in which the generated room's ids mean something else."""
    data = copied(walk, "replica", tmp_path)
    (data / "semantic_info/room_0/info_semantic.json").unlink()
    found = run("cosseg-replica-panoptic", data=data, methods=("associate",))
    names = {row["name"] for row in found.methods[0].scenes[0].rows}
    assert names <= {row.name for row in REPLICA_CLASSES.rows}
    assert "backpack" in names  # the first of them; in the room it is the wall


def test_any_registered_method_that_takes_labels(run) -> None:
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
            theirs = only(run(protocol, methods=("stranger",)))
            ours = only(run(protocol))
            assert theirs | {"fps": 0} == ours | {"fps": 0}
            assert given[-1].evidence.kind == kind
        # Ids that are no tracks have no classes, if the layer does not tell them.
        register_method(replace(stranger, name="other", keeps_ids=False))
        with pytest.raises(InputError, match="method other: expected instances whose classes are"):
            run("cosseg-replica-panoptic", methods=("other",))
    finally:
        for name in ("stranger", "other"):
            _registry._REGISTERED.pop(name, None)


def test_methods_and_evidence_that_tell_no_classes(run, walk) -> None:
    with pytest.raises(InputError, match="method saga: expected one that takes panoptic or tr"):
        run("cosseg-replica-semantic", methods=("saga",))
    with pytest.raises(InputError, match="method features: expected one that takes panoptic"):
        run("cosseg-replica-panoptic", methods=("features",))
    tracked = models(walk, "replica")[2:]
    with pytest.raises(InputError, match="method uplift: expected a model that gives labels, got"):
        run("cosseg-replica-semantic", models=tracked)


@dataclass(frozen=True, slots=True, kw_only=True)
class GuidedOptions:
    guidance: str | None = None


def test_features_besides_the_evidence(run, walk, tmp_path) -> None:
    """A method that declares guidance is given it, and the result tells."""
    given: list[Any] = []

    def keep(inputs, options):
        given.append((inputs.guidance, options))
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
            run=keep, guidance="guidance", keeps_ids=True,
        )
    )  # fmt: skip
    try:
        protocol = "cosseg-replica-semantic"
        without = run(protocol, methods=("guided",))
        assert given[-1][0] is None
        found = run(protocol, methods=("guided",), guidance=str(folder))
        assert isinstance(given[-1][0], FeatureEvidence)
        assert given[-1][1].guidance == "features_dino"
        assert found.kept == 0, "another experiment"
        made = [one.methods[0].scenes[0].made for one in (without, found)]
        assert [one.get("guidance") for one in made] == [None, str(folder)]
        with pytest.raises(InputError, match="guidance: expected a model that gives features, got"):
            run(protocol, methods=("guided",), guidance=models(walk, "replica")[0])
        with pytest.raises(InputError, match="guidance: expected a method that takes features be"):
            run(protocol, guidance=str(folder))
    finally:
        del _registry._REGISTERED["guided"]


def test_void_of_the_truth_is_left_out(run, walk, tmp_path) -> None:
    """0 in a map is none: what lies there is neither right nor wrong."""
    data = copied(walk, "replica", tmp_path)
    folder = data / "room_0/Sequence_1/semantic_class"
    for path in folder.glob("semantic_class_*.png"):
        ids = np.array(Image.open(path))
        ids[:, :60] = 0
        Image.fromarray(ids).save(path)
    found = run("cosseg-replica-semantic", data=data)
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
