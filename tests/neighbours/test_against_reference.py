"""The native search finds what comparing with every point finds, to the bit."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from splatseg.neighbours import NeighbourIndex, NeighbourLists, Neighbours
from support import neighbours_reference as reference

SHAPES = ("uniform", "lattice", "clusters", "line", "shells", "doubles")


def cloud(shape: str, count: int, dimensions: int, seed: int) -> Tensor:
    """Points that are hard in one way or another; many are equal or equally far."""
    g = torch.Generator().manual_seed(seed)
    normal = torch.randn(count, dimensions, generator=g, dtype=torch.float64)
    if shape == "lattice":
        return torch.randint(-2, 3, (count, dimensions), generator=g).float()
    if shape == "clusters":
        sizes = 10.0 ** torch.randint(-8, 4, (count, 1), generator=g)
        return (normal.round() * 100 + normal * sizes).float()
    if shape == "line":
        return (torch.linspace(-1e30, 1e30, max(count, 1))[:count, None]).repeat(1, dimensions)
    if shape == "shells":
        return normal / normal.norm(dim=1, keepdim=True).clamp_min(1e-9)
    if shape == "doubles":
        return normal[torch.randint(0, max(1, count // 5), (count,), generator=g)]
    return normal.float()


def assert_same_neighbours(got: Neighbours, want: Neighbours) -> None:
    assert torch.equal(got.indices, want.indices)
    assert torch.equal(got.distances, want.distances)


def assert_same_lists(got: NeighbourLists, want: NeighbourLists) -> None:
    assert torch.equal(got.starts, want.starts)
    assert torch.equal(got.indices, want.indices)
    assert torch.equal(got.distances, want.distances)


clouds = st.builds(
    cloud,
    st.sampled_from(SHAPES),
    st.integers(0, 400),
    st.integers(1, 8),
    st.integers(0, 2**31),
)
reaches = st.sampled_from([0.0, 1e-9, 0.3, 1.0, math.sqrt(2.0), 2.0, 1e29, math.inf])


def queries_for(points: Tensor, seed: int) -> Tensor:
    """Some of the points, places between them, and places far away."""
    g = torch.Generator().manual_seed(seed)
    if not len(points):
        return torch.randn(5, points.shape[1], generator=g)
    some = points[torch.randint(0, len(points), (20,), generator=g)].double()
    between = (some + some.roll(1, 0)) / 2
    far = some + 1e6 * torch.randn(some.shape, generator=g)
    return torch.cat((some, between, far))


@pytest.mark.usefixtures("every_isa")
@given(points=clouds, seed=st.integers(0, 99), k=st.integers(1, 60), reach=reaches)
def test_nearest(points: Tensor, seed: int, k: int, reach: float) -> None:
    queries = queries_for(points, seed)
    got = NeighbourIndex(points).nearest(queries, k, max_distance=reach)
    assert_same_neighbours(got, reference.nearest(points, queries, k, max_distance=reach))


@pytest.mark.usefixtures("every_isa")
@given(points=clouds, k=st.integers(1, 60), reach=reaches)
def test_nearest_others(points: Tensor, k: int, reach: float) -> None:
    got = NeighbourIndex(points).nearest_others(k, max_distance=reach)
    own = torch.arange(len(points))
    want = reference.nearest(points, points, k, max_distance=reach, own=own)
    assert_same_neighbours(got, want)


@given(points=clouds, k=st.integers(1, 20), seed=st.integers(0, 99))
def test_nearest_others_of_some_rows(points: Tensor, k: int, seed: int) -> None:
    g = torch.Generator().manual_seed(seed)
    rows = torch.randint(0, max(1, len(points)), (30 if len(points) else 0,), generator=g)
    got = NeighbourIndex(points).nearest_others(k, rows=rows)
    assert_same_neighbours(got, reference.nearest(points, points[rows], k, own=rows))


@pytest.mark.usefixtures("every_isa")
@given(
    points=clouds,
    seed=st.integers(0, 99),
    reach=reaches,
    most=st.one_of(st.none(), st.integers(1, 12)),
)
def test_within(points: Tensor, seed: int, reach: float, most: int | None) -> None:
    queries = queries_for(points, seed)
    index = NeighbourIndex(points)
    got = index.within(queries, reach, max_neighbours=most)
    assert_same_lists(got, reference.within(points, queries, reach, max_neighbours=most))
    everything = reference.within(points, queries, reach)
    assert torch.equal(index.count_within(queries, reach), everything.counts)


@pytest.mark.usefixtures("every_isa")
@pytest.mark.parametrize("shape", SHAPES)
def test_some_thousands_of_points(shape: str) -> None:
    """Several levels of nodes, several threads' worth of queries."""
    points = cloud(shape, 5000, 3, seed=1)
    index = NeighbourIndex(points)
    rows = torch.arange(0, 5000, 7)
    want = reference.nearest(points, points[rows], 33, own=rows)
    assert_same_neighbours(index.nearest_others(33, rows=rows), want)
    whole = index.nearest_others(33)
    assert torch.equal(whole.indices[rows], want.indices)
    queries = queries_for(points, 3)
    assert_same_neighbours(index.nearest(queries, 5), reference.nearest(points, queries, 5))


def test_the_reference_is_the_definition() -> None:
    """Distances by `torch.cdist`, order by sorting pairs of distance and index in Python."""
    points = cloud("lattice", 60, 3, seed=2)
    found = reference.nearest(points, points, 7)
    far = torch.cdist(points.double(), points.double(), compute_mode="donot_use_mm_for_euclid_dist")
    for query in range(60):
        pairs = sorted((round(float(d), 9), i) for i, d in enumerate(far[query]))
        assert found.indices[query].tolist() == [i for _, i in pairs[:7]]
    lists = reference.within(points, points, 1.0)
    assert torch.equal(lists.counts, (far <= 1.0 + 1e-9).sum(dim=1))
