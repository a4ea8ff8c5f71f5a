"""Small scenes whose answers are read off, and what the public boundary does."""

import math

import pytest
import torch

from splatseg.core import Gaussians
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.neighbours import NeighbourIndex

INF = math.inf
ROW = torch.tensor([[0.0], [1.0], [3.0], [3.0], [7.0]])


def test_on_a_line() -> None:
    found = NeighbourIndex(ROW).nearest(torch.tensor([[2.5], [-1.0]]), 3)
    assert found.indices.tolist() == [[2, 3, 1], [0, 1, 2]]
    assert found.distances.tolist() == [[0.5, 0.5, 1.5], [1.0, 2.0, 4.0]]
    assert found.indices.dtype == torch.int64
    assert found.distances.dtype == torch.float64
    assert len(found) == 2


def test_points_leave_themselves_out_by_index() -> None:
    """Rows 2 and 3 share a position: each finds the other at distance 0, never itself."""
    found = NeighbourIndex(ROW).nearest_others(2)
    assert found.indices.tolist() == [[1, 2], [0, 2], [3, 1], [2, 1], [2, 3]]
    assert found.distances.tolist() == [[1, 3], [1, 2], [0, 2], [0, 2], [4, 4]]
    some = NeighbourIndex(ROW).nearest_others(2, rows=torch.tensor([3, 3, 0]))
    assert some.indices.tolist() == [[2, 1], [2, 1], [1, 2]]


def test_equally_near_ones_come_by_index() -> None:
    square = torch.tensor([[1.0, 0], [0, 1], [-1, 0], [0, -1]])
    index = NeighbourIndex(square)
    assert index.nearest(torch.zeros(1, 2), 3).indices.tolist() == [[0, 1, 2]]
    assert index.nearest(torch.zeros(1, 2), 4).indices.tolist() == [[0, 1, 2, 3]]
    assert index.within(torch.zeros(1, 2), 1.0, max_neighbours=2).indices.tolist() == [0, 1]


def test_a_radius_includes_its_border() -> None:
    index = NeighbourIndex(ROW)
    lists = index.within(torch.tensor([[1.0], [5.0], [100.0]]), 2.0)
    assert lists.starts.tolist() == [0, 4, 7, 7]
    assert lists.indices.tolist() == [1, 0, 2, 3, 2, 3, 4]
    assert lists.distances.tolist() == [0, 1, 2, 2, 2, 2, 2]
    assert lists.counts.tolist() == [4, 3, 0]
    assert lists.queries.tolist() == [0, 0, 0, 0, 1, 1, 1]
    assert len(lists) == 3
    assert index.count_within(torch.tensor([[1.0], [5.0], [100.0]]), 2.0).tolist() == [4, 3, 0]
    found = index.nearest(torch.tensor([[1.0]]), 5, max_distance=1.0)
    assert found.indices.tolist() == [[1, 0, -1, -1, -1]]
    assert found.distances.tolist() == [[0, 1, INF, INF, INF]]


@pytest.mark.parametrize("count", [0, 1])
def test_hardly_any_points(count: int) -> None:
    index = NeighbourIndex(torch.zeros(count, 3))
    assert len(index) == count
    assert index.nearest_others(2).indices.tolist() == [[-1, -1]] * count
    assert index.nearest_others(2).distances.tolist() == [[INF, INF]] * count
    asked = index.nearest(torch.ones(2, 3), 2)
    assert asked.indices.tolist() == [[0, -1] if count else [-1, -1]] * 2
    assert index.within(torch.ones(2, 3), 5.0).counts.tolist() == [count] * 2
    assert index.count_within(torch.ones(2, 3), 5.0).tolist() == [count] * 2


def test_no_queries() -> None:
    index = NeighbourIndex(ROW)
    assert index.nearest(torch.zeros(0, 1), 3).indices.shape == (0, 3)
    assert index.within(torch.zeros(0, 1), 3.0).starts.tolist() == [0]
    nobody = torch.zeros(0, dtype=torch.int64)
    assert index.nearest_others(3, rows=nobody).indices.shape == (0, 3)


def test_centres_of_gaussians() -> None:
    gaussians = Gaussians(
        means=torch.tensor([[0.0, 0, 0], [0, 3, 4]], requires_grad=True),
        rotations=torch.eye(4)[:1].expand(2, 4),
        scales=torch.ones(2, 3),
        opacities=torch.ones(2),
        sh=torch.zeros(2, 1, 3),
    )
    index = NeighbourIndex(gaussians)
    assert index.dimensions == 3
    assert index.nearest_others(1).distances.tolist() == [[5.0], [5.0]]


def test_points_are_copied() -> None:
    """Also float64 ones, which need no conversion."""
    points = torch.tensor([[0.0], [1.0]], dtype=torch.float64)
    index = NeighbourIndex(points)
    points[1] = 50.0
    assert index.nearest_others(1).distances.tolist() == [[1.0], [1.0]]
    assert index.nbytes > 0


def test_narrow_types_and_views_are_as_good_as_float64() -> None:
    points = torch.randn(200, 6, generator=torch.Generator().manual_seed(0)).half()[::2, 1:4]
    found = NeighbourIndex(points).nearest(points, 4)
    wide = points.double().contiguous()
    assert torch.equal(found.indices, NeighbourIndex(wide).nearest(wide, 4).indices)


@pytest.mark.parametrize("bad", [math.nan, INF, -INF])
def test_what_is_not_finite_is_refused(bad: float) -> None:
    points = torch.zeros(20, 3)
    points[7, 1] = bad
    with pytest.raises(RangeError, match=r"points: 1 of 60 values are not finite; .* \(7, 1\)"):
        NeighbourIndex(points)
    index = NeighbourIndex(torch.zeros(20, 3))
    with pytest.raises(RangeError, match=r"queries: 1 of 60 values are not finite"):
        index.nearest(points, 1)
    with pytest.raises(RangeError, match=r"queries: 1 of 60"):
        index.within(points, 1.0)
    with pytest.raises(RangeError, match=r"queries: 1 of 60"):
        index.count_within(points, 1.0)


def test_arguments_are_checked() -> None:
    index = NeighbourIndex(ROW)
    with pytest.raises(ShapeError, match=r"points: expected shape \(any, any\), got \(5,\)"):
        NeighbourIndex(torch.zeros(5))
    with pytest.raises(ShapeError, match="points: expected shape"):
        NeighbourIndex(torch.zeros(5, 9))
    with pytest.raises(ShapeError, match="points: expected shape"):
        NeighbourIndex(torch.zeros(5, 0))
    with pytest.raises(InputError, match="points: expected .*, got a tensor torch.complex64"):
        NeighbourIndex(torch.zeros(5, 3, dtype=torch.complex64))
    with pytest.raises(RangeError, match="points: expected values in"):
        NeighbourIndex(torch.full((1, 1), 2e150, dtype=torch.float64))
    with pytest.raises(ShapeError, match=r"queries: expected shape \(any, 1\), got \(2, 3\)"):
        index.nearest(torch.zeros(2, 3), 1)
    with pytest.raises(RangeError, match="k: expected at least 1, got 0"):
        index.nearest(ROW, 0)
    with pytest.raises(RangeError, match="max_distance: expected a distance of at least 0, got -1"):
        index.nearest_others(1, max_distance=-1.0)
    with pytest.raises(RangeError, match="radius: expected a distance of at least 0, got nan"):
        index.within(ROW, math.nan)
    with pytest.raises(RangeError, match="max_neighbours: expected at least 1, got 0"):
        index.within(ROW, 1.0, max_neighbours=0)
    with pytest.raises(RangeError, match=r"rows: expected indices in \[0, 5\), got \[-1, 4\]"):
        index.nearest_others(1, rows=torch.tensor([4, -1]))
    with pytest.raises(RangeError, match=r"rows: expected indices in \[0, 5\), got \[5, 5\]"):
        index.nearest_others(1, rows=torch.tensor([5]))
    with pytest.raises(InputError, match="rows: expected integers, got torch.bool"):
        index.nearest_others(1, rows=torch.ones(5, dtype=torch.bool))
    with pytest.raises(ShapeError, match="rows: expected shape"):
        index.nearest_others(1, rows=torch.zeros(1, 1, dtype=torch.int64))


def test_too_many_pairs_are_refused_before_they_are_made() -> None:
    points = torch.zeros(100, 3)
    index = NeighbourIndex(points)
    with pytest.raises(InputError, match=r"at most 9999 pairs .* got 10000 within 1"):
        index.within(points, 1.0, max_pairs=9999)
    assert len(index.within(points, 1.0, max_pairs=10000).indices) == 10000
    assert len(index.within(points, 1.0, max_pairs=200, max_neighbours=2).indices) == 200
    with pytest.raises(InputError, match="max_pairs"):
        index.within(torch.zeros(2, 3), 1.0, max_pairs=199)
