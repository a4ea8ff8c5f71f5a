"""Eq. 9: against ten lines, by hand, in any order, and what is refused."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from splatseg import _native
from splatseg.errors import RangeError, ShapeError
from splatseg.street.field import BallQuery
from street import reference


def field(count: int, classes: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Vertices, opacities and probabilities; some vertices in one place, some transparent."""
    g = torch.Generator().manual_seed(seed)
    vertices = torch.randn(count, 3, generator=g)
    vertices[: count // 8] = vertices[: count // 8].round()
    opacity = torch.rand(count, generator=g)
    opacity[::5] = 0
    return vertices, opacity, torch.rand(count, classes, generator=g).softmax(dim=1)


@given(
    count=st.integers(0, 150),
    classes=st.integers(1, 7),
    seed=st.integers(0, 2**31),
    radius=st.sampled_from([0.05, 0.4, 1.5, 50.0]),
)
def test_it_is_the_ten_lines(count: int, classes: int, seed: int, radius: float) -> None:
    vertices, opacity, probabilities = field(count, classes, seed)
    g = torch.Generator().manual_seed(seed + 1)
    points = torch.cat((torch.randn(20, 3, generator=g), vertices[:12]))
    query = BallQuery(vertices, opacity, probabilities, radius=radius)
    columns, shares = query.columns(points)
    want = reference.point_columns(vertices, opacity, probabilities, points, radius=radius)
    scores = query.scores(points).sort(dim=1, descending=True).values
    clear = (
        torch.ones(len(points), dtype=torch.bool)
        if classes == 1
        else (scores[:, 0] - scores[:, 1] > 1e-6 * scores[:, 0]) | (scores[:, 0] == 0)
    )
    assert torch.equal(columns[clear], want[clear])
    assert torch.equal(columns >= 0, want >= 0)
    assert bool((shares[columns < 0] == 0).all())
    assert bool((shares[columns >= 0] >= 1 / classes - 1e-5).all())


def test_by_hand() -> None:
    """Distances 1 and 2; the far vertex is three times as opaque and wins, 2/3 * .2 < 1/3 * .6."""
    vertices = torch.tensor([[0.0, 0, 0], [3, 0, 0]])
    query = BallQuery(vertices, torch.tensor([0.2, 0.6]), torch.eye(2), radius=2.0)
    point = torch.tensor([[1.0, 0, 0]])
    torch.testing.assert_close(query.scores(point), torch.tensor([[0.4 / 3, 0.6 / 3]]))
    columns, shares = query.columns(point)
    assert columns.tolist() == [1]
    torch.testing.assert_close(shares, torch.tensor([0.6]))


def test_a_point_on_a_vertex_takes_that_vertex() -> None:
    """Though all others, a hair away, are of another class."""
    vertices = torch.cat((torch.zeros(1, 3), torch.full((50, 3), 1e-6)))
    probabilities = torch.zeros(51, 2)
    probabilities[0, 0], probabilities[1:, 1] = 1, 1
    query = BallQuery(vertices, torch.ones(51), probabilities, radius=1.0)
    assert query.columns(torch.zeros(1, 3))[0].tolist() == [0]
    assert query.columns(torch.full((1, 3), 1e-7))[0].tolist() == [1]


def test_the_border_belongs_to_the_ball_and_beyond_it_nothing_is_said() -> None:
    query = BallQuery(torch.zeros(1, 3), torch.ones(1), torch.ones(1, 3), radius=0.5)
    columns, shares = query.columns(torch.tensor([[0.5, 0, 0], [0.5001, 0, 0]]))
    assert columns.tolist() == [0, -1]
    torch.testing.assert_close(shares, torch.tensor([1 / 3, 0.0]))


def test_where_nothing_is_opaque_nothing_is_said() -> None:
    query = BallQuery(torch.zeros(1, 3), torch.zeros(1), torch.ones(1, 3), radius=0.5)
    assert query.columns(torch.zeros(1, 3))[0].tolist() == [-1]


def test_the_order_of_points_and_of_vertices_does_not_matter() -> None:
    vertices, opacity, probabilities = field(2000, 5, 1)
    points = torch.randn(500, 3, generator=torch.Generator().manual_seed(2))
    query = BallQuery(vertices, opacity, probabilities, radius=0.5)
    scores, (columns, shares) = query.scores(points), query.columns(points)
    order = torch.randperm(500, generator=torch.Generator().manual_seed(3))
    assert torch.equal(query.scores(points[order]), scores[order])
    moved = query.columns(points[order])
    assert torch.equal(moved[0], columns[order])
    assert torch.equal(moved[1], shares[order])
    order = torch.randperm(2000, generator=torch.Generator().manual_seed(4))
    other = BallQuery(vertices[order], opacity[order], probabilities[order], radius=0.5)
    torch.testing.assert_close(other.scores(points), scores)
    assert torch.equal(other.columns(points)[0], columns)


@pytest.mark.bits
def test_blocks_and_threads_do_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, opacity, probabilities = field(3000, 4, 5)
    points = torch.randn(999, 3, generator=torch.Generator().manual_seed(6))
    query = BallQuery(vertices, opacity, probabilities, radius=0.4)
    want, before = query.columns(points), _native.threads()
    monkeypatch.setattr("splatseg.street.field._POINTS", 100)
    try:
        for threads in (1, 3):
            _native.set_threads(threads)
            found = query.columns(points)
            assert torch.equal(found[0], want[0])
            assert torch.equal(found[1], want[1])
    finally:
        _native.set_threads(before)


def test_without_classes_or_vertices_nothing_is_said() -> None:
    for count, classes in ((0, 3), (4, 0), (0, 0)):
        query = BallQuery(
            torch.zeros(count, 3), torch.ones(count), torch.ones(count, classes), radius=1.0
        )
        assert query.columns(torch.zeros(2, 3))[0].tolist() == [-1, -1]


def test_what_is_refused() -> None:
    vertices, opacity, probabilities = torch.zeros(2, 3), torch.ones(2), torch.ones(2, 3)
    with pytest.raises(ShapeError, match="^opacity: "):
        BallQuery(vertices, opacity[:1], probabilities, radius=1.0)
    with pytest.raises(ShapeError, match="^probabilities: "):
        BallQuery(vertices, opacity, probabilities[:1], radius=1.0)
    for bad in (math.nan, -0.1, 1.1):
        with pytest.raises(RangeError, match="^opacity: "):
            BallQuery(vertices, opacity * bad, probabilities, radius=1.0)
    for bad in (math.nan, math.inf, -1.0):
        with pytest.raises(RangeError, match="^probabilities: "):
            BallQuery(vertices, opacity, probabilities * bad, radius=1.0)
    for radius in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(RangeError, match="^radius: expected a positive length, got"):
            BallQuery(vertices, opacity, probabilities, radius=radius)
    query = BallQuery(vertices, opacity, probabilities, radius=1.0)
    with pytest.raises(ShapeError, match="^points: "):
        query.columns(torch.zeros(3, 2))
    with pytest.raises(RangeError, match="^points: "):
        query.columns(torch.full((1, 3), math.nan))
