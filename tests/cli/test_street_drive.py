"""``splatseg street`` and ``fit`` with blocks and moving things: from the flags to the files."""

import json
import shutil
from pathlib import Path

import pytest
import torch

from splatseg.core.scans import MovingBox
from splatseg.io.captures import read_capture
from splatseg.io.moving import write_moving
from splatseg.io.scene import load_scene
from splatseg.street.files import load_drive
from support.arrays import arrays_of

FAST = ("--voxels", "2.0", "--geometry-iterations", "1", "--iterations", "3", "--rays", "64")
BLOCKS = ("--block-length", "20", "--block-overlap", "6")


@pytest.fixture(scope="module")
def made(generated_drive, tmp_path_factory) -> Path:
    """A scene of the drive with a field in two blocks; not to be changed."""
    from splatseg.cli import main

    root = tmp_path_factory.mktemp("street") / "scene"
    words = ("street", generated_drive, "--new-scene", root, "--scans", generated_drive)
    assert main([str(word) for word in (*words, *FAST, *BLOCKS, "--quiet")]) == 0
    return root


@pytest.fixture(scope="module")
def boxes(generated_drive, tmp_path_factory) -> Path:
    """A box before a training view, on the clock of frames."""
    view = read_capture(generated_drive).train_views[2]
    number = float(view.name[-4:])
    box = MovingBox(
        centre=view.camera.centre + 6.0 * view.camera.world_from_cam[:3, 2],
        size=(2.0, 2.0, 2.0), rotation=torch.tensor([1.0, 0, 0, 0]), start=number, end=number,
    )  # fmt: skip
    path = tmp_path_factory.mktemp("boxes") / "boxes.json"
    write_moving([box], path)
    return path


def test_blocks_are_told_of(made, generated_drive, splatseg, tmp_path) -> None:
    root = shutil.copytree(made, tmp_path / "scene")
    words = (root, "--scans", generated_drive, *FAST)
    status, out, _ = splatseg("street", *words, *BLOCKS, "--field", "b", "--json", "--quiet")
    assert status == 0
    facts = json.loads(out)
    assert (facts["blocks"], facts["blocks_made"], facts["views"]) == (2, 2, 10)
    assert facts["primitives"] > 20
    assert facts["file"] == str(root / "fields/b")
    status, out, _ = splatseg("street", *words, "--block-length", "16", "--field", "c", "--quiet")
    assert status == 0
    assert "3 blocks with " in out
    assert " from 10 views in " in out
    assert load_drive(root / "fields/c/drive.json").overlap == 4.0
    status, out, _ = splatseg("info", root)
    assert status == 0
    assert "fields b, c, street" in out


def test_whatever_reads_a_field_reads_blocks(made, generated_drive, splatseg, tmp_path) -> None:
    status, out, _ = splatseg(
        "render", made, "-o", tmp_path / "views", "--field", "street",
        "--what", "rgb,labels_semantic", "--json",
    )  # fmt: skip
    assert status == 0
    assert json.loads(out)["entries"] == ["rgb", "labels_semantic"]
    status, out, _ = splatseg(
        "evaluate", made, "--field", "street", "--layer", "labels_semantic", "--split", "train",
        "--truth", generated_drive / "semantic", "--json",
    )  # fmt: skip
    assert status == 0
    scores = json.loads(out)
    assert {"mIoU", "PSNR"} <= set(scores)
    assert scores["learned_from"] == 10
    status, out, _ = splatseg(
        "street", made, "--label-scans", generated_drive, "-o", tmp_path / "out", "--by", "mesh",
        "--json", "--quiet",
    )  # fmt: skip
    assert status == 0
    facts = json.loads(out)
    assert "blocks" not in facts
    assert facts["labels"]["points"] > 1000
    assert arrays_of(tmp_path / "out/labels.npz")["semantic"].max() > 0


def test_ctrl_c_says_how_to_go_on(made, generated_drive, splatseg, tmp_path, monkeypatch) -> None:
    """Labels are asked for as well: what was stopped is finished before they are given."""
    from splatseg.tasks import street_drive as _blocks

    root = shutil.copytree(made, tmp_path / "scene")
    words = ("street", root, "--scans", generated_drive, *FAST, *BLOCKS, "--field", "b", "--quiet")
    whole = _blocks.BlockParts.make

    def interrupted(self, block):
        if block.index == 1:
            raise KeyboardInterrupt
        return whole(self, block)

    monkeypatch.setattr(_blocks.BlockParts, "make", interrupted)
    status, out, err = splatseg(*words)
    assert (status, out) == (1, "")
    assert err == (
        f"interrupted: 1 of 2 blocks of {root / 'fields/b'} are made; the same command without "
        "--overwrite goes on\n"
    )
    assert "note: 1 of 2 blocks of field b lack; the street command" in splatseg("info", root)[1]
    labels = ("--label-scans", generated_drive, "-o", tmp_path / "out", "--by", "mesh")
    status, _, err = splatseg("street", root, "--field", "b", *labels, "--quiet")
    assert (status, err.count("\n")) == (2, 1)
    assert "all 2 blocks of the drive, 1 lack, the first 0001.safetensors" in err
    monkeypatch.undo()
    status, out, _ = splatseg(*words, *labels, "--json")
    assert status == 0
    facts = json.loads(out)
    assert facts["blocks_made"] == 1
    assert facts["labels"]["by"] == "mesh"
    first = (root / "fields/street").glob("0*")
    again = (root / "fields/b").glob("0*")
    assert {p.name: p.read_bytes() for p in first} == {p.name: p.read_bytes() for p in again}


def test_moving_things_are_told_of(made, generated_drive, boxes, splatseg, tmp_path) -> None:
    root = shutil.copytree(made, tmp_path / "scene")
    words = (
        root, "--scans", generated_drive, *FAST, "--moving", boxes, "--moving-clock", "frames",
    )  # fmt: skip
    status, out, _ = splatseg("street", *words, "--field", "b", "--quiet")
    assert status == 0
    assert out.startswith("moving things are left out of 1 of the 10 training views, ")
    status, out, _ = splatseg(
        "street", *words, "--moving-classes", "sky,road", *BLOCKS, "--field", "c", "--json",
        "--quiet",
    )  # fmt: skip
    assert status == 0
    moving = json.loads(out)["moving"]
    assert (moving["boxes"], moving["classes"]) == (1, ["sky", "road"])
    assert moving["clock"] == "frames"
    assert moving["masked_views"] == 10
    assert 0.1 < moving["masked_share"] < 1


def test_a_fit_leaves_them_out_too(generated_drive, boxes, splatseg, tmp_path) -> None:
    words = ("fit", generated_drive, "-o", tmp_path / "scene", "--steps", 3, "--max-gaussians", 300)
    status, out, _ = splatseg(
        *words, "--moving", boxes, "--moving-clock", "frames", "--moving-classes", "sky",
        "--moving-evidence", "labels_semantic", "--backend", "cpu", "--json", "--quiet",
    )  # fmt: skip
    assert status == 0
    moving = json.loads(out)["moving"]
    assert (moving["boxes"], moving["classes"], moving["masked_views"]) == (1, ["sky"], 10)
    scene = load_scene(tmp_path / "scene")
    assert scene.provenance["moving"] == moving
    assert {view.mask.parent for view in scene.train_views} == {tmp_path / "scene/masks"}


def test_what_is_wrong_is_one_sentence(made, generated_drive, boxes, splatseg, tmp_path) -> None:
    def refused(*words: object) -> str:
        command = ("street", root, "--scans", generated_drive, *FAST, *words, "--quiet")
        status, out, err = splatseg(*command)
        assert (status, out, err.count("\n")) == (2, "", 1), err
        return err

    root = shutil.copytree(made, tmp_path / "scene")
    before = sorted((root / "fields").rglob("*"))
    new = ("--field", "b")
    assert "--block-overlap: expected less than 9 m, got 9 m" in refused(
        *new, "--block-length", "9", "--block-overlap", "9"
    )
    assert "--block-overlap: expected a length of blocks" in refused(*new, "--block-overlap", "9")
    assert "--moving-classes: expected classes of" in refused(*new, "--moving-classes", "unicorn")
    assert "--moving-clock: expected boxes with it (--moving)" in refused(
        *new, "--moving-clock", "frames"
    )
    assert "has one called 'street'; give another name, or --overwrite" in refused(*BLOCKS)
    assert "has one called 'street'; give another name, or --overwrite" in refused()
    late = tmp_path / "late.json"
    content = json.loads(boxes.read_text())
    content["boxes"][0] |= {"start": 1e6, "end": 1e6}
    late.write_text(json.dumps(content))
    assert "is their clock another" in refused(*new, *BLOCKS, "--moving", late)
    assert sorted((root / "fields").rglob("*")) == before
    table = root / "fields/street/drive.json"
    table.write_text(table.read_text().replace('"overlap"', '"over"'))
    for command in (
        ("render", root, "-o", tmp_path / "views", "--field", "street", "--quiet"),
        ("street", root, "--label-scans", generated_drive, "-o", tmp_path / "out", "--by", "mesh"),
    ):
        status, _, err = splatseg(*command)
        assert (status, err.count("\n")) == (2, 1), err
        assert "drive.json: expected a field overlap, got none." in err
    assert not (tmp_path / "views").exists()
    assert not (tmp_path / "out").exists()
    status, out, _ = splatseg("info", root)
    assert status == 0
    assert "drive.json: expected a field overlap, got none" in out
