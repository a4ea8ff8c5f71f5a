"""How drives are cut into blocks, and what of a capture and its scans is a block's."""

import itertools
import math
from dataclasses import replace

import pytest
import torch

from splatseg.core import Camera, Capture, PointCloud, View
from splatseg.core.scans import Scan
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.io.captures import read_capture
from splatseg.io.scans import read_scans
from splatseg.street.block_field import DriveScans, block_views
from splatseg.street.blocks import DriveBlockOptions, DriveBlocks, cut_drive, frame_centres
from street.blocks.support import NumberedScans, bend, crossing, straight


def dense(drive: DriveBlocks, points: torch.Tensor) -> torch.Tensor:
    """Weights as a table, a column a block."""
    out = torch.zeros(len(points), len(drive), dtype=torch.float64)
    for share in drive.shares(points):
        out[share.rows, share.block] = share.weights
    return out


def reference(drive: DriveBlocks, point: torch.Tensor) -> list[float]:
    """The equation of `splatseg.street.blocks`, one number at a time."""

    def to_segment(a: torch.Tensor, b: torch.Tensor) -> float:
        way, offset = b - a, point - a
        squared = float(way @ way)
        share = min(max(float(offset @ way) / squared, 0.0), 1.0) if squared else 0.0
        return float((offset - share * way).norm())

    delta = []
    for block in drive.blocks:
        corners = list(block.piece)
        pairs = list(itertools.pairwise(corners)) or [(corners[0], corners[0])]
        delta.append(min(to_segment(a, b) for a, b in pairs))
    counts = []
    for i, own in enumerate(delta):
        others = min((d for j, d in enumerate(delta) if j != i), default=math.inf)
        counts.append(min(max(0.5 + (others - own) / drive.overlap, 0.0), 1.0))
    return [count / sum(counts) for count in counts]


LINES = {"straight": straight(300.0), "bend": bend(), "crossing": crossing(400.0)}


@pytest.mark.parametrize("name", LINES)
def test_weights_are_those_of_the_equation(name, rng):
    drive = cut_drive(LINES[name])
    low, high = LINES[name].amin(0) - 15, LINES[name].amax(0) + 15
    points = low + (high - low) * torch.from_numpy(rng.random((300, 3)))
    expected = torch.tensor([reference(drive, at) for at in points], dtype=torch.float64)
    weights = dense(drive, points)
    torch.testing.assert_close(weights, expected, rtol=0, atol=1e-12)
    torch.testing.assert_close(weights.sum(1), torch.ones(300).double(), rtol=0, atol=1e-12)


def test_weights_go_linearly_over_the_overlap():
    drive = cut_drive(straight(200.0))
    assert [(b.start, b.end) for b in drive.blocks] == [(0, 50), (50, 100), (100, 150), (150, 200)]
    x = torch.linspace(30, 70, 81, dtype=torch.float64)
    points = torch.stack((x, 0 * x, 0 * x), dim=1)
    expected = ((60 - x) / 20).clamp(0, 1)
    torch.testing.assert_close(dense(drive, points)[:, 0], expected)
    torch.testing.assert_close(dense(drive, points)[:, 1], 1 - expected)


@pytest.mark.parametrize("name", LINES)
def test_weights_are_continuous(name, rng):
    """A step of 1 cm changes no weight by more than 1 cm / overlap, times the blocks there."""
    drive = cut_drive(LINES[name], options=DriveBlockOptions(length=60.0, overlap=20.0))
    low, high = LINES[name].amin(0) - 40, LINES[name].amax(0) + 40
    points = low + (high - low) * torch.from_numpy(rng.random((4000, 3)))
    way = torch.from_numpy(rng.normal(size=(4000, 3)))
    moved = points + 0.01 * way / way.norm(dim=1, keepdim=True)
    change = (dense(drive, points) - dense(drive, moved)).abs()
    assert float(change.max()) <= 4 * 0.02 / 20
    assert float(change.max()) > 0


def test_weights_are_a_function_of_the_point(rng):
    """The same bits in any company and order."""
    drive = cut_drive(LINES["crossing"])
    points = torch.from_numpy(rng.uniform(-100, 100, size=(500, 3)))
    whole = dense(drive, points)
    order = torch.from_numpy(rng.permutation(500))
    assert torch.equal(dense(drive, points[order]), whole[order])
    assert torch.equal(torch.cat([dense(drive, part) for part in points.split(7)]), whole)


@pytest.mark.parametrize("name", LINES)
def test_points_where_a_block_counts_are_those_of_its_weight(name, rng):
    drive = cut_drive(LINES[name], options=DriveBlockOptions(length=60.0, overlap=20.0))
    low, high = LINES[name].amin(0) - 40, LINES[name].amax(0) + 40
    points = low + (high - low) * torch.from_numpy(rng.random((400, 3)))
    weights = dense(drive, points)
    for block in drive.blocks:
        assert torch.equal(drive.counts(block, points), weights[:, block.index] > 0)


def test_where_a_drive_crosses_itself_all_passes_count():
    drive = cut_drive(LINES["crossing"], options=DriveBlockOptions(length=60, overlap=20))
    assert len(drive) > 6
    middle = drive.shares(torch.zeros(1, 3))
    assert len(middle) >= 2
    assert {0, len(drive) - 1} & {share.block for share in middle}
    assert any(0 < share.block < len(drive) - 1 for share in middle)


def test_blocks_are_no_longer_than_asked_for_and_overlap():
    options = DriveBlockOptions(length=50.0, overlap=12.0)
    drive = cut_drive(straight(301.0), options=options)
    lengths = [float((b.span[-1] - b.span[0]).norm()) for b in drive.blocks]
    assert max(lengths) <= 50.0 + 1e-9
    for one, after in itertools.pairwise(drive.blocks):
        assert one.end == after.start
        assert float((one.span[-1] - after.span[0]).norm()) == pytest.approx(12.0)
    assert len(cut_drive(straight(50.0), options=options)) == 1
    assert len(cut_drive(straight(51.0), options=options)) == 2


def test_lengths_are_metres():
    line, options = straight(300.0), DriveBlockOptions(length=70.0, overlap=16.0, reach=30.0)
    metres = cut_drive(line, options=options)
    units = cut_drive(line / 5, options=options, metres_per_unit=5.0)
    assert len(metres) == len(units) == 6
    points = torch.rand(200, 3, dtype=torch.float64) * 300
    torch.testing.assert_close(dense(metres, points), dense(units, points / 5))
    near = [d.near(d.blocks[1], p) for d, p in ((metres, points), (units, points / 5))]
    assert torch.equal(*near)


def test_reach_is_what_a_block_has():
    drive = cut_drive(straight(200.0), options=DriveBlockOptions(reach=30.0))
    first = drive.blocks[0]
    points = torch.tensor([[50.0, 29, 0], [50, 31, 0], [89, 0, 0], [91, 0, 0], [-29, 0, 0]])
    assert drive.near(first, points).tolist() == [True, False, True, False, True]
    one = cut_drive(straight(60.0), options=DriveBlockOptions(reach=30.0))
    assert one.near(one.blocks[0], points * 100).all()


def test_drives_far_apart_are_not_connected():
    """Two drives of 100 m, 300 m apart: no block lies between them, and none goes over."""
    places = torch.cat((straight(100.0), straight(100.0) + torch.tensor([400.0, 0, 0])))
    drive = cut_drive(places)
    assert [(b.start, b.end) for b in drive.blocks] == [(0, 50), (50, 100), (100, 150), (150, 200)]
    assert [float(b.span[-1, 0]) for b in drive.blocks] == [60.0, 100.0, 460.0, 500.0]
    assert drive.blocks[2].span[0].tolist() == [400.0, 0, 0]
    near = drive.shares(torch.tensor([[130.0, 0, 0], [390.0, 0, 0]]))
    assert [(s.block, s.rows.tolist(), s.weights.tolist()) for s in near] == [
        (1, [0], [1.0]), (2, [1], [1.0])
    ]  # fmt: skip
    bridged = cut_drive(places, options=DriveBlockOptions(length=320.0))
    assert bridged.blocks[-1].end == 500.0


def test_standing_still_makes_no_way(rng):
    """A car that waits for ten minutes: noise of centimetres adds up to nothing."""
    moving = straight(100.0)
    noise = torch.from_numpy(rng.normal(0, 0.05, size=(5000, 3)))
    waiting = torch.cat((moving[:50], moving[50] + noise, moving[51:]))
    assert cut_drive(waiting).blocks[-1].end == pytest.approx(100.0, abs=0.5)


def test_lines_are_straightened_within_tolerance():
    """A bend has a few corners, a straight road two, and no place is off by over 10 cm."""
    drive = cut_drive(LINES["straight"])
    assert all(len(block.piece) == 2 for block in drive.blocks)
    whole = cut_drive(bend(), options=DriveBlockOptions(length=1000.0))
    assert len(whole.blocks[0].piece) < 16
    off = min(0.0, *(-_distance(place, whole.blocks[0].piece) for place in bend()))
    assert -0.25 < off < 0


def _distance(point: torch.Tensor, line: torch.Tensor) -> float:
    t = torch.linspace(0, 1, 400, dtype=torch.float64)[:, None, None]
    places = (line[:-1] + t * (line[1:] - line[:-1])).reshape(-1, 3)
    return float((places - point).norm(dim=1).min())


def test_a_drive_of_one_place():
    drive = cut_drive(torch.zeros(1, 3))
    assert len(drive) == 1
    assert dense(drive, torch.tensor([[100.0, 0, 0]])).tolist() == [[1.0]]
    assert drive.block_of(torch.tensor([3.0, 4, 0])) == 0


def test_the_block_of_a_place_is_that_which_counts_most():
    drive = cut_drive(straight(200.0))
    assert [drive.block_of([x, 0, 0]) for x in (0.0, 49.9, 50.1, 199.0)] == [0, 0, 1, 3]
    assert drive.block_of([50.0, 0, 0]) == 0


@pytest.mark.parametrize(
    ("centres", "error", "words"),
    [
        (torch.zeros(0, 3), InputError, "centres: expected places along a drive, got none"),
        (torch.zeros(4, 2), ShapeError, "centres: expected shape"),
        (torch.tensor([[0.0, 0, math.nan]]), RangeError, "centres"),
    ],
)
def test_what_is_no_drive_is_refused(centres, error, words):
    with pytest.raises(error, match=words):
        cut_drive(centres)
    with pytest.raises(RangeError, match="metres_per_unit"):
        cut_drive(straight(10.0), metres_per_unit=0.0)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"length": 0.0}, "length: expected more than 0"),
        ({"overlap": math.nan}, "overlap: expected more than 0"),
        ({"reach": -1.0}, "reach: expected more than 0"),
        ({"length": 20.0, "overlap": 20.0}, "overlap: expected less than the length of 20 m"),
    ],
)
def test_blocks_without_length_are_refused(values, words):
    with pytest.raises(RangeError, match=words):
        DriveBlockOptions(**values)


def test_points_that_are_none_are_refused():
    drive = cut_drive(straight(10.0))
    with pytest.raises(ShapeError, match="points"):
        drive.shares(torch.zeros(4, 2))
    with pytest.raises(RangeError, match="points"):
        drive.near(drive.blocks[0], torch.tensor([[math.inf, 0, 0]]))
    assert drive.shares(torch.zeros(0, 3)) == ()
    assert len(drive.near(drive.blocks[0], torch.zeros(0, 3))) == 0


# The order of a drive's places, told from names.


def at(name: str, x: float) -> View:
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = -x
    camera = Camera(width=4, height=4, fx=4, fy=4, cx=2, cy=2, cam_from_world=pose)
    return View(name=name, camera=camera)


@pytest.mark.parametrize(
    "names",
    [
        ("train_0000_L", "train_0000_R", "train_0001_L", "train_0001_R"),
        (
            "image_00/0000000009",
            "image_01/0000000009",
            "image_00/0000000010",
            "image_01/0000000010",
        ),
        ("9", "9_2_a9", "10", "b10"),
    ],
)
def test_cameras_of_one_time_are_one_place(names):
    views = [at(name, x) for name, x in zip(names, (0.0, 1.0, 4.0, 6.0), strict=True)]
    assert frame_centres(views)[:, 0].tolist() == [0.5, 5.0]
    assert frame_centres(views[::-1])[:, 0].tolist() == [0.5, 5.0]


def test_numbers_are_counted_and_not_spelt():
    assert frame_centres([at("a10", 2.0), at("a9", 1.0)])[:, 0].tolist() == [1.0, 2.0]


def test_drives_whose_numbers_begin_again_follow_each_other():
    views = [at("b/1", 100.0), at("a/1", 0.0), at("a/2", 1.0), at("b/2", 101.0)]
    assert frame_centres(views)[:, 0].tolist() == [0.0, 1.0, 100.0, 101.0]


def test_a_rig_is_measured_in_metres():
    views = [at("a/1", 0.0), at("b/1", 1.0)]
    assert len(frame_centres(views)) == 1
    assert len(frame_centres(views, metres_per_unit=10.0)) == 2


def test_names_without_numbers_are_in_their_order():
    views = [at("c", 3.0), at("a", 1.0), at("b2", 2.0)]
    assert frame_centres(views)[:, 0].tolist() == [1.0, 2.0, 3.0]
    with pytest.raises(InputError, match="views: expected views along a drive"):
        frame_centres([])


def test_a_generated_drive_goes_forward(generated_drive):
    places = frame_centres(read_capture(generated_drive).train_views)
    assert len(places) == 10
    assert bool((places[1:, 0] > places[:-1, 0]).all())


def test_stereo_pairs_of_the_street(shared_data):
    places = frame_centres(read_capture(shared_data / "street").train_views)
    steps = (places[1:] - places[:-1]).norm(dim=1)
    assert len(places) == 60
    assert 0.7 < float(steps.min()) <= float(steps.max()) < 1.7


# What of a capture and of its scans is a block's.


def capture_along(places: torch.Tensor, tmp_path, points: PointCloud | None = None) -> Capture:
    views = []
    for i, place in enumerate(places):
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, 3] = -place
        camera = Camera(width=4, height=4, fx=4, fy=4, cx=2, cy=2, cam_from_world=pose)
        split = "test" if i % 10 == 4 else "train"
        views.append(View(name=f"{i:04d}", camera=camera, split=split))
    return Capture(path=tmp_path, format="nerfstudio", views=tuple(views), points=points)


def test_views_of_an_overlap_are_of_both_blocks(tmp_path):
    places = straight(200.0, step=2.0)
    capture, drive = capture_along(places, tmp_path), cut_drive(places)
    parts = [block_views(capture.views, drive, block) for block in drive.blocks]
    found = [[int(view.name) * 2 for view in part] for part in parts]
    # The overlap around 50 m is from 40 to 60, where weights reach 0.
    assert found[0] == list(range(0, 60, 2))
    assert found[1] == list(range(42, 110, 2))
    assert sorted({x for part in found for x in part}) == list(range(0, 201, 2))
    assert {view.split for view in parts[0]} == {"train", "test"}


def test_points_of_a_block_are_those_in_reach():
    x = torch.arange(-100.0, 300.0, 5.0)
    points, places = torch.stack((x, 0 * x, 0 * x), dim=1), straight(200.0)
    drive, far = cut_drive(places), cut_drive(places, options=DriveBlockOptions(reach=30.0))
    near = drive.near(drive.blocks[1], points)
    assert points[near, 0].tolist() == list(range(-20, 175, 5))
    near = far.near(far.blocks[1], points)
    assert points[near, 0].tolist() == list(range(10, 145, 5))


def test_a_drive_of_one_block_is_the_capture(generated_drive):
    capture = read_capture(generated_drive)
    drive = cut_drive(frame_centres(capture.train_views))
    assert block_views(capture.views, drive, drive.blocks[0]) == capture.views
    assert capture.points is not None
    assert drive.near(drive.blocks[0], capture.points.points).all()
    scans = read_scans(generated_drive)
    own, to_label = (
        f(drive.blocks[0]) for f in (DriveScans(scans, drive).of, DriveScans(scans, drive).to_label)
    )
    for source in (own, to_label):
        assert source.scan_names == scans.scan_names
        for name in scans.scan_names:
            here, there = source.scan(name), scans.scan(name)
            assert torch.equal(here.points, there.points)
            assert torch.equal(here.labels["semantic"], there.labels["semantic"])
            ids = torch.arange(len(there), dtype=torch.int32)
            assert torch.equal(here.recorded_labels(ids), there.recorded_labels(ids))


def test_a_block_without_training_views_is_refused(tmp_path):
    places = straight(200.0)
    capture, drive = capture_along(places, tmp_path), cut_drive(places)
    views = [replace(v, split="test") if int(v.name) > 85 else v for v in capture.views]
    with pytest.raises(InputError, match=r"blocks: .* block 2 of 4 has none; longer blocks"):
        block_views(views, drive, drive.blocks[2])


def test_scans_are_of_the_blocks_where_they_were_measured():
    places = torch.tensor([[5.0, 0, 0], [45, 0, 0], [55, 0, 0], [95, 0, 0]])
    drive = cut_drive(straight(100.0, step=0.5), options=DriveBlockOptions(reach=20.0))
    assert len(drive) == 2
    scans = DriveScans(NumberedScans(places, spread=40.0), drive)
    assert [tuple(scans.of(block).scan_names) for block in drive.blocks] == [
        ("0000", "0001", "0002"),
        ("0001", "0002", "0003"),
    ]
    for block in drive.blocks:
        for name in scans.of(block).scan_names:
            part, whole = scans.of(block).scan(name), scans.scan(name)
            kept = drive.near(block, whole.points)
            assert 0 < int(kept.sum()) < len(whole)
            assert torch.equal(part.points, whole.points[kept])
            assert torch.equal(part.labels["semantic"], whole.labels["semantic"][kept])


def test_clouds_without_a_place_are_of_all_blocks_that_have_their_points():
    class Clouds:
        scan_names = ("cloud",)

        def scan(self, name: str) -> Scan:
            return Scan(name=name, points=straight(120.0))

    drive = cut_drive(straight(300.0), options=DriveBlockOptions(reach=20.0))
    scans = DriveScans(Clouds(), drive)
    assert [len(scans.of(block).scan_names) for block in drive.blocks] == [1, 1, 1, 0, 0]


def test_points_to_label_are_those_where_a_block_counts():
    places = straight(200.0, step=10.0)
    source = NumberedScans(places)
    drive = cut_drive(straight(200.0))
    scans = DriveScans(source, drive)
    assert scans.scan_names == source.scan_names
    for block in drive.blocks:
        part = scans.to_label(block)
        for name in part.scan_names:
            whole = source.scan(name)
            counts = drive.counts(block, whole.points)
            assert torch.equal(part.scan(name).points, whole.points[counts])
            share = part.share(name)
            assert torch.equal(share.rows, torch.nonzero(counts)[:, 0])
        with pytest.raises(InputError, match="there is no 'none' in this block"):
            part.scan("none")
    labelled = {name: set(scans.labelled_by(name)) for name in scans.scan_names}
    assert labelled["0000"] == {0}
    assert {0, 1} <= labelled["0005"]
