"""Every choice of CoSSegGaussians' protocols changes what is run; what is missing is refused."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from splatseg.cli import main
from splatseg.errors import InputError, MissingFileError
from splatseg.io.scene import load_scene
from splatseg_bench.layouts import read_benchmark
from splatseg_bench.layouts.replica import REPLICA_CLASSES
from splatseg_bench.scene import BenchmarkScene
from splatseg_bench.scenes import walk_splits
from support.walks import EVIDENCE, copied, write_fits


def only(done: Any) -> dict[str, float]:
    (method,) = done.methods
    return dict(method.scores)


def notes(done: Any) -> str:
    return " ".join(done.methods[0].scenes[0].notes)


def scene_of(walk: Path, layout: str) -> BenchmarkScene:
    (scene,) = read_benchmark(layout, walk / layout)
    return scene


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


def test_what_is_fitted_and_scored_follows_the_switches(run_room, walk, tmp_path) -> None:
    with pytest.raises(InputError, match="a fit that did not learn from the 19 views"):
        run_room("cosseg-replica-semantic", "train_every=4")
    fit = {"fitted": None, "steps": 3, "max_gaussians": 200}
    run_room("cosseg-scannet-semantic", "train_every=3", **fit)
    made = load_scene(tmp_path / "out/scenes/scannet-every-3/scene0010_00")
    assert sorted(int(view.name) for view in made.train_views) == list(range(0, 360, 60))
    with pytest.raises(InputError, match="learned from 6 views|got one of another split"):
        run_room("cosseg-scannet-semantic", "train_every=3", "scored_in_training=yes", **fit)


def test_scored_views_may_be_fitted(run_room, walk, tmp_path) -> None:
    """The same views are scored, whether their photographs were fitted or not."""
    write_fits(walk, lambda one: dict.fromkeys(walk_splits(one, 5), "train"), fits=tmp_path / "all")
    held_out = run_room("cosseg-replica-semantic")
    fitted = {"fitted": str(tmp_path / "all/replica/{scene}")}
    with pytest.raises(InputError, match="a fit that did not learn from the 15 views"):
        run_room("cosseg-replica-semantic", **fitted)
    learned = run_room("cosseg-replica-semantic", "scored_in_training=yes", **fitted)
    rows = [[row["view"] for row in one.methods[0].scenes[0].rows] for one in (held_out, learned)]
    assert rows[0] == rows[1]


def test_another_walk_is_read_and_kept_apart(run_room, walk, tmp_path) -> None:
    data = copied(walk, "replica", tmp_path)
    with pytest.raises(MissingFileError, match=r"there or in Sequence_2, got none"):
        run_room("cosseg-replica-semantic", "sequence=Sequence_2", data=data)
    scene = data / "room_0"
    shutil.copytree(scene / "Sequence_1", scene / "Sequence_2")
    poses = (scene / "Sequence_2/traj_w_c.txt").read_text().splitlines()
    (scene / "Sequence_2/traj_w_c.txt").write_text("\n".join(poses[:40]))
    for kind in ("semantic_class", "semantic_instance"):
        for i in range(40, 75):
            (scene / "Sequence_2" / kind / f"{kind}_{i}.png").unlink()
    fit = {"fitted": None, "steps": 3, "max_gaussians": 200, "data": data}
    first = run_room("cosseg-replica-semantic", **fit)
    second = run_room("cosseg-replica-semantic", "sequence=Sequence_2", **fit)
    views = [len(one.methods[0].scenes[0].rows) for one in (first, second)]
    assert views == [15, 8]
    assert sorted(path.name for path in (tmp_path / "out/scenes").iterdir()) == [
        "replica", "replica-Sequence_2",
    ]  # fmt: skip
    with pytest.raises(InputError, match="sequence: scenes of layout scannet have one, got 'Seque"):
        run_room("cosseg-scannet-semantic", "sequence=Sequence_1")


def test_scenes_are_those_of_a_list(run_room, walk, tmp_path) -> None:
    protocol = "cosseg-replica-semantic"
    with pytest.raises(InputError, match=r"7 scenes of the list dm-nerf .* 6 are not there \(off"):
        run_room(protocol, scenes=())
    with pytest.raises(InputError, match=r"list dm-nerf .*got 'office_1'; scene_list=all takes"):
        run_room(protocol, scenes=("office_1",))
    with pytest.raises(InputError, match="expected scenes room_0, got 'room_1'"):
        run_room(protocol, scenes=("room_1",))
    found = run_room(protocol)
    assert "scenes of the list dm-nerf: the README" in found.notes[0]
    assert found.notes[1] == "1 of the 7 scenes of the protocol are run."
    every = run_room(protocol, "scene_list=all", scenes=())
    assert every.notes == ("room_0: of no published list.",)
    with pytest.raises(InputError, match="scene_list: protocol cosseg-replica-semantic has dm-n"):
        run_room(protocol, "scene_list=gaga")
    eight = run_room("cosseg-scannet-semantic")
    seven = run_room("cosseg-scannet-semantic", "scene_list=gaga")
    assert eight.notes[1] == "1 of the 8 scenes of the protocol are run."
    assert seven.notes[1] == "1 of the 7 scenes of the protocol are run."


def test_stuff_is_what_the_switch_says(run_room) -> None:
    protocol = "cosseg-replica-panoptic"
    usual = only(run_room(protocol))
    # Without stuff walls are things, whose precision counts.
    assert only(run_room(protocol, "stuff="))["ap50"] != usual["ap50"]
    # The five chairs become one.
    chairs = only(run_room(protocol, "stuff=wall,floor,ceiling,chair"))
    assert chairs["pq_scene"] != usual["pq_scene"]
    assert only(run_room(protocol, "stuff=wall,floor,ceiling")) | {"fps": 0} == usual | {"fps": 0}
    with pytest.raises(InputError, match="stuff: expected names of classes of replica, got 'flor'"):
        run_room(protocol, "stuff=wall,flor")
    # A name that only the data set's own table knows is one.
    run_room(protocol, "stuff=wall,floor,ceiling,handrail")


def test_classes_of_other_names_count_by_an_alias(run_room, walk, tmp_path) -> None:
    data = copied(walk, "replica", tmp_path)
    described = data / "evidence/room_0/metadata.json"
    content = json.loads(described.read_text())
    for row in content["classes"]:
        row["name"] = {"wall": "Partition", "floor": "ground"}.get(row["name"], row["name"])
    described.write_text(json.dumps(content))
    named = tuple(str(data / "evidence" / "{scene}" / name) for name in EVIDENCE)
    usual = run_room("cosseg-replica-semantic")
    other = run_room("cosseg-replica-semantic", models=named)
    assert only(other)["miou"] < only(usual)["miou"] - 0.05
    assert "2 of " in notes(other)
    assert "none of the truth's (Partition, ground)" in notes(other)
    pair = "aliases=partition:wall, ground: floor"
    again = run_room("cosseg-replica-semantic", pair, models=named)
    assert only(again)["miou"] == only(usual)["miou"]
    assert "none of the truth's" not in notes(again)
    with pytest.raises(InputError, match="aliases: expected pairs THERE:HERE of names, got 'wall'"):
        run_room("cosseg-replica-semantic", "aliases=wall")


def test_what_is_missing_is_said_before_anything_is_fitted(run_room, walk, tmp_path) -> None:
    data = copied(walk, "replica", tmp_path)
    shutil.rmtree(data / "room_0/Sequence_1/semantic_instance")
    fit = {"fitted": None, "steps": 3}
    with pytest.raises(MissingFileError, match=r"Sequence_1: expected maps in semantic_instance,"):
        run_room("cosseg-replica-panoptic", data=data, **fit)
    shutil.rmtree(data / "room_0/Sequence_1/semantic_class")
    with pytest.raises(MissingFileError, match="expected maps in semantic_class or semantic_inst"):
        run_room("cosseg-replica-semantic", data=data, **fit)
    scans = copied(walk, "scannet", tmp_path)
    (scans / "scannetv2-labels.combined.tsv").unlink()
    with pytest.raises(MissingFileError, match=r"expected maps in label-filt, with scannetv2-labe"):
        run_room("cosseg-scannet-semantic", data=scans, **fit)
    with pytest.raises(MissingFileError, match="no such folder of a benchmark"):
        run_room("cosseg-replica-semantic", data=tmp_path / "nowhere", **fit)
    assert not (tmp_path / "out/scenes").exists()


def test_from_the_command_it_is_one_sentence(walk, tmp_path, capsys) -> None:
    words = ["bench", "cosseg-replica-semantic", "--data", walk / "replica", "-o", tmp_path / "out"]
    assert main([str(word) for word in [*words, "--quiet"]]) == 2
    said = capsys.readouterr().err.strip()
    assert said.count("\n") == 0
    assert "6 are not there (office_0, office_2, office_3, office_4, room_1, room_2)" in said


def test_test_views_without_a_truth_are_told(run_room, walk, tmp_path) -> None:
    data = copied(walk, "replica", tmp_path)
    for kind in ("class", "instance"):
        (data / f"room_0/Sequence_1/semantic_{kind}/semantic_{kind}_7.png").unlink()
    found = run_room("cosseg-replica-semantic", data=data)
    assert "1 of 15 test views have no truth." in notes(found)
    assert len(found.methods[0].scenes[0].rows) == 14


def test_a_scene_without_names_has_those_of_the_data_set(run_room, walk, tmp_path) -> None:
    """Replica's 101, in which the generated room's ids mean something else."""
    data = copied(walk, "replica", tmp_path)
    (data / "semantic_info/room_0/info_semantic.json").unlink()
    found = run_room("cosseg-replica-panoptic", data=data, methods=("associate",))
    names = {row["name"] for row in found.methods[0].scenes[0].rows}
    assert names <= {row.name for row in REPLICA_CLASSES.rows}
    assert "backpack" in names  # the first of them; in the room it is the wall
