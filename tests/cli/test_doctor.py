"""``splatseg doctor`` as the shell runs it, on broken copies of files."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from splatseg.io.captures import read_capture

FRAMES = 16
Content = dict[str, object]


@pytest.fixture
def broken(generated_room, tmp_path) -> Callable[..., Path]:
    """A copy of the train frames of a transforms.json, changed; photographs stay."""

    def make(change: Callable[[Content], None] = lambda content: None) -> Path:
        source = generated_room
        content = json.loads((source / "transforms.json").read_text())
        frames = [f for f in content["frames"] if f["split"] == "train"]
        for frame in frames:
            frame["file_path"] = str(source / frame["file_path"])
        content |= {"frames": frames, "ply_file_path": str(source / "points3D.ply")}
        change(content)
        folder = tmp_path / "copy"
        folder.mkdir()
        (folder / "transforms.json").write_text(json.dumps(content))
        (folder / "metadata.json").write_text(json.dumps({"up_axis": "+z", "units": "metres"}))
        return folder

    return make


def each_pose(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Content], None]:
    def apply(content: Content) -> None:
        for frame in content["frames"]:
            frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()

    return apply


def test_a_healthy_copy(broken, splatseg, tmp_path) -> None:
    folder = broken()
    words = ("doctor", folder, "--max-views", 12, "--fix", tmp_path / "out")
    status, out, err = splatseg(*words)
    assert (status, err) == (0, "")
    assert "no fault found" in out
    assert not (tmp_path / "out").exists(), "nothing is written where nothing is wrong"
    status, out, _ = splatseg("doctor", folder, "--max-views", 12, "--json")
    facts = json.loads(out)
    assert status == 0
    assert (facts["healthy"], facts["faults"], facts["written"]) == (True, [], None)
    assert facts["figures"]["agreement"] > 0.9


def test_a_fault_without_fix_is_status_2(broken, splatseg) -> None:
    folder = broken(each_pose(np.linalg.inv))
    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    status, out, err = splatseg("doctor", folder, "--max-views", 12)
    assert status == 2
    assert "world-to-camera matrices where camera-to-world ones are expected" in out
    assert err.strip() == (
        f"error: {folder}: inverted-poses; --fix OUT writes a corrected capture."
    )
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == before


def test_fix_writes_a_capture_that_is_healthy(broken, generated_room, splatseg, tmp_path) -> None:
    """Two faults at once: OpenCV poses, and intrinsics of photographs half the size."""

    def change(content: Content) -> None:
        each_pose(lambda m: m @ np.diag([1.0, -1, -1, 1]))(content)
        for key in ("fl_x", "fl_y", "cx", "cy"):
            content[key] /= 2

    folder = broken(change)
    status, out, err = splatseg("doctor", folder, "--max-views", 12, "--fix", tmp_path / "out")
    assert (status, err) == (0, "")
    assert "2 faults found" in out
    fixed, true = read_capture(tmp_path / "out"), read_capture(generated_room)
    assert len(fixed.views) == FRAMES
    assert fixed.up == (0.0, 0.0, 1.0)
    assert fixed.metres_per_unit == 1.0
    assert len(fixed.points) == len(true.points)
    for view in fixed.views:
        camera, expected = view.camera, true.view(view.name).camera
        np.testing.assert_allclose(camera.cam_from_world, expected.cam_from_world, atol=1e-9)
        assert (camera.fx, camera.cx, camera.cy) == (expected.fx, expected.cx, expected.cy)
        assert view.image.samefile(true.view(view.name).image)
    status, out, _ = splatseg("doctor", tmp_path / "out", "--max-views", 12, "--json")
    assert status == 0
    assert json.loads(out)["healthy"]


def test_sizes_that_contradict_the_photographs(broken, generated_room, splatseg, tmp_path) -> None:
    """Width and height exchanged, intrinsics right: `read_capture` refuses it."""
    folder = broken(lambda content: content.update(w=240, h=320))
    status, out, err = splatseg(
        "doctor", folder, "--max-views", 12, "--fix", tmp_path / "out", "--json"
    )
    assert status == 0, err
    facts = json.loads(out)
    assert [fault["name"] for fault in facts["faults"]] == ["image-size"]
    assert "240x320" in facts["faults"][0]["sentence"]
    assert facts["written"] == str(tmp_path / "out")
    camera, true = (read_capture(f).views[0].camera for f in (tmp_path / "out", generated_room))
    assert (camera.width, camera.height) == (320, 240)
    assert (camera.fx, camera.cx) == (true.fx, true.cx)


def test_the_applied_transform_is_named(broken, splatseg) -> None:
    """Points as COLMAP left them, poses turned as nerfstudio does."""

    def change(content: Content) -> None:
        turn = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
        # The world of the poses becomes turn @ world; the points stay behind.
        each_pose(lambda m: turn @ m)(content)
        content["applied_transform"] = turn[:3].tolist()

    folder = broken(change)
    (folder / "metadata.json").write_text(json.dumps({"up_axis": "+y"}))
    status, out, err = splatseg("doctor", folder, "--max-views", 12)
    assert status == 2, err
    assert "transforms.json's applied_transform, which was not applied to them" in out


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--max-views", "1"], "--max-views: expected at least 2, got 1"),
        (["--fix", "full"], "full: expected a new folder, got one that is there"),
        (["--fix", "no/out"], "no/out: expected a place in a folder that is there"),
    ],
)
def test_bad_input(words, sentence, broken, splatseg, tmp_path, monkeypatch) -> None:
    folder = broken()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "something").write_text("mine")
    status, out, err = splatseg("doctor", folder, *words)
    assert (status, out) == (2, "")
    assert err.startswith("error: ")
    assert sentence in err
    assert (tmp_path / "full" / "something").read_text() == "mine"


def test_no_capture(splatseg, tmp_path) -> None:
    for path in (tmp_path, tmp_path / "none"):
        status, _, err = splatseg("doctor", path)
        assert status == 2
        assert str(path) in err
