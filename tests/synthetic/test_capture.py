"""The folder that `write_capture` leaves: layout, contents, and nothing on failure."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.errors import InputError
from splatseg.io.captures import read_capture
from splatseg.io.evidence import open_evidence
from splatseg.synthetic import SyntheticScene, Truth, cameras, machine_labels, write_capture


def read_png(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.array(image)


def mode_of(path: Path) -> str:
    with Image.open(path) as image:
        return image.mode


@pytest.fixture(scope="module")
def views(small_room):
    return cameras(small_room, train=5, test=2, width=64, height=48)


@pytest.fixture(scope="module")
def written(small_room: SyntheticScene, views, tmp_path_factory) -> tuple[Path, dict[str, Truth]]:
    folder = tmp_path_factory.mktemp("synthetic") / "capture"
    return folder, write_capture(small_room, folder, views=views, points=800, seed=2)


def test_files_that_are_written(written):
    folder, _ = written
    for name in ("images", "semantic", "instance", "depth"):
        assert len(list((folder / name).iterdir())) == 7
    modes = {"semantic": "L", "instance": "I;16", "depth": "I;16", "labels_semantic": "L"}
    assert {kind: mode_of(folder / kind / "train_0000.png") for kind in modes} == modes
    content = json.loads((folder / "transforms.json").read_text())
    assert {"w", "h", "fl_x", "fl_y", "cx", "cy", "ply_file_path"} <= content.keys()
    assert content["frames"][0].keys() == {"file_path", "transform_matrix", "split"}


def test_files_are_those_of_the_rendered_benchmark(written, shared_data):
    folder, _ = written
    office = shared_data / "office"
    for name in ("images", "semantic", "instance", "depth"):
        assert len(list((folder / name).iterdir())) == 7
    labels = sorted(path.name for path in (folder / "labels_semantic").iterdir())
    assert labels == [f"train_{i:04d}.png" for i in range(5)]
    for kind in ("semantic", "instance", "depth", "labels_semantic"):
        ours = mode_of(folder / kind / "train_0000.png")
        assert ours == mode_of(office / kind / "train_0000.png"), kind
    ours = json.loads((folder / "transforms.json").read_text())
    theirs = json.loads((office / "transforms.json").read_text())
    assert theirs.keys() <= ours.keys()
    assert theirs["frames"][0].keys() == ours["frames"][0].keys()
    ours = json.loads((folder / "metadata.json").read_text())
    theirs = json.loads((office / "metadata.json").read_text())
    assert ours["classes"][0].keys() == theirs["classes"][0].keys()
    assert theirs["instances"][0].keys() - ours["instances"][0].keys() == {"parts"}
    head = (folder / "points3D.ply").read_bytes().split(b"end_header")[0].decode().splitlines()
    expected = (office / "points3D.ply").read_bytes().split(b"end_header")[0].decode().splitlines()
    assert [line for line in head if "vertex" not in line] == [
        line for line in expected if "vertex" not in line
    ]


def test_maps_hold_the_truth_with_zero_for_none(written):
    folder, truths = written
    for name, truth in truths.items():
        semantic = read_png(folder / "semantic" / f"{name}.png")
        assert np.array_equal(semantic, truth.semantic.clamp_min(0).numpy())
        instance = read_png(folder / "instance" / f"{name}.png")
        assert np.array_equal(instance, truth.instance.clamp_min(0).numpy())
        depth = read_png(folder / "depth" / f"{name}.png")
        assert np.allclose(depth * 0.001, truth.depth[::2, ::2], atol=0.00051)
        photograph = read_png(folder / "images" / f"{name}.jpg").astype(float)
        assert np.abs(photograph - truth.image.numpy()).mean() < 6


def test_the_capture_reader_gives_back_cameras_points_and_classes(written, views, small_room):
    folder, _ = written
    capture = read_capture(folder)
    assert [view.name for view in capture.train_views] == [v.name for v in views[:5]]
    assert [view.name for view in capture.test_views] == [v.name for v in views[5:]]
    for ours in views:
        read = capture.view(ours.name).camera
        torch.testing.assert_close(read.cam_from_world, ours.camera.cam_from_world)
        assert (read.fx, read.cx, read.width) == (ours.camera.fx, 32.0, 64)
    assert capture.points is not None
    assert 100 < len(capture.points) <= 800  # five views see few places thrice
    assert capture.classes is not None
    assert capture.classes.rows == small_room.classes.rows
    assert capture.metres_per_unit == 1.0
    assert capture.up == (0.0, 0.0, 1.0)


def test_the_evidence_reader_gives_back_the_machine_labels(written, views, small_room):
    folder, truths = written
    evidence = open_evidence(folder / "labels_semantic")
    train = {view.name: truths[view.name] for view in views[:5]}
    labels = machine_labels(small_room, train, seed=2)
    for name, ids in labels.items():
        assert torch.equal(evidence.label_map(name).ids, ids)


def test_train_pixels_are_counted(written, views):
    folder, truths = written
    meta = json.loads((folder / "metadata.json").read_text())
    for item in meta["instances"]:
        counted = sum(int((truths[v.name].instance == item["id"]).sum()) for v in views[:5])
        assert item["train_pixels"] == counted
    present = {row["id"] for row in meta["classes"] if row["present"]}
    assert present == {i["class_id"] for i in meta["instances"] if i["train_pixels"]}


def test_a_lens_is_written_and_read(small_room, tmp_path):
    plain = cameras(small_room, train=2, test=0, width=32, height=24)
    for model, values in (("opencv", (-0.2, 0.03, 0.001, 0.002)), ("fisheye", (0.05, 0.01))):
        bent = [replace(v, camera=replace(v.camera, model=model, distortion=values)) for v in plain]
        write_capture(small_room, tmp_path / model, views=bent, points=50)
        read = read_capture(tmp_path / model).views[0].camera
        assert read.model == model
        assert read.distortion == bent[0].camera.distortion


def test_an_interrupted_writer_leaves_nothing_and_a_second_run_replaces(
    small_room, views, tmp_path, monkeypatch
):
    target = tmp_path / "capture"

    def stop(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("splatseg.synthetic.capture._ply", stop)
        with pytest.raises(KeyboardInterrupt):
            write_capture(small_room, target, views=views[:2], points=20)
    assert list(tmp_path.iterdir()) == []
    write_capture(small_room, target, views=views[:2], points=20)
    (target / "stray.txt").write_text("from before")
    told: list[tuple[int, int]] = []
    write_capture(
        small_room, target, views=views[:2], points=20, progress=lambda i, n: told.append((i, n))
    )
    assert told == [(1, 2), (2, 2)]
    assert not (target / "stray.txt").exists()


def test_what_cannot_be_written_is_refused(small_room, views, tmp_path):
    with pytest.raises(InputError, match="at least one train view"):
        write_capture(small_room, tmp_path / "a", views=views[5:])
    other = replace(views[1], camera=views[1].camera.resized(32, 24))
    with pytest.raises(InputError, match="train_0001 has others"):
        write_capture(small_room, tmp_path / "a", views=[views[0], other])
    assert list(tmp_path.iterdir()) == []
