"""``splatseg street``: fields of drives, labels of scans, and one sentence for what is wrong."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from splatseg.io.scans import read_scans
from splatseg.io.scene import load_scene
from splatseg.street.files import load_mesh_field
from splatseg.tasks import scans_to_label, street_scene
from support.arrays import arrays_of
from support.elsewhere import Elsewhere
from support.ply import write_ply

FAST = ("--voxels", "2.0", "4.0", "--geometry-iterations", "1", "--iterations", "3", "--rays", "64")


@pytest.fixture(scope="module")
def made(generated_drive, tmp_path_factory) -> Path:
    """A scene of the drive with a field; not to be changed."""
    from splatseg.cli import main

    root = tmp_path_factory.mktemp("street") / "scene"
    words = ("street", generated_drive, "--new-scene", root, "--scans", generated_drive, *FAST)
    assert main([str(word) for word in (*words, "--quiet")]) == 0
    return root


def test_the_field_is_in_the_scene_and_seen_from_the_command_line(
    made, generated_drive, splatseg, tmp_path
) -> None:
    assert (made / "fields/street.safetensors").is_file()
    status, out, _ = splatseg("info", made)
    assert status == 0
    assert "fields street" in out
    status, out, _ = splatseg(
        "render", made, "-o", tmp_path / "views", "--field", "street",
        "--what", "rgb,labels_semantic", "--coloured", "--json",
    )  # fmt: skip
    assert status == 0
    assert json.loads(out)["entries"] == ["rgb", "labels_semantic", "labels_semantic_coloured"]
    status, out, _ = splatseg(
        "evaluate", made, "--field", "street", "--layer", "labels_semantic",
        "--truth", generated_drive / "semantic", "--json",
    )  # fmt: skip
    assert status == 0
    scores = json.loads(out)
    assert scores["field"] == "street"
    assert {"mIoU", "PSNR"} <= set(scores)


def test_scans_are_labelled_by_the_field(made, generated_drive, splatseg, tmp_path) -> None:
    status, out, _ = splatseg(
        "street", made, "--label-scans", generated_drive, "-o", tmp_path / "out", "--by", "mesh",
        "--json", "--quiet",
    )  # fmt: skip
    assert status == 0
    facts = json.loads(out)["labels"]
    assert (facts["by"], facts["form"], facts["layer"]) == ("mesh", "npz", "labels_semantic")
    assert facts["points"] == sum(facts["ids"].values()) + facts["unlabelled"]
    shape = arrays_of(generated_drive / "lidar.npz")["range_2mm"].shape
    assert arrays_of(tmp_path / "out/labels.npz")["semantic"].shape == shape
    status, out, _ = splatseg(
        "street", made, "--label-scans", generated_drive, "-o", tmp_path / "out", "--by", "mesh",
        "--form", "label",
    )  # fmt: skip
    assert status == 0
    assert f"of {facts['points']} points of 3 scans labelled, {facts['unlabelled']} (" in out
    assert (tmp_path / "out/0001.label").is_file()
    found = {}
    for by in ("mesh", "vertices"):
        words = ("street", made, "--label-scans", generated_drive, "-o", tmp_path / by, "--by", by)
        status, out, _ = splatseg(*words, "--json", "--quiet")
        assert (status, json.loads(out)["labels"]["by"]) == (0, by)
        found[by] = arrays_of(tmp_path / by / "labels.npz")["semantic"]
    assert not np.array_equal(found["mesh"], found["vertices"])
    field = load_mesh_field(made / "fields/street.safetensors")
    scans = read_scans(generated_drive)
    first = scans.scan(scans.scan_names[0])
    ids = field.labels_at(first.points, "labels_semantic").ids
    assert (found["vertices"][0] > 0).sum() == int((ids > 0).sum())


def test_scans_are_labelled_where_the_executor_is(made, generated_drive, tmp_path) -> None:
    executor, out = Elsewhere(), tmp_path / "out"
    scans = scans_to_label(generated_drive, out)
    street_scene(load_scene(made), scans=scans, labels=out, by="vertices", executor=executor)
    assert executor.items == list(scans.scan_names)
    assert (out / "labels.npz").is_file()


def test_eq_9_is_asked_as_published_of_a_field_that_is_there(
    made, generated_drive, splatseg, tmp_path
) -> None:
    """By --vertex-rule or --published: what no adjusted vertex is near has no label; it is told."""
    found = {}
    for name, words in (
        ("own", ()),
        ("adjusted", ("--vertex-rule", "adjusted")),
        ("published", ("--published",)),
        ("all", ("--vertex-rule", "all")),
    ):
        line = ("street", made, "--label-scans", generated_drive, "-o", tmp_path / name)
        status, out, _ = splatseg(*line, "--by", "vertices", *words, "--json", "--quiet")
        assert status == 0
        found[name] = json.loads(out)["labels"]
    rules = {name: facts["vertex_rule"] for name, facts in found.items()}
    assert rules == {
        "own": "weighed", "adjusted": "adjusted", "published": "adjusted", "all": "all",
    }  # fmt: skip
    assert found["adjusted"]["unlabelled"] == found["published"]["unlabelled"]
    assert found["adjusted"]["unlabelled"] > found["all"]["unlabelled"]
    assert found["own"]["unlabelled"] == found["all"]["unlabelled"]
    line = ("street", made, "--label-scans", generated_drive, "-o", tmp_path / "own")
    status, out, _ = splatseg(*line, "--by", "vertices", "--published")
    assert "scans labelled by vertices (those that training adjusted, as published)" in out


def test_what_is_wrong_is_one_sentence(
    made, generated_drive, splatseg, tmp_path, monkeypatch
) -> None:
    def refused(*words: object) -> str:
        status, out, err = splatseg("street", *words, "--quiet")
        assert (status, out, err.count("\n")) == (2, "", 1), err
        return err

    out = tmp_path / "out"
    mesh = ("--label-scans", generated_drive, "-o", out, "--by", "mesh")
    assert "has one called 'street'; give another name, or --overwrite" in refused(made)
    assert "got one of the two" in refused(made, "--label-scans", generated_drive)
    assert "got one of the two" in refused(made, "-o", out)
    assert "--form: expected scans to label with it" in refused(made, "--form", "las")
    assert "expected mesh for a scene without Gaussians" in refused(
        made, "--label-scans", generated_drive, "-o", out, "--layer", "a"
    )
    assert "--new-scene: expected a scene folder to write" in refused(generated_drive)
    assert "there is no such capture" in refused(tmp_path / "none")
    assert "there is no such folder or file of scans" in refused(
        made, "--label-scans", tmp_path / "none", "-o", out, "--by", "mesh"
    )
    assert "evidence: expected one of those at hand" in refused(
        made, "--field", "b", "--evidence", "none"
    )
    # What is to be labelled, and where to, is looked at before a field is made for it.
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken/mine.txt").write_text("mine")
    unmade = ("--field", "b", "--by", "mesh", *FAST)
    assert "got one with other files; choose another" in refused(
        made, "--label-scans", generated_drive, "-o", tmp_path / "taken", *unmade
    )
    (tmp_path / "lidar.npz").write_bytes(b"half")
    assert "lidar.npz" in refused(made, "--label-scans", tmp_path, "-o", out, *unmade)
    with monkeypatch.context() as patched:
        patched.setitem(sys.modules, "sklearn.ensemble", None)
        status, _, err = splatseg("street", made, *mesh, "--field", "b", *FAST, "--quiet")
        assert (status, err.count("pip install 'splatseg[street]'")) == (1, 1), err
    assert not (made / "fields/b.safetensors").exists()
    # Half a file, as a disk that was full would leave it.
    root = shutil.copytree(made, tmp_path / "half")
    file = root / "fields/street.safetensors"
    file.write_bytes(file.read_bytes()[:5000])
    assert "street.safetensors" in refused(root, *mesh)
    assert not out.exists()


def test_damaged_scans_are_one_sentence(made, generated_drive, splatseg, tmp_path) -> None:
    with np.load(generated_drive / "lidar.npz") as found:
        arrays = dict(found)

    def refused(**changes: object) -> str:
        (tmp_path / "scans").mkdir(exist_ok=True)
        left = {k: v for k, v in (arrays | changes).items() if v is not None}
        np.savez(tmp_path / "scans/lidar.npz", **left)
        words = ("--scans", tmp_path / "scans", "--field", "b", *FAST, "--quiet")
        status, out, err = splatseg("street", made, *words)
        assert (status, out, err.count("\n")) == (2, "", 1), err
        return err

    broken = arrays["range_2mm"].astype(np.float32) * 0.002
    broken[0, 0, :3] = np.nan
    assert "expected finite positions, got 3 of" in refused(range_2mm=None, range=broken)
    assert "expected an array 'lidar_to_world'" in refused(lidar_to_world=None)
    poses = arrays["lidar_to_world"].copy()
    poses[0, 0, 3] = np.nan
    assert "scan 0" in refused(lidar_to_world=poses)
    assert not (made / "fields/b.safetensors").exists()


def test_points_that_are_none_or_in_one_place_are_one_sentence(
    generated_drive, splatseg, tmp_path
) -> None:
    capture = shutil.copytree(generated_drive, tmp_path / "capture")

    def refused() -> str:
        words = ("--new-scene", tmp_path / "scene", *FAST, "--quiet")
        status, out, err = splatseg("street", capture, *words)
        assert (status, out, err.count("\n")) == (2, "", 1), err
        return err

    (capture / "points3D.ply").unlink()
    content = json.loads((capture / "transforms.json").read_text())
    named = content.pop("ply_file_path")
    (capture / "transforms.json").write_text(json.dumps(content))
    assert "points: expected points to put primitives at" in refused()
    (capture / "transforms.json").write_text(json.dumps(content | {"ply_file_path": named}))
    write_ply({"vertex": [("float", axis, [0.1, 0.2, 0.3]) for axis in "xyz"]}, capture / named)
    assert "points: expected points in several voxels of 2 m, got 3 in one" in refused()


def test_labels_that_the_table_lacks_are_one_sentence(generated_drive, splatseg, tmp_path) -> None:
    capture = shutil.copytree(generated_drive, tmp_path / "capture")
    content = json.loads((capture / "metadata.json").read_text())
    content["classes"] = content["classes"][:3]
    (capture / "metadata.json").write_text(json.dumps(content))
    words = ("--new-scene", tmp_path / "scene", *FAST, "--quiet")
    status, out, err = splatseg("street", capture, *words)
    assert (status, out, err.count("\n")) == (2, "", 1), err
    assert "labels_semantic: expected ids of (1, 2, 3), got" in err
