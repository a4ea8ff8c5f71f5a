"""Cells of a plan: where they are cut, that they tile space, and how far neighbours overlap."""

import math

import pytest
import torch

from splatseg.core.partition import Cells, Gap, cut_plan, owners, plan_axes
from splatseg.errors import InputError, RangeError, ShapeError

UP = (0.0, 0.0, 1.0)


def two_cells(overlap: float = 2.0) -> Cells:
    """Left and right of x = 0."""
    low = torch.tensor([[-math.inf, -math.inf], [0.0, -math.inf]]).double()
    high = torch.tensor([[0.0, math.inf], [math.inf, math.inf]]).double()
    return Cells(axes=torch.eye(3)[:2].double(), low=low, high=high, overlap=overlap)


def grid(columns: int, rows: int, *, step: float = 1.0) -> torch.Tensor:
    """Cameras in a grid, at height 1."""
    x, y = torch.meshgrid(torch.arange(columns), torch.arange(rows), indexing="ij")
    return step * torch.stack((x, y, torch.ones_like(x)), dim=-1).reshape(-1, 3).double()


@pytest.mark.parametrize("count", [1, 2, 3, 5, 8, 13])
def test_every_point_is_in_exactly_one_cell(count, rng):
    cameras = torch.from_numpy(rng.normal(size=(60, 3))) * torch.tensor([3.0, 2.0, 0.2])
    cells = cut_plan(cameras, count, up=UP)
    assert len(cells) == count
    points = 10 * torch.from_numpy(rng.normal(size=(500, 3)))
    points[:60] = cameras
    plan = points @ cells.axes.T
    inside = (plan >= cells.low[:, None]) & (plan < cells.high[:, None])
    inside = inside.all(dim=-1)
    assert inside.sum(dim=0).tolist() == [1] * len(points)
    assert torch.equal(cells.cell_of(points), inside.int().argmax(dim=0))
    counts = torch.bincount(cells.cell_of(cameras), minlength=count)
    assert int(counts.min()) >= 1
    assert int(counts.max() - counts.min()) <= 60 * 0.2 * math.log2(count) + 1


def test_a_point_on_a_border_is_of_the_first_cell_alone():
    cells = two_cells()
    assert cells.cell_of(torch.tensor([[-1e-12, 5, 5], [0, 0, 0], [1e-12, 0, 9]])).tolist() == [
        0,
        0,
        1,
    ]


def test_weights_go_linearly_over_the_overlap():
    cells = two_cells(overlap=2.0)
    x = torch.tensor([-1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5])
    points = torch.stack((x, 7 * x, -x), dim=1)
    found = torch.zeros(2, len(x), dtype=torch.float64)
    for share in cells.shares(points):
        found[share.block, share.rows] = share.weights
    assert found[1].tolist() == [0, 0, 0.25, 0.5, 0.75, 1, 1]
    assert torch.equal(found.sum(dim=0), torch.ones(len(x)).double())
    regions = cells.regions(points)
    assert regions.tolist() == [[1, 1, 1, 1, 1, 0, 0], [0, 0, 1, 1, 1, 1, 1]]
    assert torch.equal(owners(cells.shares(points), len(x)), (x > 0).long())


@pytest.mark.parametrize(("wide", "expected"), [(12, [12, 8]), (14, [10, 10])])
def test_a_plan_is_cut_between_rooms_if_halves_stay_nearly_equal(wide, expected):
    """Twenty cameras in a row with a wide gap: no more than a tenth of them beyond the median."""
    x = 0.1 * torch.arange(20.0)
    x[10:] += 0.5
    x[wide:] += 3.0
    cameras = torch.stack((x, 0 * x, 0 * x), dim=1)
    cells = cut_plan(cameras, 2, up=UP)
    assert torch.bincount(cells.cell_of(cameras)).tolist() == expected
    at = expected[0]
    assert float(cells.high[0, 0]) == pytest.approx(float(x[at - 1] + x[at]) / 2)


def test_where_in_a_gap_the_border_is_can_be_said():
    cameras = grid(4, 1, step=2.0)
    heard: list[Gap] = []

    def border(gap: Gap) -> float:
        heard.append(gap)
        return gap.first + 0.25

    cells = cut_plan(cameras, 4, up=UP, border=border)
    assert cells.high[:, 0].tolist() == [0.25, 2.25, 4.25, math.inf]
    assert [(gap.first, gap.last) for gap in heard] == [(2, 4), (0, 2), (4, 6)]
    assert [gap.before.tolist() for gap in heard] == [[0, 1], [0], [2]]
    assert [gap.behind.tolist() for gap in heard] == [[2, 3], [1], [3]]
    assert heard[0].direction.tolist() == [1, 0, 0]


def test_the_longer_side_is_cut_first_and_parts_are_of_equal_weight():
    cameras = grid(8, 3)
    cells = cut_plan(cameras, 2, up=UP)
    assert cells.high[0].tolist() == [3.5, math.inf]
    thirds = cut_plan(grid(9, 2), 3, up=UP)
    assert torch.bincount(thirds.cell_of(grid(9, 2))).tolist() == [6, 6, 6]


def test_the_overlap_is_a_fifth_of_the_side_of_a_square_cell():
    assert cut_plan(grid(9, 5), 2, up=UP).overlap == pytest.approx(0.2 * math.sqrt(8 * 4 / 2))
    line = grid(9, 1)
    assert cut_plan(line, 2, up=UP).overlap == pytest.approx(0.2 * 4)
    assert cut_plan(line[:1], 1, up=UP).overlap > 0


def test_the_plan_is_level_and_lies_along_the_building(rng):
    turn = math.radians(33)
    flat = torch.tensor([[math.cos(turn), math.sin(turn), 0], [-math.sin(turn), math.cos(turn), 0]])
    cameras = grid(7, 4)[:, :2] @ flat.double()
    axes = plan_axes(cameras, UP)
    torch.testing.assert_close(axes @ axes.T, torch.eye(2).double())
    torch.testing.assert_close(axes[:, 2], torch.zeros(2).double())
    assert float((axes @ flat.double().T).abs().amax(dim=1).min()) > 1 - 1e-7
    # Without an up axis it is the plane in which the cameras are.
    tilted = cameras @ torch.linalg.qr(torch.from_numpy(rng.normal(size=(3, 3)))).Q
    axes = plan_axes(tilted)
    assert float((axes @ torch.linalg.svd(tilted - tilted.mean(0)).Vh[2]).abs().max()) < 1e-9


def test_up_is_what_no_cell_is_cut_across():
    tower = torch.stack((torch.zeros(20), 0.01 * torch.arange(20), torch.arange(20)), 1).double()
    cells = cut_plan(tower, 2, up=UP)
    assert float(cells.axes[:, 2].abs().max()) == 0
    assert float(cut_plan(tower, 2, up=(1, 0, 0)).axes[:, 2].abs().max()) > 0.9


def test_what_cannot_be_cut_is_refused():
    with pytest.raises(InputError, match="expected 1 to 3, as many as cameras, got 4"):
        cut_plan(grid(3, 1), 4)
    with pytest.raises(InputError, match="expected 1 to 3"):
        cut_plan(grid(3, 1), 0)
    with pytest.raises(InputError, match=r"4 in one place cannot be parted into 2\.$"):
        cut_plan(torch.zeros(4, 3), 2, up=UP)
    with pytest.raises(RangeError, match="centres"):
        cut_plan(torch.tensor([[math.nan, 0, 0]]), 1)
    with pytest.raises(RangeError, match="points"):
        two_cells().cell_of(torch.tensor([[math.inf, 0, 0]]))
    with pytest.raises(ShapeError, match="points"):
        two_cells().regions(torch.zeros(3, 2))
    with pytest.raises(InputError, match="at least one cell"):
        Cells(axes=torch.eye(3)[:2], low=torch.zeros(0, 2), high=torch.zeros(0, 2), overlap=1.0)


def test_the_record_is_what_json_holds():
    assert two_cells(overlap=0.5).record() == {
        "axes": [[1, 0, 0], [0, 1, 0]],
        "low": [[None, None], [0, None]],
        "high": [[0, None], [None, None]],
        "overlap": 0.5,
    }
