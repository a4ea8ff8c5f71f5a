"""Pixels that masks of views leave out have no labels: no Gaussian learns what moved there."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg import SegmentOptions, View, segment
from splatseg.core import Camera, LabelMap, Labels, Segment, Track
from splatseg.errors import InputError, ShapeError
from splatseg.io.evidence import (
    PanopticEvidence,
    TrackedEvidence,
    create_evidence,
    open_evidence,
    save_label_map,
    save_segments,
    save_tracks,
    without_masked,
)
from splatseg.io.scene import load_scene
from splatseg.tasks.work import Observer

HEIGHT, WIDTH = 4, 6
ROOM = {"evidence": "labels_semantic", "layer": "x", "complete": False}


def masked_view(folder, name: str, used: np.ndarray) -> View:
    camera = Camera(width=WIDTH, height=HEIGHT, fx=4, fy=4, cx=3, cy=2, cam_from_world=torch.eye(4))
    Image.fromarray((used * 255).astype(np.uint8)).save(folder / f"{name}.png")
    return View(name=name, camera=camera, image=None, mask=folder / f"{name}.png")


def left_half() -> np.ndarray:
    used = np.ones((HEIGHT, WIDTH), bool)
    used[:, :3] = False
    return used


def save(folder, **maps: tuple[int, int]) -> None:
    """Maps of two ids, side by side, of any size."""
    for name, (height, width) in maps.items():
        ids = torch.full((height, width), 2, dtype=torch.int32)
        ids[:, : width // 2] = 1
        save_label_map(LabelMap(ids=ids), folder, name)


def test_label_maps_lose_what_masks_leave_out(tmp_path) -> None:
    folder = create_evidence(tmp_path / "labels_x", kind="labels")
    save(folder, a=(HEIGHT, WIDTH), small=(2, 3), b=(HEIGHT, WIDTH))
    views = [masked_view(tmp_path, name, left_half()) for name in ("a", "small")]
    evidence = open_evidence(folder)
    found = without_masked(evidence, [*views, replace(views[0], name="b", mask=None)])
    assert found.label_map("a").ids.tolist() == [[-1, -1, -1, 2, 2, 2]] * HEIGHT
    # The middle of the second of three pixels is the right half's.
    assert found.label_map("small").ids.tolist() == [[-1, 2, 2]] * 2
    assert torch.equal(found.label_map("b").ids, evidence.label_map("b").ids)
    assert [int(r.area) for r in found.masks("a").masks] == [3 * HEIGHT]
    assert evidence.label_map("a").ids[0, 0] == 1
    assert without_masked(evidence, [replace(views[0], mask=None)]) is evidence
    save(folder, a=(2, 6))
    with pytest.raises(ShapeError, match="^view a: expected a map of 6x4 pixels"):
        found.label_map("a")


def test_panoptic_and_tracked_maps_too_and_masks_stay(tmp_path) -> None:
    view = masked_view(tmp_path, "a", left_half())
    folder = create_evidence(tmp_path / "labels_p", kind="panoptic")
    save(folder, a=(HEIGHT, WIDTH))
    rows = [Segment(id=i, category=5, isthing=True, score=0.5) for i in (1, 2)]
    save_segments({"a": rows}, folder)
    panoptic = without_masked(open_evidence(folder), [view])
    assert isinstance(panoptic, PanopticEvidence)
    assert panoptic.label_map("a").ids[0].tolist() == [-1, -1, -1, 2, 2, 2]
    assert panoptic.category_map("a").ids[0].tolist() == [-1, -1, -1, 5, 5, 5]
    assert len(panoptic.masks("a")) == 1
    folder = create_evidence(tmp_path / "labels_t", kind="tracked")
    save(folder, a=(HEIGHT, WIDTH))
    save_tracks([Track(id=i, votes={"car": 1}) for i in (1, 2)], folder, order=["a"])
    tracked = without_masked(open_evidence(folder), [view])
    assert isinstance(tracked, TrackedEvidence)
    assert tracked.label_map("a").ids[0].tolist() == [-1, -1, -1, 2, 2, 2]


def test_segment_leaves_out_what_moved(made, small_room, tmp_path) -> None:
    """A class whose pixels are left out of every view is nowhere; off brings it back."""
    capture = shutil.copytree(small_room, tmp_path / "room")
    scene = replace(load_scene(made), source=capture)
    whole = segment(scene, "uplift", options=SegmentOptions(**ROOM), backend="cpu").layer
    assert isinstance(whole, Labels)
    gone = int(whole.present[-1])
    views = []
    for view in scene.views:
        path = capture / "labels_semantic" / f"{view.name}.png"
        if view.split != "train":
            views.append(view)
            continue
        used = np.array(Image.open(path)) != gone
        Image.fromarray((used * 255).astype(np.uint8)).save(tmp_path / f"{view.name}.png")
        views.append(replace(view, mask=tmp_path / f"{view.name}.png"))
    masked = replace(scene, views=tuple(views))

    class Listening(Observer):
        def note(self, message: str) -> None:
            notes.append(message)

    notes: list[str] = []

    def present(**more: str) -> list[int]:
        options = SegmentOptions(**ROOM, **more)
        listening = Listening()
        made = segment(masked, "uplift", options=options, backend="cpu", observer=listening)
        layer = made.layer
        assert isinstance(layer, Labels)
        return layer.present.tolist()

    assert gone not in present()
    said = "masks of 5 of 5 views leave pixels out"
    assert said in notes
    notes.clear()
    assert present(view_masks="off") == whole.present.tolist()
    assert said not in notes
    # As the fit took masks; what is known of no fit took none.
    for meaning in ("off", "alpha"):
        masked = replace(masked, provenance={"options": {"masks": meaning}})
        assert present() == whole.present.tolist()
        assert gone not in present(view_masks="ignore")
    masked = replace(masked, provenance={})
    assert present() == whole.present.tolist()
    with pytest.raises(InputError, match="^view_masks: expected one of auto, ignore, off"):
        SegmentOptions(view_masks="keep")
