"""Subsets of an index: against the reference, by hand, and what is refused."""

import math
from functools import cache

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from splatseg import _native
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.neighbours import NeighbourIndex, Subset
from support import neighbours_reference as reference

SHAPES = ("uniform", "lattice", "clusters", "line", "doubles", "strays")


def cloud(shape: str, count: int, seed: int) -> Tensor:
    """Points that are hard in one way or another."""
    g = torch.Generator().manual_seed(seed)
    normal = torch.randn(count, 3, generator=g)
    if shape == "lattice":
        return torch.randint(-3, 4, (count, 3), generator=g).float()
    if shape == "clusters":
        return normal.round() * 100 + normal * 10.0 ** torch.randint(-6, 3, (count, 1), generator=g)
    if shape == "line":
        return torch.linspace(-1e9, 1e9, max(count, 1))[:count, None].repeat(1, 3)
    if shape == "doubles":
        return normal[torch.randint(0, max(1, count // 9), (count,), generator=g)]
    if shape == "strays":
        far = torch.rand(count, 1, generator=g) < 0.02
        return torch.where(far, normal * 1000, normal)
    return normal


def some(count: int, share: float, seed: int) -> Tensor:
    return torch.rand(count, generator=torch.Generator().manual_seed(seed)) < share


clouds = st.builds(cloud, st.sampled_from(SHAPES), st.integers(0, 300), st.integers(0, 2**31))
shares = st.sampled_from([0.0, 0.05, 0.5, 1.0])
radii = st.sampled_from([0.0, 1e-3, 0.3, 1.0, math.sqrt(2.0), 30.0, 2e9, math.inf])
seeds = st.integers(0, 99)


@pytest.mark.usefixtures("every_isa")
@given(points=clouds, share=shares, seed=seeds, k=st.integers(1, 90))
def test_mean_distances(points: Tensor, share: float, seed: int, k: int) -> None:
    members = some(len(points), share, seed)
    got = Subset(NeighbourIndex(points), members).mean_distances(k)
    want = reference.mean_distances(points, members, k)
    assert torch.equal(got.isnan(), ~members)
    torch.testing.assert_close(got.double(), want, rtol=1e-6, atol=0, equal_nan=True)


@pytest.mark.usefixtures("every_isa")
@given(points=clouds, share=shares, seed=seeds, radius=radii)
def test_near(points: Tensor, share: float, seed: int, radius: float) -> None:
    members, among = some(len(points), share, seed), some(len(points), 0.5, seed + 1)
    subset = Subset(NeighbourIndex(points), members)
    assert torch.equal(subset.near(radius), reference.near(points, members, radius))
    want = reference.near(points, members, radius, among=among)
    assert torch.equal(subset.near(radius, among=among), want)


@pytest.mark.usefixtures("every_isa")
@given(points=clouds, share=shares, seed=seeds, radius=radii)
def test_connected(points: Tensor, share: float, seed: int, radius: float) -> None:
    members, start = some(len(points), share, seed), some(len(points), 0.02, seed + 1)
    got = Subset(NeighbourIndex(points), members).connected(start, radius)
    assert torch.equal(got, reference.connected(points, members, start, radius))


@cache
def expected(shape: str) -> tuple[Tensor, list[Tensor], float, Tensor, Tensor]:
    """Of `test_some_thousands_of_points`: once for all instruction sets, the reference is slow."""
    points, members, start = cloud(shape, 4000, 1), some(4000, 0.7, 2), some(4000, 0.005, 3)
    distances = [reference.mean_distances(points, members, k) for k in (1, 32)]
    radius = float(distances[0][members].quantile(0.9))
    near = reference.near(points, members, radius)
    return points, distances, radius, near, reference.connected(points, members, start, radius)


@pytest.mark.usefixtures("every_isa")
@pytest.mark.parametrize("shape", SHAPES)
def test_some_thousands_of_points(shape: str) -> None:
    """Several levels of nodes, strays that look for their own neighbours, several threads."""
    points, distances, radius, near, connected = expected(shape)
    subset = Subset(NeighbourIndex(points), some(4000, 0.7, 2))
    for k, want in zip((1, 32), distances, strict=True):
        got = subset.mean_distances(k).double()
        torch.testing.assert_close(got, want, rtol=1e-6, atol=0, equal_nan=True)
    assert torch.equal(subset.near(radius), near)
    assert torch.equal(subset.connected(some(4000, 0.005, 3), radius), connected)


def test_a_radius_is_decided_as_the_index_decides_it() -> None:
    """Pairs whose distance is the radius, and the next float64 below."""
    points = cloud("uniform", 600, 4)
    index = NeighbourIndex(points)
    members = some(600, 0.3, 5)
    subset = Subset(index, members)
    for distance in index.nearest(points[members], 20).distances[:15, 1:].reshape(-1).tolist():
        for radius in (distance, math.nextafter(distance, 0), math.nextafter(distance, 9)):
            near = index.within(points[members], radius).indices
            want = members.clone()
            want[near] = True
            assert torch.equal(subset.near(radius), want)


@pytest.mark.bits
@pytest.mark.parametrize("threads", [1, 2, 5])
def test_threads_do_not_matter(threads: int) -> None:
    points = cloud("strays", 20_000, 6)
    members = some(20_000, 0.5, 7)
    subset = Subset(NeighbourIndex(points), members)
    start = some(20_000, 0.001, 8)
    before = _native.threads()
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    try:
        for count in (1, threads):
            _native.set_threads(count)
            one = Subset(NeighbourIndex(points), members)
            found.append(
                (one.mean_distances(16)[members], one.near(0.1), one.connected(start, 0.15))
            )
    finally:
        _native.set_threads(before)
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))
    assert len(subset) == int(members.sum())


def test_a_chain_by_hand() -> None:
    """Steps of one, a gap of two, and a point that is no member in the gap."""
    points = torch.tensor([[float(x), 0, 0] for x in (0, 1, 2, 3, 4, 5)])
    members = torch.tensor([True, True, True, False, True, True])
    subset = Subset(NeighbourIndex(points), members)
    first = torch.tensor([True, False, False, True, False, False])
    assert subset.connected(first, 1.0).tolist() == [True, True, True, False, False, False]
    assert subset.connected(first, 2.0).tolist() == members.tolist()
    assert subset.connected(~members, 9.0).tolist() == [False] * 6
    assert subset.near(0.99).tolist() == members.tolist()
    assert subset.near(1.0).all()
    assert subset.mean_distances(1)[members].tolist() == [1, 1, 1, 1, 1]
    assert subset.mean_distances(99)[members].tolist() == [3, 2.25, 2, 2.5, 3.25]


def test_nobody_and_one() -> None:
    points = cloud("uniform", 50, 9)
    index = NeighbourIndex(points)
    nobody = torch.zeros(50, dtype=torch.bool)
    assert Subset(index, nobody).mean_distances(3).isnan().all()
    assert not Subset(index, nobody).near(math.inf).any()
    one = nobody.clone()
    one[7] = True
    assert Subset(index, one).mean_distances(3)[7] == 0
    assert Subset(index, one).near(0.0).sum() == 1
    assert Subset(index, one).near(math.inf).all()


@pytest.mark.parametrize(
    ("points", "error", "words"),
    [
        (torch.zeros(4, 2), InputError, "three columns of float32, got 2"),
        (torch.zeros(4, 3, dtype=torch.float64), InputError, "got 3 of float64"),
        (torch.full((4, 3), 2e18), RangeError, "at most 1e\\+18"),
    ],
)
def test_indices_that_are_refused(points: Tensor, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        Subset(NeighbourIndex(points), torch.ones(4, dtype=torch.bool))


def test_arguments_that_are_refused() -> None:
    index = NeighbourIndex(torch.zeros(4, 3))
    four, five = torch.ones(4, dtype=torch.bool), torch.ones(5, dtype=torch.bool)
    with pytest.raises(ShapeError, match="members: expected shape"):
        Subset(index, five)
    subset = Subset(index, four)
    with pytest.raises(RangeError, match="k: expected at least 1"):
        subset.mean_distances(0)
    for radius in (-1.0, math.nan):
        with pytest.raises(RangeError, match="radius"):
            subset.near(radius)
        with pytest.raises(RangeError, match="radius"):
            subset.connected(four, radius)
    with pytest.raises(ShapeError, match="among"):
        subset.near(1.0, among=five)
    with pytest.raises(ShapeError, match="seeds"):
        subset.connected(five, 1.0)
