"""Statistical filtering and growing: by hand, every option, and section 3.5 as a whole."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from splatseg.errors import RangeError
from splatseg.neighbours import NeighbourIndex, reference
from splatseg.prompting.pipeline import (
    FilterOptions,
    GrowOptions,
    ball_grow,
    growth_radius,
    neighbour_count,
    region_grow,
    statistical_filter,
)


def on_a_line(*places: float) -> Tensor:
    return torch.tensor([[x, 0.0, 0.0] for x in places])


def blob(strays: int = 0) -> Tensor:
    """A ball of 400 points, and strays far from it and each other."""
    g = torch.Generator().manual_seed(0)
    ball = torch.randn(400, 3, generator=g) * 0.1
    far = torch.randn(strays, 3, generator=g)
    return torch.cat((ball, 20 * far / far.norm(dim=1, keepdim=True)))


def everyone(points: Tensor) -> Tensor:
    return torch.ones(len(points), dtype=torch.bool)


def test_the_filter_is_its_equation() -> None:
    points = blob(strays=5)
    members = everyone(points)
    members[::3] = False
    k = neighbour_count(int(members.sum()), None)
    means = reference.mean_distances(points, members, k)
    mu, sigma = means[members].mean(), means[members].std(correction=0)
    want = members & (means <= mu + sigma)
    got = statistical_filter(NeighbourIndex(points), members, FilterOptions.published())
    assert torch.equal(got, want)
    assert not got[400:].any()


def test_equal_distances_all_stay() -> None:
    """Corners of a cube: no spread, and nobody above the mean by rounding."""
    cube = torch.cartesian_prod(*(torch.tensor([0.0, 0.1]),) * 3)
    assert statistical_filter(NeighbourIndex(cube), everyone(cube)).all()


@pytest.mark.parametrize("count", [0, 1, 2])
def test_two_or_fewer_stay(count: int) -> None:
    points = on_a_line(0, 5, 9)
    members = torch.arange(3) < count
    assert torch.equal(statistical_filter(NeighbourIndex(points), members), members)


def test_deviations() -> None:
    points = blob()
    index, members = NeighbourIndex(points), everyone(points)
    kept = [
        int(statistical_filter(index, members, FilterOptions(deviations=d)).sum())
        for d in (0.0, 1.0, 100.0)
    ]
    assert kept[0] < kept[1] < kept[2] == 400


def test_repeats_and_their_end() -> None:
    points = blob(strays=5)
    index, members = NeighbourIndex(points), everyone(points)
    once = statistical_filter(index, members)
    twice = statistical_filter(index, members, FilterOptions(repeats=2))
    assert torch.equal(twice, statistical_filter(index, once))
    assert int(twice.sum()) < int(once.sum())
    # Without the strays distances differ by less than this.
    ended = statistical_filter(index, members, FilterOptions(repeats=5, min_deviation=0.1))
    assert torch.equal(ended, once)


def test_max_neighbours() -> None:
    """A clump of four far away: with 3 neighbours it is dense, with 20 it is not."""
    points = torch.cat((blob(), 30 + 0.001 * torch.eye(4, 3)))
    index, members = NeighbourIndex(points), everyone(points)
    assert statistical_filter(index, members, FilterOptions(max_neighbours=3))[400:].all()
    assert not statistical_filter(index, members, FilterOptions.published())[400:].any()
    assert neighbour_count(464_000, None) == 681
    assert neighbour_count(464_000, 32) == 32
    assert neighbour_count(9, 32) == 3


def test_the_radius_is_a_quantile() -> None:
    """Nearest distances 1, 1, 2, 4 (in this order of size)."""
    points = on_a_line(0, 1, 3, 7)
    index = NeighbourIndex(points)
    for quantile, want in ((0.0, 1), (0.5, 1), (0.51, 2), (0.75, 2), (0.76, 4), (1.0, 4)):
        got = growth_radius(index, everyone(points), GrowOptions(radius_quantile=quantile))
        assert got == pytest.approx(want, rel=2e-6)
        assert got >= want
    assert growth_radius(index, everyone(points), GrowOptions.published()) >= 4
    assert growth_radius(index, everyone(points), GrowOptions(max_radius=0.5)) == 0.5
    assert growth_radius(index, torch.arange(4) < 1) == 0


def test_one_stray_decides_the_published_radius_only() -> None:
    points = blob(strays=1)
    index = NeighbourIndex(points)
    assert growth_radius(index, everyone(points), GrowOptions.published()) > 15
    assert growth_radius(index, everyone(points)) < 0.2


def test_region_growing_by_hand() -> None:
    """Seeds one apart; a candidate one farther, one beyond a gap, and one that is none."""
    points = on_a_line(0, 1, 2, 3, 5, -1)
    seeds = torch.tensor([True, True, False, False, False, False])
    candidates = torch.tensor([False, True, True, True, True, False])
    index = NeighbourIndex(points)
    grown = region_grow(index, seeds, candidates, GrowOptions.published())
    assert grown.tolist() == [True, True, True, True, False, False]
    short = region_grow(index, seeds, candidates, GrowOptions(max_radius=0.9))
    assert torch.equal(short, seeds)


def test_ball_growing_by_hand() -> None:
    """One step, not until nothing is added."""
    points = on_a_line(0, 1, 2, 3, -1)
    members = torch.tensor([True, True, False, False, False])
    index = NeighbourIndex(points)
    assert ball_grow(index, members).tolist() == [True, True, True, False, True]
    among = torch.tensor([False, False, True, True, False])
    assert ball_grow(index, members, among=among).tolist() == [True, True, True, False, False]
    assert torch.equal(ball_grow(index, members, GrowOptions(max_radius=0.5)), members)


@pytest.mark.parametrize(
    ("make", "given"),
    [
        (FilterOptions, {"max_neighbours": 0}),
        (FilterOptions, {"repeats": 0}),
        (FilterOptions, {"deviations": -1.0}),
        (FilterOptions, {"min_deviation": math.inf}),
        (GrowOptions, {"radius_quantile": 1.1}),
        (GrowOptions, {"radius_quantile": math.nan}),
        (GrowOptions, {"max_radius": 0.0}),
    ],
)
def test_options_that_are_refused(make: Any, given: dict[str, float]) -> None:
    with pytest.raises(RangeError, match=next(iter(given))):
        make(**given)
