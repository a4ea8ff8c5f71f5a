"""Moving things from files and label maps, and what is left without them."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import Camera, Capture, ScanSource, View
from splatseg.core.moving import MovingBox, boxes_at, inside_boxes, pixels_of_boxes
from splatseg.core.scans import Scan
from splatseg.errors import FileFormatError, InputError, MissingFileError, RangeError, ShapeError
from splatseg.io.captures import read_capture
from splatseg.io.evidence import open_evidence
from splatseg.io.images import load_mask
from splatseg.io.moving import (
    MovingOptions,
    StaticScans,
    mask_moving,
    read_moving,
    view_times,
    write_moving,
)
from splatseg.io.scans import read_scans

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
WIDTH, HEIGHT = 10, 8


def box(centre=(0.0, 0, 11), size=(4.0, 2, 2), **rest) -> MovingBox:
    return MovingBox(centre=torch.tensor(centre), size=size, rotation=UPRIGHT, **rest)


def view(name: str, folder=None, **rest) -> View:
    """A view in whose pixels `box()` is in rows 3 and 4, columns 3 to 6."""
    camera = Camera(
        width=WIDTH, height=HEIGHT, fx=10, fy=10, cx=5, cy=4, cam_from_world=torch.eye(4)
    )
    image = None
    if folder is not None:
        image = folder / "images" / f"{name}.png"
        image.parent.mkdir(exist_ok=True)
        Image.fromarray(np.full((HEIGHT, WIDTH, 3), 90, np.uint8)).save(image)
    return View(name=name, camera=camera, image=image, **rest)


def capture(folder, *views: View, **rest) -> Capture:
    return Capture(path=folder, format="colmap", views=views, **rest)


def labels(folder, **maps: np.ndarray):
    """Evidence of classes road (1) and car (2)."""
    made = folder / "labels_semantic"
    made.mkdir()
    for name, ids in maps.items():
        Image.fromarray(ids.astype(np.uint8)).save(made / f"{name}.png")
    table = [{"id": i, "name": name} for i, name in ((1, "road"), (2, "car"))]
    (folder / "metadata.json").write_text(json.dumps({"classes": table}))
    return open_evidence(made)


SHOWN = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
SHOWN[3:5, 3:7] = True


def ignored(of: View) -> torch.Tensor:
    mask = load_mask(of)
    assert mask is not None
    return mask == 0


def test_boxes_come_back_from_a_file(tmp_path):
    turned = (0.5, 0.5, -0.5, 0.5)
    boxes = (
        box(start=1.5, end=2.5, name="car 3"),
        MovingBox(centre=torch.tensor([1.0, 2, 3]), size=(1, 2, 3), rotation=torch.tensor(turned)),
    )
    write_moving(boxes, tmp_path / "moving.json")
    found = read_moving(tmp_path / "moving.json")
    assert [(b.size, b.start, b.end, b.name) for b in found] == [
        ((4, 2, 2), 1.5, 2.5, "car 3"),
        ((1, 2, 3), -math.inf, math.inf, ""),
    ]
    assert found[1].rotation.tolist() == list(turned)
    assert found[0].centre.tolist() == [0, 0, 11]


def test_a_file_may_leave_out_what_is_as_usual(tmp_path):
    path = tmp_path / "moving.json"
    path.write_text(json.dumps({"boxes": [{"centre": [0, 1, 2], "size": [1, 1, 1], "time": 7}]}))
    (found,) = read_moving(path)
    assert (found.start, found.end, found.rotation.tolist()) == (7.0, 7.0, list(UPRIGHT))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({}, "expected a list of boxes"),
        ({"boxes": {}}, "expected a list of boxes"),
        ({"boxes": [3]}, r"boxes\[0\]: expected an object"),
        ({"boxes": [{"size": [1, 1, 1]}]}, r"boxes\[0\]: expected a field centre"),
        ({"boxes": [{"centre": [0, 0], "size": [1, 1, 1]}]}, "centre: expected a list of length 3"),
        (
            {"boxes": [{"centre": [0, 0, 1e99], "size": [1, 1, 1]}]},
            "centre\\[2\\]: expected a finite",
        ),
        (
            {"boxes": [{"centre": [0, 0, 0], "size": [1, 0, 1]}]},
            r"boxes\[0\]: size: expected three",
        ),
        ({"boxes": [{"centre": [0, 0, 0], "size": [1, 1, 1], "yaw": 3}]}, "got 'yaw'"),
        (
            {"boxes": [{"centre": [0, 0, 0], "size": [1, 1, 1], "time": 1, "end": 2}]},
            "expected a time, or a start and an end",
        ),
        (
            {"boxes": [{"centre": [0, 0, 0], "size": [1, 1, 1], "start": "now"}]},
            "start: expected a number or null",
        ),
        ({"boxes": [{"centre": [0, 0, 0], "size": [1, 1, 1], "name": 4}]}, "name: expected text"),
        (
            {"boxes": [{"centre": [0, 0, 0], "size": [1, 1, 1], "rotation": [0, 0, 0, 0]}]},
            r"boxes\[0\]: quaternions",
        ),
    ],
)
def test_files_of_something_else_are_refused(content, words, tmp_path):
    path = tmp_path / "moving.json"
    path.write_text(json.dumps(content))
    with pytest.raises(FileFormatError, match=words):
        read_moving(path)
    with pytest.raises(MissingFileError, match="none.json"):
        read_moving(tmp_path / "none.json")


def test_boxes_of_the_views_time_are_masked(tmp_path):
    source = capture(tmp_path, *(view(f"train_{i:04d}_L", tmp_path) for i in (4, 5, 6)))
    said: list[str] = []
    found = mask_moving(
        source,
        tmp_path / "masks",
        boxes=[box(start=5, end=5)],
        options=MovingOptions(margin=0.0),
        report=said.append,
    )
    assert [one.mask is not None for one in found.views] == [False, True, False]
    assert torch.equal(ignored(found.views[1]), SHOWN)
    assert said == ["moving things are left out of 1 of the 3 training views, 3.3% of their pixels"]


def test_the_margin_is_in_metres(tmp_path):
    source = capture(tmp_path, view("1", tmp_path), metres_per_unit=2.0)
    found = mask_moving(
        source, tmp_path / "masks", boxes=[box()], options=MovingOptions(margin=3.2)
    )
    expected = pixels_of_boxes(source.views[0].camera, [box()], margin=1.6)
    assert torch.equal(ignored(found.views[0]), expected)
    assert int(expected.sum()) > int(SHOWN.sum())


def test_times_can_be_given(tmp_path):
    source = capture(tmp_path, view("1", tmp_path), view("left", tmp_path))
    boxes = [box(start=0.0, end=0.5)]
    times = {"1": 9.0, "left": 0.25}
    found = mask_moving(source, tmp_path / "masks", boxes=boxes, times=times)
    assert [one.mask is not None for one in found.views] == [False, True]
    with pytest.raises(InputError, match="times: expected one of every training view"):
        mask_moving(source, tmp_path / "masks", boxes=boxes, times={"1": 0.0})
    with pytest.raises(InputError, match="got none of view 'left'"):
        mask_moving(source, tmp_path / "masks", boxes=boxes)


def test_boxes_on_another_clock_are_refused(tmp_path):
    source = capture(tmp_path, view("1", tmp_path), view("2", tmp_path))
    boxes = [box(start=1.5e9, end=1.5e9), box(start=1.6e9, end=1.7e9)]
    with pytest.raises(InputError, match=r"views, 1 to 2, got boxes from 1\.5e\+09 to 1\.7e\+09"):
        mask_moving(source, tmp_path / "masks", boxes=boxes)


def test_the_clock_can_be_the_number_of_frames(generated_drive, tmp_path):
    drive = read_capture(generated_drive)
    there = box(centre=drive.views[-1].camera.centre.tolist(), start=11.0, end=11.0)
    assert view_times(drive, clock="frames")["testnovel_0000"] == 0.0
    options = MovingOptions(clock="frames")
    found = mask_moving(drive, tmp_path / "m", boxes=[there], options=options)
    assert [one.name for one in found.views if one.mask is not None] == ["train_0011"]
    scans = read_scans(generated_drive)
    at = box(centre=scans.scan("0001").points[40].tolist(), start=1.0, end=1.0)
    assert len(StaticScans(scans, [at]).scan("0001")) == len(scans.scan("0001"))
    assert len(StaticScans(scans, [at], clock="frames").scan("0001")) < len(scans.scan("0001"))
    with pytest.raises(InputError, match="clock"):
        MovingOptions(clock="hours")


def test_only_training_views_are_masked(tmp_path):
    source = capture(tmp_path, view("1", tmp_path), view("2", tmp_path, split="test"))
    found = mask_moving(source, tmp_path / "masks", boxes=[box()])
    assert found.views[0].mask is not None
    assert found.views[1] is source.views[1]


def test_masks_of_the_capture_count_as_well(tmp_path):
    own = np.full((HEIGHT, WIDTH), 255, np.uint8)
    own[0] = 0
    Image.fromarray(own).save(tmp_path / "own.png")
    source = capture(tmp_path, view("1", tmp_path, mask=tmp_path / "own.png"))
    options = MovingOptions(margin=0.0)
    found = mask_moving(source, tmp_path / "masks", boxes=[box()], options=options)
    both = SHOWN.clone()
    both[0] = True
    assert torch.equal(ignored(found.views[0]), both)
    beside = box(centre=(0.0, 0, -50))
    nothing = mask_moving(source, tmp_path / "masks", boxes=[beside])
    assert nothing.views[0].mask == tmp_path / "own.png"


def test_classes_that_move_are_masked(tmp_path):
    ids = np.ones((HEIGHT, WIDTH))
    ids[4, 5] = 2
    evidence = labels(tmp_path, a1=ids, a2=np.ones((HEIGHT, WIDTH)))
    source = capture(tmp_path, *(view(name, tmp_path) for name in ("a1", "a2", "a3")))

    def masked(grow: int) -> Capture:
        return mask_moving(
            source,
            tmp_path / f"masks_{grow}",
            labels=evidence,
            classes=["car"],
            options=MovingOptions(grow=grow),
        )

    assert [one.mask is not None for one in masked(0).views] == [True, False, False]
    assert ignored(masked(0).views[0]).nonzero().tolist() == [[4, 5]]
    grown = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    grown[2:7, 3:8] = True
    assert torch.equal(ignored(masked(2).views[0]), grown)
    for one in (None, evidence):
        nothing = mask_moving(source, tmp_path / "masks", labels=one)
        assert [v.mask for v in nothing.views] == [None] * 3


def test_maps_smaller_than_photographs(tmp_path):
    ids = np.ones((HEIGHT // 2, WIDTH // 2))
    ids[1, 2] = 2
    evidence = labels(tmp_path, a1=ids)
    source = capture(tmp_path, view("a1", tmp_path))
    options = MovingOptions(grow=0)
    found = mask_moving(source, tmp_path / "m", labels=evidence, classes=["car"], options=options)
    assert ignored(found.views[0]).nonzero().tolist() == [[2, 4], [2, 5], [3, 4], [3, 5]]


def test_classes_that_no_map_knows_are_refused(tmp_path):
    evidence = labels(tmp_path, a1=np.ones((HEIGHT, WIDTH)))
    source = capture(tmp_path, view("a1", tmp_path))
    with pytest.raises(InputError, match="class: expected one of road, car, got 'tram'"):
        mask_moving(source, tmp_path / "m", labels=evidence, classes=["tram"])
    with pytest.raises(InputError, match="classes: expected label maps with names"):
        mask_moving(source, tmp_path / "m", classes=["car"])
    wrong = capture(tmp_path, replace(source.views[0], camera=source.views[0].camera.resized(6, 8)))
    with pytest.raises(ShapeError, match="view a1"):
        mask_moving(wrong, tmp_path / "m", labels=evidence, classes=["car"])


@pytest.mark.parametrize("values", [{"margin": -0.1}, {"margin": math.inf}, {"grow": -1}])
def test_margins_that_cannot_be_are_refused(values):
    with pytest.raises(RangeError, match=f"^{next(iter(values))}"):
        MovingOptions(**values)


def test_times_of_views_are_those_of_the_file_or_of_names(generated_drive, tmp_path):
    drive = read_capture(generated_drive)
    times = view_times(drive)
    assert times["train_0004"] == 4.0
    assert times["testnovel_0000"] == 12.0  # its frame says so, its number does not
    assert view_times(capture(tmp_path, view("image_00/0000000031"))) == {
        "image_00/0000000031": 31.0
    }


def test_scans_lose_what_moves(generated_drive):
    """A box at the place of the second scan and its time takes nothing of the others."""
    scans = read_scans(generated_drive)
    second = scans.scan("0001")
    assert second.time is not None
    there = box(centre=second.points[40].tolist(), size=(3.0, 3, 3), start=second.time, end=6.0)
    static = StaticScans(scans, [there], margin=0.5)
    assert isinstance(static, ScanSource)
    assert static.scan_names == scans.scan_names
    moving = inside_boxes(second.points, [there], margin=0.5)
    assert 0 < int(moving.sum()) < len(second)
    assert torch.equal(static.scan("0001").points, second.points[~moving])
    assert len(StaticScans(scans, [there]).scan("0001")) > len(static.scan("0001"))
    for name in ("0000", "0002"):
        assert torch.equal(static.scan(name).points, scans.scan(name).points)
    later = StaticScans(scans, [there], times={"0002": second.time})
    assert len(later.scan("0002")) < len(scans.scan("0002"))


def test_scans_without_a_time_go_by_their_number():
    class Some:
        scan_names = ("velodyne/7", "cloud")

        def scan(self, name: str) -> Scan:
            return Scan(name=name, points=torch.tensor([[0.0, 0, 11], [9, 9, 9]]))

    static = StaticScans(Some(), [box(start=7, end=7)])
    assert static.scan("velodyne/7").points.tolist() == [[9, 9, 9]]
    with pytest.raises(InputError, match="scan 'cloud': expected the time"):
        static.scan("cloud")


def test_cars_of_camvid(shared_data, tmp_path):
    """A drive with moving cars: most pixels that people call cars are left out, little else is."""
    folder = shared_data / "real" / "camvid"
    source = read_capture(folder)
    evidence = open_evidence(folder / "labels_semantic")
    few = replace(source, views=source.train_views[::12])
    moving = ["car", "pedestrian"]
    found = mask_moving(few, tmp_path / "m", labels=evidence, classes=moving)
    truth = open_evidence(folder / "semantic")
    assert truth.classes is not None
    ids = torch.tensor([truth.classes.by_name(name).id for name in moving], dtype=torch.int32)
    hit = cars = left_out = pixels = 0
    for one in found.views:
        car = torch.isin(truth.label_map(one.name).ids, ids)
        out = ignored(one) if one.mask is not None else torch.zeros_like(car)
        hit, cars = hit + int((car & out).sum()), cars + int(car.sum())
        left_out, pixels = left_out + int(out.sum()), pixels + out.numel()
    assert cars > 1000
    assert hit > 0.85 * cars
    assert left_out < 0.25 * pixels


def test_boxes_of_a_time(tmp_path):
    boxes = [box(start=float(t), end=float(t)) for t in range(3)]
    write_moving(boxes, tmp_path / "m.json")
    assert len(boxes_at(read_moving(tmp_path / "m.json"), 1.0)) == 1
