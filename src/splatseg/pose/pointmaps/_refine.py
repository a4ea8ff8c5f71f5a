r"""The aligned world once more, with the points of each pair in its first camera's frame.

Eq. 5 gives each pair a pose of its own, though a network answers in the frame of the first camera,
and counts all directions alike, though it errs along rays more than across them. Here the pose of a
pair is that of its first camera, and residuals are divided by how large they are along rays and
across them (`_residuals`), which is measured anew each round, as is how much a pair is believed.
Within a round all unknowns but the depths move together (`_bundle`), and depths follow as weighted
means.
"""

from collections.abc import Callable, Generator
from dataclasses import replace

import torch
from torch import Tensor

from splatseg.pose.pointmaps._align import Aligned, normalised, place_pairs
from splatseg.pose.pointmaps._averaging import geman_mcclure
from splatseg.pose.pointmaps._bundle import CHUNK, damped_step
from splatseg.pose.pointmaps._residuals import Problem, Spread, seen
from splatseg.pose.pointmaps._samples import PairSamples

_ROUNDS = 3
_STEPS = 10
"""Most steps of a round."""

_TOGETHER = 200
"""Photographs that move together; the others stand still meanwhile. The normal equations of so many
take 16 MB, however many photographs there are."""

_BELIEVED = 0.3
"""Pairs of less weight do not tell how large residuals are."""

_TIMES = 2.5
_MIN_ACROSS = 2e-4  # tangent of the angle to the ray
_MIN_ALONG = 1e-3  # share of the depth
_MIN_RATIO = 0.5
_STILL = 1e-5
"""Movement of cameras at which a round ends, shares of their depth."""

_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-4, 1e-9, 1e4


def refine(
    samples: PairSamples,
    start: Aligned,
    *,
    progress: Callable[[int, int], None],
    together: int = _TOGETHER,
) -> Aligned:
    """Cameras, focal lengths, depths and scales at once, by rounds.

    Args:
        samples: The pairs.
        start: A world near the right one, with a weight for each pair.
        progress: Told of steps.
        together: Most photographs that move together.
    """
    count = len(start.centre)
    blocks = [torch.arange(i, min(i + together, count)) for i in range(0, count, together)]
    total, done = _ROUNDS * len(blocks) * (_STEPS + 1), 0
    state = start
    for _ in range(_ROUNDS):
        state, spread = weighed(samples, state)
        for views in blocks:
            pairs = torch.isin(samples.views, views).any(dim=1).nonzero()[:, 0]
            problem = Problem(samples=samples, views=views, pairs=pairs, spread=spread)
            for moved in _steps(problem, state):
                state = moved
                done += 1
                progress(min(done, total), total)
    progress(total, total)
    tied = replace(
        state,
        pair_rotation=state.rotation[samples.first],
        pair_translation=state.centre[samples.first],
    )
    # Clouds are made with the similarity that fits each pair best.
    return normalised(place_pairs(samples, tied, torch.arange(len(samples))))


def weighed(samples: PairSamples, state: Aligned) -> tuple[Aligned, Spread]:
    """Spreads of the residuals of believed pairs, and how much each pair is believed by them."""
    across: list[Tensor] = []
    along: list[Tensor] = []
    for chunk in torch.arange(len(samples)).split(CHUNK):
        found = seen(samples, state, chunk)
        across.append(found.across.norm(dim=-1).median(dim=-1).values)
        along.append(found.along.abs().median(dim=-1).values)
    beside, ahead = torch.cat(across), torch.cat(along)
    believed = state.weight >= min(_BELIEVED, float(state.weight.max()))
    # Medians of Gaussian residuals of unit spread: 1.1774 in two directions, 0.6745 in one.
    spread = Spread(
        across=max(float(beside[believed].median()) / 1.1774, _MIN_ACROSS),
        along=max(float(ahead[believed].median()) / 0.6745, _MIN_ALONG),
    )
    ratio = ((beside / spread.across).square() + (ahead / spread.along).square()).sqrt()
    # Of the worse of the two: an outlier may be right of one of its photographs.
    weight = geman_mcclure(ratio.amax(dim=1), _MIN_RATIO, times=_TIMES)
    return replace(state, weight=weight), spread


def _steps(problem: Problem, state: Aligned) -> Generator[Aligned]:
    """Worlds that each make the sum less; with more damping after a step that does not."""
    state = _with_depths(problem, state)
    yield state
    cost, damping = _cost(problem, state), _FIRST_DAMPING
    for _ in range(_STEPS):
        tried = _with_depths(problem, damped_step(problem, state, damping))
        after = _cost(problem, tried)
        if not after < cost:
            damping *= 100
            if damping > _MOST_DAMPING:
                break
            continue
        way = (tried.centre - state.centre).norm(dim=1).max() / state.depth.median()
        state, cost, damping = tried, after, max(damping / 10, _LEAST_DAMPING)
        yield state
        if float(way) < _STILL:
            break


def _cost(problem: Problem, state: Aligned) -> float:
    return sum(problem.cost(state, chunk) for chunk in problem.pairs.split(CHUNK))


def _with_depths(problem: Problem, state: Aligned) -> Aligned:
    """The best depths of the photographs that move, for given cameras and scales."""
    samples, views = problem.samples, problem.views
    logs, sums = torch.zeros_like(state.depth), torch.zeros_like(state.depth)
    for chunk in problem.pairs.split(CHUNK):
        found = seen(samples, state, chunk)
        weights = problem.weights(state, chunk, found)
        ends = samples.views[chunk].flatten()
        logs.index_add_(0, ends, (weights * found.along).flatten(0, 1))
        sums.index_add_(0, ends, weights.flatten(0, 1))
    depth = state.depth.clone()
    depth[views] = depth[views] * (logs[views] / sums[views].clamp_min(1e-300)).exp()
    return replace(state, depth=depth)
