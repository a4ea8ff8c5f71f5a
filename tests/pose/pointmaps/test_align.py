"""Alignment of pointmaps and its refinement."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from splatseg.pose._pointmap_align import Aligned
from splatseg.pose._pointmap_pixels import PairSamples
from splatseg.pose._pointmap_refine import (
    _MAX_CHANGE,
    Problem,
    Spread,
    damped_step,
    normal_equations,
    refine,
    seen,
    weighed,
)
from splatseg.pose._pointmap_start import rotation_of_vector
from splatseg.pose.pointmaps import PointmapOptions, solve
from splatseg_bench.worlds import PointmapErrors
from support.pointmaps import (
    CameraErrors,
    PhotographedRoom,
    aligned_cameras,
    complete,
    solved,
    window,
)

WRONG = PointmapErrors(outliers=0.1)
"""2 % of noise, 3 % of warp, units from 0.5 to 2, a fifth of the confidences by chance."""


def _errors(room: PhotographedRoom, pairs, errors=None, seed: int = 0, **options) -> CameraErrors:
    samples = room.samples(pairs, errors or PointmapErrors(), seed)
    found = solved(samples, **options)
    assert float(found.scale.log().mean()) == pytest.approx(0, abs=1e-9)  # their product is one
    return room.errors_of(aligned_cameras(room, found))


def test_exact_pointmaps_give_exact_cameras(photographed) -> None:
    off = _errors(photographed, complete(8), PointmapErrors(noise=0, warp=0))
    assert off.rotation.max() < 1e-3
    assert off.centre.max() < 2e-5
    assert np.abs(off.focal).max() < 2e-5


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_cameras_of_wrong_pointmaps_with_a_tenth_of_outliers(photographed, seed) -> None:
    off = _errors(photographed, complete(8), WRONG, seed)
    assert off.rotation.max() < 0.5
    assert off.centre.max() < 0.01
    assert np.abs(off.focal).max() < 0.01


def test_outliers_lose_their_weight(photographed) -> None:
    pairs = complete(8)
    named = [(photographed.names[i], photographed.names[j]) for i, j in pairs]
    wrong = photographed.answers(pairs, WRONG).outliers
    bad = torch.tensor([pair in wrong for pair in named])
    assert int(bad.sum()) == 6
    samples = photographed.samples(pairs, WRONG)
    found = solved(samples)
    assert float(found.weight[bad].max()) < 0.1
    assert float(found.weight[~bad].min()) > 0.3


@pytest.mark.parametrize("bad", ["behind", "on a line"])
def test_a_pair_of_no_geometry_spoils_nothing(photographed, bad: str) -> None:
    """Its depths are those of no camera, and its scale is anything: thousands of the others'."""
    pairs = complete(8)
    samples = photographed.samples(pairs, PointmapErrors())
    limit = _limit(photographed, samples)
    one = pairs.index((2, 5))
    line = torch.linspace(1, 2, samples.points.shape[2])[:, None].expand(-1, 3)
    samples.points[one] = -samples.points[one] if bad == "behind" else line
    assert _limit(photographed, samples) < 1.3 * limit


def _limit(room: PhotographedRoom, samples) -> float:
    found = solved(samples)
    return float(room.errors_of(aligned_cameras(room, found)).centre.max())


def test_noise_does_not_shrink_the_focal_length(photographed) -> None:
    """Noise alone, four times the usual: eq. 4 on one map is off by a percent, all maps are not."""
    loud = PointmapErrors(noise=0.04, warp=0, sideways=1, wrong_confidence=0)
    off = _errors(photographed, complete(8), loud)
    assert np.abs(off.focal).max() < 0.003


def test_blocks_end_where_all_at_once_do(photographed) -> None:
    errors = PointmapErrors(outliers=0.05, noise=0.01, warp=0.01)
    whole = _errors(photographed, window(8, 3), errors)
    blocks = _errors(photographed, window(8, 3), errors, block=4)
    assert blocks.rotation.max() < whole.rotation.max() + 0.1
    assert blocks.centre.max() < whole.centre.max() + 0.002


def test_more_steps_are_better_than_one(photographed) -> None:
    one = _errors(photographed, window(8, 2), iterations=1)
    many = _errors(photographed, window(8, 2))
    assert many.centre.mean() < one.centre.mean()


@pytest.mark.bits
def test_the_same_samples_give_the_same_bits(photographed) -> None:
    samples = photographed.samples(window(8, 2), WRONG)
    one, two = (solved(samples, iterations=5) for _ in range(2))
    assert torch.equal(one.centre, two.centre)
    assert torch.equal(one.depth, two.depth)


# The last stage of the alignment: its derivatives, what it makes better, and what it leaves.


SPREAD = Spread(across=0.01, along=0.05)


def _silent(done: int, total: int) -> None: ...


def _off(room: PhotographedRoom, found: Aligned) -> CameraErrors:
    return room.errors_of(aligned_cameras(room, found))


def _changed(samples: PairSamples, state: Aligned, pair: int, step: torch.Tensor) -> Aligned:
    """The world after one pair's unknowns changed, in the order of `normal_equations`."""
    ends = samples.views[pair].tolist()
    fields = {name: getattr(state, name).clone() for name in ("rotation", "centre", "depth")}
    for slot, view in enumerate(ends):
        own = step[7 * slot : 7 * slot + 7]
        fields["centre"][view] += state.rotation[view] @ own[3:6]
        fields["rotation"][view] = state.rotation[view] @ rotation_of_vector(own[None, :3])[0]
        fields["depth"][view] *= own[6].exp()
    focal, scale = state.focal.clone(), state.scale.clone()
    focal[ends] *= step[14:16].exp()
    scale[pair] *= step[16].exp()
    return replace(state, focal=focal, scale=scale, **fields)


def test_the_slope_and_the_curvature_are_those_of_the_sum(photographed) -> None:
    """The slope is that of the cost itself; squares of the Jacobian by differences of residuals."""
    samples = photographed.samples(window(8, 2), PointmapErrors())
    state = solved(samples, iterations=3, refine=False)
    pair = 5
    chosen = torch.tensor([pair])
    problem = Problem(samples=samples, views=torch.arange(8), pairs=chosen, spread=SPREAD)
    normal, slope = normal_equations(problem, state, chosen)

    def residuals(world: Aligned) -> torch.Tensor:
        found = seen(samples, world, chosen)
        parts = (found.across / SPREAD.across, found.along.unsqueeze(-1) / SPREAD.along)
        return torch.cat(parts, dim=-1).flatten()

    step = 1e-6
    columns = []
    for k in range(17):
        way = torch.zeros(17, dtype=torch.float64)
        way[k] = step
        up = _changed(samples, state, pair, way)
        down = _changed(samples, state, pair, -way)
        columns.append((residuals(up) - residuals(down)) / (2 * step))
        measured = (problem.cost(up, chosen) - problem.cost(down, chosen)) / (2 * step)
        assert measured == pytest.approx(-float(slope[0, k]), rel=1e-4, abs=1e-3)
    jacobian = torch.stack(columns, dim=1)
    weights = problem.weights(state, chosen, seen(samples, state, chosen)).flatten()
    expected = jacobian.T @ (weights.repeat_interleave(3)[:, None] * jacobian)
    torch.testing.assert_close(normal[0], expected, rtol=1e-4, atol=1e-2)


def test_a_step_is_that_of_the_whole_equations(photographed) -> None:
    """Scales eliminated pair by pair give what one system with them in it gives."""
    samples = photographed.samples(window(8, 1), PointmapErrors())
    state, spread = weighed(samples, solved(samples, iterations=2, refine=False))
    pairs = torch.arange(len(samples))
    problem = Problem(samples=samples, views=torch.arange(8), pairs=pairs, spread=spread)
    size = 7 * 8 + 1 + len(samples)
    whole = torch.zeros(size, size, dtype=torch.float64)
    right = torch.zeros(size, dtype=torch.float64)
    local, slope = normal_equations(problem, state, pairs)
    for e, (one, two) in enumerate(samples.views.tolist()):
        first, second = range(7 * one, 7 * one + 7), range(7 * two, 7 * two + 7)
        where = torch.tensor([*first, *second, 56, 56, 57 + e])
        index = (where[:, None] * size + where).flatten()
        whole.view(-1).index_add_(0, index, local[e].flatten())
        right.index_add_(0, where, slope[e])
    damping = 0.5
    expected = torch.linalg.solve(whole + damping * torch.diag(whole.diagonal()), right)
    found = damped_step(problem, state, damping)
    assert float(expected.abs().max()) < _MAX_CHANGE  # nothing was clamped
    scales, depths, zooms = (
        (getattr(found, name) / getattr(state, name)).log() for name in ("scale", "depth", "focal")
    )
    torch.testing.assert_close(scales, expected[57:], rtol=1e-5, atol=1e-9)
    torch.testing.assert_close(depths[:, 0], expected[6:56:7], rtol=1e-5, atol=1e-9)
    assert float(zooms[0]) == pytest.approx(float(expected[56]), rel=1e-5)
    moves = (state.rotation.transpose(1, 2) @ (found.centre - state.centre).unsqueeze(-1))[..., 0]
    torch.testing.assert_close(moves, expected[:56].view(8, 7)[:, 3:6], rtol=1e-5, atol=1e-9)


def test_photographs_that_stand_still_do(photographed) -> None:
    samples = photographed.samples(window(8, 2), PointmapErrors())
    state, spread = weighed(samples, solved(samples, iterations=2, refine=False))
    views = torch.tensor([2, 3])
    pairs = torch.isin(samples.views, views).any(dim=1).nonzero()[:, 0]
    problem = Problem(samples=samples, views=views, pairs=pairs, spread=spread)
    found = damped_step(problem, state, 1e-4)
    still = torch.tensor([0, 1, 4, 5, 6, 7])
    for name in ("rotation", "centre", "depth"):
        before, after = getattr(state, name), getattr(found, name)
        assert torch.equal(before[still], after[still])
        assert not torch.equal(before[views], after[views])
    untouched = torch.ones(len(samples), dtype=torch.bool)
    untouched[pairs] = False
    assert torch.equal(found.scale[untouched], state.scale[untouched])


def test_cameras_are_better_by_a_third_and_more(photographed) -> None:
    """Over seeds: a single one could be luck. Along the ray and across it alike, too."""
    for errors in (WRONG, replace(WRONG, sideways=1.0, noise=0.01, warp=0.01)):
        rotation, centre = [], []
        for seed in range(3):
            samples = photographed.samples(complete(8), errors, seed)
            start = solved(samples, refine=False)
            refined = refine(samples, start, progress=_silent)  # what `solve` does of itself
            before, after = _off(photographed, start), _off(photographed, refined)
            rotation.append((before.rotation.max(), after.rotation.max()))
            centre.append((before.centre.max(), after.centre.max()))
        for pairs in (rotation, centre):
            before, after = np.mean(pairs, axis=0)
            assert after < 0.67 * before


def test_outliers_lose_their_weight_though_the_start_believed_them(photographed) -> None:
    pairs = complete(8)
    named = [(photographed.names[i], photographed.names[j]) for i, j in pairs]
    wrong = photographed.answers(pairs, WRONG).outliers
    bad = torch.tensor([pair in wrong for pair in named])
    samples = photographed.samples(pairs, WRONG)
    start = solved(samples, refine=False)
    believed = replace(start, weight=torch.ones_like(start.weight))
    found = refine(samples, believed, progress=_silent)
    assert float(found.weight[bad].max()) < 0.1
    assert float(found.weight[~bad].min()) > 0.3
    assert _off(photographed, found).rotation.max() < 0.3


def test_spreads_are_those_of_the_errors(photographed) -> None:
    """Noise alone of 4 % along and 1 % across: measured as that, and pairs are believed alike."""
    errors = PointmapErrors(noise=0.04, sideways=0.25, warp=0, wrong_confidence=0)
    samples = photographed.samples(complete(8), errors)
    state, spread = weighed(samples, solved(samples))
    assert spread.along == pytest.approx(0.04, rel=0.15)
    assert spread.across == pytest.approx(0.01, rel=0.15)
    assert float(state.weight.min()) > 0.6


def test_some_at_a_time_end_near_where_all_at_once_do(photographed) -> None:
    samples = photographed.samples(complete(8), WRONG)
    start = solved(samples, refine=False)
    whole = _off(photographed, refine(samples, start, progress=_silent))
    parts = _off(photographed, refine(samples, start, progress=_silent, together=4))
    assert parts.rotation.max() < whole.rotation.max() + 0.15
    assert parts.rotation.max() < _off(photographed, start).rotation.max()


def test_progress_ends_where_it_says(photographed) -> None:
    samples = photographed.samples(window(8, 1))
    told: list[tuple[int, int]] = []
    solve(samples, options=PointmapOptions(), progress=lambda *now: told.append(now))
    assert told[-1][0] == told[-1][1]
    assert len({total for _, total in told}) == 1
    assert [done for done, _ in told] == sorted(done for done, _ in told)
