"""What a tracker is to follow: out of masks, and which of the tracks a seed is."""

import pytest
import torch

from splatseg.core import Camera, LabelMap, MaskSet, Segment, Track, View
from splatseg.core.scene import ClassInfo, ClassTable
from splatseg.errors import FileFormatError, InputError, RangeError
from splatseg.io.evidence import (
    create_evidence,
    open_evidence,
    save_label_map,
    save_masks,
    save_segments,
    save_tracks,
)
from splatseg.models import TrackingOptions
from splatseg.models._tracked import Seeds, same_objects

CLASSES = ClassTable(rows=(ClassInfo(id=3, name="cup"), ClassInfo(id=4, name="desk")))


def a_view(height: int = 2, width: int = 6) -> View:
    camera = Camera(
        width=width, height=height, fx=3.0, fy=3.0, cx=2.0, cy=1.5,
        cam_from_world=torch.eye(4, dtype=torch.float64),
    )  # fmt: skip
    return View(name="v", camera=camera, image=None, split="train")


def row(*ids: int) -> LabelMap:
    return LabelMap(ids=torch.tensor([ids], dtype=torch.int32))


@pytest.fixture
def masks(tmp_path):
    """Four of two rows: columns 2 to 4, all, 3 alone, none but 5; of levels 0, 2, 0, 1."""
    dense = torch.zeros(4, 2, 6, dtype=torch.bool)
    dense[0, :, 1:4], dense[1], dense[2, :, 2], dense[3, 0, 5] = True, True, True, True
    folder = create_evidence(tmp_path / "m", kind="masks")
    save_masks(MaskSet.from_dense(dense, levels=[0, 2, 0, 1]), folder, "v")
    return open_evidence(folder)


def test_smaller_masks_lie_on_larger_ones(masks) -> None:
    seeds = Seeds(evidence=masks, options=TrackingOptions())
    assert not seeds.persistent
    assert seeds.categories("v") == {}
    found = seeds.label_map(a_view()).ids
    assert found.tolist() == [[2, 1, 3, 1, 2, 4], [2, 1, 3, 1, 2, 2]]


def test_one_level_of_masks(masks) -> None:
    seeds = Seeds(evidence=masks, options=TrackingOptions(seed_level=0))
    assert seeds.label_map(a_view()).ids.tolist() == [[-1, 1, 3, 1, -1, -1]] * 2


def test_small_seeds_are_left_out(masks) -> None:
    """Of 12 pixels mask 4 has 1 and mask 3 has 2: they leave no holes. Mask 1 has 6, of which 3
    covers 2."""

    def found(area: float) -> list[list[int]]:
        seeds = Seeds(evidence=masks, options=TrackingOptions(seed_area=area))
        return seeds.label_map(a_view()).ids.tolist()

    assert found(2 / 12) == [[2, 1, 3, 1, 2, 2]] * 2
    assert found(0.25) == [[2, 1, 1, 1, 2, 2]] * 2
    dense = torch.zeros(2, 2, 6, dtype=torch.bool)
    dense[0, :, :3], dense[1, :, :2] = True, True
    save_masks(MaskSet.from_dense(dense), masks.folder, "v")
    assert found(2 / 12) == [[2, 2, 1, -1, -1, -1]] * 2
    assert found(0.25) == [[2, 2, -1, -1, -1, -1]] * 2, "of mask 1 too little is to be seen"


def test_seeds_of_another_size_or_kind(masks, tmp_path) -> None:
    with pytest.raises(FileFormatError, match="expected 9x2 pixels as the photograph has, got 6x2"):
        Seeds(evidence=masks, options=TrackingOptions()).label_map(a_view(2, 9))
    folder = create_evidence(tmp_path / "l", kind="labels")
    save_label_map(row(1, 2), folder, "v")
    with pytest.raises(InputError, match="seed_level: goes with masks"):
        Seeds(evidence=open_evidence(folder), options=TrackingOptions(seed_level=0))
    with pytest.raises(FileFormatError, match="expected 6x2 pixels"):
        Seeds(evidence=open_evidence(folder), options=TrackingOptions()).label_map(a_view())
    features = open_evidence(create_evidence(tmp_path / "f", kind="features"), unfinished="allow")
    with pytest.raises(InputError, match="expected seeds .* got features"):
        Seeds(evidence=features, options=TrackingOptions())


def test_classes_of_seeds(tmp_path) -> None:
    one = create_evidence(tmp_path / "p", kind="panoptic", classes=CLASSES)
    save_label_map(row(1, 2), one, "v")
    rows = (
        Segment(id=1, category=4, isthing=True, score=1.0),
        Segment(id=2, category=-1, isthing=True, score=1.0),
    )
    save_segments({"v": rows}, one)
    panoptic = Seeds(evidence=open_evidence(one), options=TrackingOptions())
    assert (panoptic.categories("v"), panoptic.persistent) == ({1: "desk"}, False)
    two = create_evidence(tmp_path / "l", kind="labels", classes=CLASSES)
    save_label_map(row(3, 4), two, "v")
    labels = Seeds(evidence=open_evidence(two), options=TrackingOptions())
    assert (labels.categories("v"), labels.persistent) == ({3: "cup", 4: "desk"}, True)
    three = create_evidence(tmp_path / "t", kind="tracked", classes=CLASSES)
    save_label_map(row(7, 8), three, "v")
    save_tracks([Track(id=7, votes={"cup": 3}), Track(id=8, votes={})], three, order=["v"])
    tracks = Seeds(evidence=open_evidence(three), options=TrackingOptions())
    assert (tracks.categories("v"), tracks.persistent) == ({7: "cup"}, True)
    for seeds in (panoptic, labels, tracks):
        assert seeds.classes is not None
        assert [row.name for row in seeds.classes.rows] == ["cup", "desk"]


def test_which_track_a_seed_is() -> None:
    """Seed 1 shares 3 of 4 pixels with track 7; seed 2 shares 1 of 5 with track 8."""
    tracked = row(7, 7, 7, 8, 8, 8, -1, -1)
    seed = row(1, 1, 1, 1, -1, 2, 2, 2)
    assert same_objects(tracked, seed, min_iou=0.75, next_id=9) == {1: 7, 2: 9}
    assert same_objects(tracked, seed, min_iou=0.2, next_id=9) == {1: 7, 2: 8}
    assert same_objects(tracked, seed, min_iou=0.76, next_id=9) == {1: 9, 2: 10}
    assert same_objects(tracked, row(*[-1] * 8), min_iou=0.1, next_id=9) == {}


def test_a_track_is_one_seed_and_a_seed_one_track() -> None:
    """7 is split by the seeds: 2 of 6 pixels and 3 of 6; the larger overlap has it."""
    tracked = row(7, 7, 7, 7, 7, 7, 8)
    seed = row(1, 1, 3, 3, 3, -1, 1)
    assert same_objects(tracked, seed, min_iou=0.25, next_id=20) == {1: 8, 3: 7}
    assert same_objects(tracked, seed, min_iou=0.4, next_id=20) == {1: 20, 3: 7}
    both = row(1, 1, 3, 3, 3, -1, -1)
    assert same_objects(tracked, both, min_iou=0.25, next_id=20) == {1: 20, 3: 7}


def test_options_are_checked() -> None:
    for name, value in (("seed_every", 0), ("seed_iou", 1.5), ("seed_area", -0.1)):
        with pytest.raises(RangeError, match=name):
            TrackingOptions(**{name: value})
    with pytest.raises(InputError, match="view_order"):
        TrackingOptions(view_order="length")
