"""Moving things are left out of fits: masks in the scene, scans without their points, a record."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.cli.fit import Command, run
from splatseg.core import Capture
from splatseg.core.scans import MovingBox, pixels_of_boxes
from splatseg.errors import InputError, MissingFileError
from splatseg.fit import FitOptions
from splatseg.io.captures import read_capture
from splatseg.io.evidence import open_evidence
from splatseg.io.images import load_mask
from splatseg.io.moving import write_moving
from splatseg.io.scene import load_scene
from splatseg.io.scene_folder import is_scene, is_unfinished
from splatseg.tasks import MakeSceneOptions, fit_capture
from splatseg.tasks.moving import MovingThings, capture_without_moving
from support.observers import Stopping

FEW = FitOptions(minutes=None, steps=3, max_gaussians=300, prune_floaters=False)
LAYER = "labels_semantic"


@pytest.fixture
def capture(small_room) -> Capture:
    return read_capture(small_room)


@pytest.fixture
def box(capture) -> MovingBox:
    """Before the first training view, at its moment."""
    view = capture.train_views[0]
    number = float(view.name.rpartition("_")[2])
    return MovingBox(
        centre=view.camera.centre + 1.0 * view.camera.world_from_cam[:3, 2],
        size=(0.4, 0.4, 0.4), rotation=torch.tensor([1.0, 0, 0, 0]), start=number, end=number,
    )  # fmt: skip


@pytest.fixture
def boxes(box, tmp_path) -> Path:
    write_moving([box], tmp_path / "boxes.json")
    return tmp_path / "boxes.json"


def fitted(small_room: Path, folder: Path, observer=None, fit_options=FEW, **asked):
    return fit_capture(
        small_room, folder, options=MakeSceneOptions(**asked), fit_options=fit_options,
        backend="cpu", observer=observer or Stopping(),
    )  # fmt: skip


def test_masks_are_in_the_scene_and_stay_with_it(small_room, capture, boxes, box, tmp_path) -> None:
    observer = Stopping()
    made = fitted(small_room, tmp_path / "scene", observer, moving=boxes)
    first = capture.train_views[0]
    moved = (tmp_path / "scene").rename(tmp_path / "elsewhere")
    scene = load_scene(moved)
    masks = [view for view in scene.views if view.mask is not None]
    assert [view.name for view in masks] == [first.name]
    assert masks[0].mask == moved / "masks" / f"{first.name}.png"
    hidden = pixels_of_boxes(first.camera, [box], margin=0.1 / (capture.metres_per_unit or 1.0))
    assert torch.equal(load_mask(masks[0]) == 0, hidden)
    assert 0 < int(hidden.sum()) < hidden.numel()
    assert made.moving is not None
    assert scene.provenance["moving"] == made.moving.record
    assert made.moving.record["masked_views"] == 1
    assert made.moving.sentence in observer.heard


def test_the_fit_learns_nothing_there(small_room, boxes, tmp_path) -> None:
    plain = fitted(small_room, tmp_path / "plain")
    made = fitted(small_room, tmp_path / "scene", moving=boxes)
    assert plain.moving is None
    assert "moving" not in load_scene(plain.folder).provenance
    assert not (plain.folder / "masks").exists()
    assert not torch.equal(plain.result.gaussians.sh, made.result.gaussians.sh)


def test_classes_come_from_the_evidence_that_is_named(small_room, capture, tmp_path) -> None:
    evidence = open_evidence(small_room / LAYER)
    row = evidence.classes.rows[0]
    other = shutil.copytree(small_room / LAYER, tmp_path / "maps" / "labels_other")
    shutil.copy(small_room / "metadata.json", tmp_path / "maps" / "metadata.json")
    for path in other.glob("*.png"):
        ids = np.array(Image.open(path))
        Image.fromarray(np.zeros_like(ids)).save(path)
    (tmp_path / "evidence/depth_scans").mkdir(parents=True)
    np.savez(tmp_path / "evidence/depth_scans/train_0.npz", depth=np.ones((4, 4)), kind="metric")
    shares = {}
    for name in (None, LAYER, str(other)):
        masked, left_out = capture_without_moving(
            capture, MovingThings(classes=(row.name,)), scene=tmp_path, evidence=name,
            masks="ignore",
        )  # fmt: skip
        shares[name] = left_out.share
        for view in masked.train_views:
            shown = evidence.label_map(view.name).ids == row.id
            if name == LAYER and bool(shown.any()):
                assert not bool(load_mask(view).bool()[shown].any())
    assert shares[None] == shares[LAYER] > 0
    (tmp_path / "evidence/labels_more").symlink_to(other)
    with pytest.raises(InputError, match=r"\(labels_more, labels_semantic\), got none"):
        capture_without_moving(
            capture, MovingThings(classes=(row.name,)), scene=tmp_path, evidence=None,
            masks="ignore",
        )  # fmt: skip
    assert shares[str(other)] == 0
    assert all(view.mask is None for view in capture.test_views)


def test_scans_lose_their_points_too(small_room, capture, box, boxes, tmp_path) -> None:
    """Of two points one is in the box: its depth is not learned, and nothing starts at it."""
    view = capture.train_views[0]
    forward = view.camera.world_from_cam[:3, 2]
    around = 0.02 * torch.rand(60, 3, generator=torch.Generator().manual_seed(1)).double()
    still = view.camera.centre + 2.0 * forward + around
    points = torch.cat((box.centre + around, still))
    number = view.name.rpartition("_")[2]
    np.savez(tmp_path / f"scan_{number}.npz", points=points.numpy())
    metric = replace(FEW, depth="metric")
    scans = tmp_path / f"scan_{number}.npz"
    heard = {}
    for name, asked in (("plain", {}), ("static", {"moving": boxes, "moving_clock": "frames"})):
        observer = Stopping()
        made = fitted(small_room, tmp_path / name, observer, metric, scans=scans, **asked)
        points = made.capture.points.points.double()
        heard[name] = int((torch.cdist(points, box.centre[None]) < 0.1).sum())
    assert heard["static"] < heard["plain"]


def test_a_fit_that_was_stopped_goes_on_with_them(small_room, boxes, tmp_path) -> None:
    whole = fitted(small_room, tmp_path / "whole", moving=boxes)
    stop = Stopping("fit", after=1, error=KeyboardInterrupt)
    made = fitted(small_room, tmp_path / "scene", stop, moving=boxes)
    assert made.interrupted
    again = fitted(small_room, tmp_path / "scene", moving=boxes, resume=True)
    assert torch.equal(again.result.gaussians.sh, whole.result.gaussians.sh)
    assert load_scene(again.folder).train_views[0].mask is not None


def test_a_folder_with_a_checkpoint_and_masks_is_an_unfinished_fit(tmp_path) -> None:
    for name in ("fit", "masks"):
        (tmp_path / name).mkdir()
    (tmp_path / "fit/checkpoint.npz").write_bytes(b"")
    assert is_unfinished(tmp_path)


def test_what_is_refused_leaves_nothing(small_room, boxes, box, tmp_path) -> None:
    late = tmp_path / "late.json"
    write_moving([replace(box, start=1e6, end=1e6)], late)
    row = read_capture(small_room).classes.rows[0].name
    depth = tmp_path / "depth_x"
    depth.mkdir()
    np.savez(depth / "train_0.npz", depth=np.ones((4, 4), np.float16), kind="metric")
    unknown = "^moving_classes: expected classes of .*, got 'unicorn'"
    for words, asked in (
        ("^masks: expected ignore with moving things, got off", {"moving": boxes}),
        ("is their clock another", {"moving": late}),
        ("none.json", {"moving": tmp_path / "none.json"}),
        (unknown, {"moving_classes": ("unicorn",)}),
        (r"^moving_evidence: expected one of those at hand .*labels_semantic.*, got 'x'",
         {"moving_classes": (row,), "moving_evidence": "x"}),
        ("^moving_evidence: expected classes with it", {"moving": boxes, "moving_evidence": LAYER}),
        ("^moving_evidence: expected classes with it", {"moving_evidence": LAYER}),
        ("^moving_evidence: expected evidence of labels, got depth",
         {"moving_classes": (row,), "moving_evidence": str(depth)}),
        ("^moving_clock: expected boxes with it", {"moving_clock": "frames"}),
    ):  # fmt: skip
        options = replace(FEW, masks="off") if "off" in words else FEW
        with pytest.raises((InputError, MissingFileError), match=words):
            fitted(small_room, tmp_path / "scene", fit_options=options, **asked)
        assert not (tmp_path / "scene").exists()


def test_a_fit_that_fails_leaves_no_masks(small_room, boxes, tmp_path, monkeypatch) -> None:
    from splatseg.tasks import fit_blocks

    def fails(*_: object, **__: object) -> None:
        raise InputError("no")

    monkeypatch.setattr(fit_blocks, "fit", fails)
    with pytest.raises(InputError, match="^no$"):
        fitted(small_room, tmp_path / "scene", moving=boxes)
    assert not (tmp_path / "scene").exists()


def test_the_command_hands_its_flags_on(monkeypatch, tmp_path) -> None:
    from splatseg.cli import fit

    given = []

    class Stop(Exception):
        """Nothing is fitted."""

    def record(*_: object, options: MakeSceneOptions, **__: object) -> None:
        given.append(options)
        raise Stop

    monkeypatch.setattr(fit, "fit_capture", record)
    command = Command(
        data=tmp_path,
        output=tmp_path,
        capture=MakeSceneOptions(
            moving=Path("b.json"),
            moving_classes=("car",),
            moving_evidence="maps",
            moving_clock="frames",
        ),
    )
    with pytest.raises(Stop):
        run(command)
    asked = given[0]
    assert (asked.moving, asked.moving_classes) == (Path("b.json"), ("car",))
    assert (asked.moving_evidence, asked.moving_clock) == ("maps", "frames")
    assert not is_scene(tmp_path)
