"""Which chunks a camera may see: none that it does is left out, and few others are read."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from splatseg.core import Camera, Gaussians
from splatseg.core.chunks import Chunks
from splatseg.errors import InputError
from splatseg.render import back_project

NEAR, LOW_PASS = 0.01, 0.3


def no_rows(runs: object, *, colours: bool = True) -> Gaussians:
    raise AssertionError(f"nothing was to be read, {runs} was")


def each_alone(gaussians: Gaussians, memory: int = 1 << 40) -> Chunks:
    """Every Gaussian a chunk of its own: the bound is as close as it can be."""
    return Chunks(
        starts=torch.arange(len(gaussians) + 1),
        low=gaussians.means,
        high=gaussians.means,
        largest=gaussians.scales.amax(dim=1),
        memory=memory,
        read=no_rows,
    )


def camera(**changes: float) -> Camera:
    values = {"width": 40, "height": 24, "fx": 30.0, "fy": 34.0, "cx": 18.0, "cy": 13.0} | changes
    return Camera(**values, cam_from_world=torch.eye(4).double())


@given(seed=st.integers(0, 2**32 - 1), low_pass=st.sampled_from([0.0, 0.3, 4.0]))
def test_no_gaussian_with_a_weight_is_in_a_chunk_that_is_not_seen(seed, low_pass) -> None:
    """Centres all around the edges of the view, near it and behind; scales from tiny to huge."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> torch.Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator)

    count = 200
    z = torch.exp(uniform(-4, 3, count, 1)) * torch.where(uniform(0, 1, count, 1) < 0.1, -1, 1)
    gaussians = Gaussians(
        means=torch.cat((uniform(-1.5, 1.5, count, 2) * z.abs(), z), dim=1),
        rotations=torch.nn.functional.normalize(uniform(-1, 1, count, 4), dim=1),
        scales=torch.exp(uniform(-6, 1, count, 3)),
        opacities=torch.ones(count),
        sh=torch.zeros(count, 1, 3),
        low_pass=low_pass,
    )
    view = camera()
    seen = each_alone(gaussians).seen(view, near=NEAR, low_pass=low_pass)
    for i in range(count):  # alone: what hides others does not hide a fault
        if not seen[i]:
            weights = back_project(gaussians[i : i + 1], view, torch.zeros(24, 40, 1)).weights
            assert float(weights) == 0, gaussians.means[i]


@pytest.mark.parametrize(
    ("place", "scale", "expected"),
    [
        ((0.0, 0.0, 2.0), 0.01, True),
        ((0.0, 0.0, -2.0), 0.01, False),
        ((0.0, 0.0, -2.0), 9.0, False),
        # At a depth of 2 the edges are at x = -1.2 and 1.47, y = -0.76 and 0.65; low pass and
        # rounding are worth 0.19 and 0.17 of that, and a standard deviation of 0.01 some 0.05.
        ((1.75, 0.0, 2.0), 0.01, False),
        ((1.75, 0.0, 2.0), 0.05, True),
        ((1.6, 0.0, 2.0), 0.0, True),
        ((-1.48, 0.0, 2.0), 0.01, False),
        ((-1.35, 0.0, 2.0), 0.0, True),
        ((0.0, 0.9, 2.0), 0.01, False),
        ((0.0, 0.78, 2.0), 0.0, True),
        ((0.0, -1.02, 2.0), 0.01, False),
        ((0.0, -0.9, 2.0), 0.0, True),
    ],
)
def test_what_lies_beside_the_view_is_not_read(place, scale, expected) -> None:
    one = Gaussians(
        means=torch.tensor([place]),
        rotations=torch.eye(4)[:1],
        scales=torch.full((1, 3), scale),
        opacities=torch.ones(1),
        sh=torch.zeros(1, 1, 3),
    )
    found = each_alone(one).seen(camera(), near=NEAR, low_pass=LOW_PASS)
    assert found.tolist() == [expected]


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        ((-9, -9, -9), (9, 9, 9), True),  # around the camera
        ((-0.1, -0.1, -5), (0.1, 0.1, 1), True),  # from behind it
        ((3, -1, -5), (9, 1, 2), False),  # to its right
        ((1, -1, -5), (9, 1, 2), True),  # from its right into the view
        ((-9, -9, -9), (9, 9, -1), False),
    ],
)
def test_a_box_is_seen_if_some_place_in_it_can_be(low, high, expected) -> None:
    box = replace(
        each_alone(_at(torch.zeros(1, 3))),
        low=torch.tensor([low]).float(),
        high=torch.tensor([high]).float(),
        largest=torch.zeros(1),
    )
    assert box.seen(camera(), near=NEAR, low_pass=LOW_PASS).tolist() == [expected]


def test_chunks_that_follow_each_other_are_one_run() -> None:
    chunks = Chunks(
        starts=torch.tensor([0, 3, 5, 9, 10]),
        low=torch.zeros(4, 3),
        high=torch.ones(4, 3),
        largest=torch.ones(4),
        memory=1,
        read=no_rows,
    )
    chosen = torch.tensor([True, True, False, True])
    assert chunks.runs(chosen) == [(0, 5), (9, 10)]
    assert chunks.rows(chosen).tolist() == [0, 1, 2, 3, 4, 9]
    assert list(chunks.blocks(4)) == [(0, 4), (4, 8), (8, 10)]
    assert chunks.rows(~torch.ones(4, dtype=torch.bool)).tolist() == []


def test_a_view_that_needs_more_than_the_memory_is_refused_before_anything_is_read() -> None:
    ahead = Gaussians(
        means=torch.tensor([[0.0, 0, 2]]).expand(1000, 3),
        rotations=torch.eye(4)[:1].expand(1000, 4),
        scales=torch.ones(1000, 3),
        opacities=torch.ones(1000),
        sh=torch.zeros(1000, 1, 3),
    )
    chunks = each_alone(ahead, memory=200_000)
    asked = {"near": NEAR, "low_pass": LOW_PASS, "coefficients": 1}
    with pytest.raises(InputError, match=r"^memory: a view has 1000 Gaussians before it"):
        chunks.view_of(camera(), **asked)
    assert replace(chunks, memory=230_000).view_of(camera(), **asked) == [(0, 1000)]


def test_a_box_has_the_chunks_that_reach_into_it() -> None:
    three = torch.tensor([[0.0, 0, 0], [2, 0, 0], [4, 4, 4]])
    chunks = replace(each_alone(_at(three)), high=three + 1)
    found = chunks.around(torch.tensor([0.5, 0.5, 0.5]), torch.tensor([2.0, 2, 2]))
    assert found.tolist() == [True, True, False]


def _at(means: torch.Tensor) -> Gaussians:
    count = len(means)
    return Gaussians(
        means=means,
        rotations=torch.eye(4)[:1].expand(count, 4),
        scales=torch.ones(count, 3),
        opacities=torch.ones(count),
        sh=torch.zeros(count, 1, 3),
    )
