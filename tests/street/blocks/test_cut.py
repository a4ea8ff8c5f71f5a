"""Drives are cut into equal blocks, and blocks count by what is near to them."""

import itertools
import math

import pytest
import torch

from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.street.blocks import DriveBlockOptions, DriveBlocks, cut_drive
from street.blocks.support import bend, crossing, straight


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
        ({"length": 0.0}, "length: expected a positive"),
        ({"overlap": math.nan}, "overlap: expected a positive"),
        ({"reach": -1.0}, "reach: expected a positive"),
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
