"""Means over balls: against the reference, by hand, and what is refused."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from splatseg import _native
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.neighbours import NeighbourIndex, ball_means
from support import neighbours_reference as reference


def cloud(count: int, seed: int, lattice: bool) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    if lattice:  # many points in one place, many queries on points
        return torch.randint(-2, 3, (count, 3), generator=g).float()
    return torch.randn(count, 3, generator=g)


@pytest.mark.usefixtures("every_isa")
@given(
    count=st.integers(0, 200),
    queries=st.integers(0, 40),
    channels=st.integers(1, 19),
    seed=st.integers(0, 2**31),
    lattice=st.booleans(),
    radius=st.sampled_from([0.0, 0.3, 1.0, math.sqrt(2.0), 30.0, math.inf]),
)
def test_it_is_the_reference(
    count: int, queries: int, channels: int, seed: int, lattice: bool, radius: float
) -> None:
    points, asked = cloud(count, seed, lattice), cloud(queries, seed + 1, lattice)
    values = torch.randn(count, channels, generator=torch.Generator().manual_seed(seed))
    means, counts = ball_means(NeighbourIndex(points), values, asked, radius)
    want, want_counts = reference.ball_means(points, values, asked, radius)
    assert torch.equal(counts, want_counts)
    torch.testing.assert_close(means, want, rtol=1e-9, atol=1e-9)


def test_by_hand() -> None:
    """Weights 1 / 1 and 1 / 3 of two points on a line; the third is out of reach."""
    index = NeighbourIndex(torch.tensor([[0.0, 0, 0], [4, 0, 0], [9, 0, 0]]))
    values = torch.tensor([[1.0, 0], [0, 1], [5, 5]])
    means, counts = ball_means(index, values, torch.tensor([[1.0, 0, 0]]), 3.0)
    torch.testing.assert_close(means, torch.tensor([[0.75, 0.25]], dtype=torch.float64))
    assert counts.tolist() == [2]


def test_a_query_on_points_takes_their_mean() -> None:
    """However near others are, and wherever in the order they stand."""
    index = NeighbourIndex(torch.tensor([[1e-12, 0, 0], [0.0, 0, 0], [0, 0, 0], [1e-9, 0, 0]]))
    values = torch.tensor([[9.0], [1], [2], [9]])
    means, counts = ball_means(index, values, torch.zeros(1, 3), 1.0)
    assert means.tolist() == [[1.5]]
    assert counts.tolist() == [4]


def test_distances_beyond_float32_do_not_overflow() -> None:
    index = NeighbourIndex(torch.tensor([[1e-150, 0, 0], [1.0, 0, 0]], dtype=torch.float64))
    means, _ = ball_means(index, torch.tensor([[1.0], [0.0]]), torch.zeros(1, 3), 2.0)
    torch.testing.assert_close(means, torch.ones(1, 1, dtype=torch.float64))


@pytest.mark.bits
def test_any_number_of_threads_gives_the_same_bits() -> None:
    points, asked = cloud(3000, 1, False), cloud(2000, 2, False)
    values = torch.randn(3000, 5, generator=torch.Generator().manual_seed(3))
    index, before = NeighbourIndex(points), _native.threads()
    found: list[Tensor] = []
    try:
        for threads in (1, 2, 5):
            _native.set_threads(threads)
            found.append(ball_means(index, values, asked, 0.5)[0])
    finally:
        _native.set_threads(before)
    assert torch.equal(found[0], found[1])
    assert torch.equal(found[0], found[2])


def test_what_is_refused() -> None:
    index = NeighbourIndex(torch.zeros(2, 3))
    values, queries = torch.zeros(2, 4), torch.zeros(1, 3)
    with pytest.raises(ShapeError, match=r"^values: expected shape \(2, any\), got \(1, 4\)"):
        ball_means(index, values[:1], queries, 1.0)
    with pytest.raises(RangeError, match="^values: "):
        ball_means(index, values * math.nan, queries, 1.0)
    with pytest.raises(ShapeError, match="^queries: "):
        ball_means(index, values, torch.zeros(1, 2), 1.0)
    for bad in (math.nan, math.inf, 1e200):
        with pytest.raises(RangeError, match="^queries: "):
            ball_means(index, values, torch.full((1, 3), bad, dtype=torch.float64), 1.0)
    for radius in (-1.0, math.nan):
        with pytest.raises(RangeError, match="^radius: "):
            ball_means(index, values, queries, radius)
    with pytest.raises(InputError, match="^index: expected points of three columns, got 2"):
        ball_means(NeighbourIndex(torch.zeros(2, 2)), values, queries, 1.0)
