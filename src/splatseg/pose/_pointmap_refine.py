"""The aligned world once more, with the points of each pair in its first camera's frame."""

from collections.abc import Callable, Generator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.pose._pointmap_align import Aligned, normalised, place_pairs
from splatseg.pose._pointmap_pixels import PairSamples
from splatseg.pose._pointmap_start import (
    cross_matrix,
    geman_mcclure,
    ray_directions,
    rotation_of_vector,
)

MIN_DEPTH_SHARE = 0.02
"""A point nearer to its camera than this share of its depth counts as behind it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Spread:
    """Standard deviations that residuals are divided by."""

    across: float
    """Tangent of the angle between a point and the ray of its pixel, in each direction."""

    along: float
    """Logarithm of the depth."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointErrors:
    """Points of some pairs in the cameras of their photographs."""

    camera: Float[Tensor, "pairs 2 samples 3"]
    across: Float[Tensor, "pairs 2 samples 2"]
    along: Float[Tensor, "pairs 2 samples"]
    ahead: Float[Tensor, "pairs 2 samples"]
    """1 where the point lies before the camera, else 0."""

    def square(self, spread: Spread) -> Float[Tensor, "pairs 2 samples"]:
        r"""The residual :math:`\rho^2`."""
        across = self.across.square().sum(-1) / spread.across**2
        return across + self.along.square() / spread.along**2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Problem:
    r"""Which photographs move, and what is minimised over them.

    The sum of :math:`w_e w_i^{v,e} (\sqrt{1 + \rho^2} - 1)` over the points of the pairs.
    """

    samples: PairSamples
    views: Int64[Tensor, "views"]
    """Photographs that move; the others stand still."""

    pairs: Int64[Tensor, "pairs"]
    """Pairs with one of them."""

    spread: Spread

    def cost(self, state: Aligned, pairs: Tensor) -> float:
        """What is minimised, of some of the pairs."""
        root = (1 + seen(self.samples, state, pairs).square(self.spread)).sqrt() - 1
        return float((self.trust(state, pairs) * root).sum())

    def trust(self, state: Aligned, pairs: Tensor) -> Float[Tensor, "n 2 samples"]:
        """How much points are believed: their confidence and their pair's weight."""
        return self.samples.weights[pairs].double() * state.weight[pairs, None, None]

    def weights(
        self, state: Aligned, pairs: Tensor, found: PointErrors
    ) -> Float[Tensor, "n 2 samples"]:
        """Weights of squares, with which their sum has the slope of what is minimised (IRLS)."""
        robust = (1 + found.square(self.spread)).rsqrt()
        return self.trust(state, pairs) * found.ahead * robust


def seen(samples: PairSamples, state: Aligned, pairs: Int64[Tensor, "n"]) -> PointErrors:
    """The points of these pairs, with the first camera's pose for that of the pair."""
    views = samples.views[pairs]
    scaled = state.scale[pairs, None, None, None] * samples.points[pairs].double()
    turn, shift = second_from_first(state, views)
    second = scaled[:, 1] @ turn.transpose(1, 2) + shift[:, None]
    camera = torch.stack((scaled[:, 0], second), dim=1)
    expected = state.depth[views]
    depth = torch.maximum(camera[..., 2], MIN_DEPTH_SHARE * expected)
    plane = ray_directions(samples.offsets[views], state.focal[views])[..., :2]
    return PointErrors(
        camera=camera,
        across=camera[..., :2] / depth.unsqueeze(-1) - plane,
        along=(depth / expected).log(),
        ahead=(camera[..., 2] > MIN_DEPTH_SHARE * expected).double(),
    )


def second_from_first(
    state: Aligned, views: Int64[Tensor, "n 2"]
) -> tuple[Float[Tensor, "n 3 3"], Float[Tensor, "n 3"]]:
    """Rotation and translation from the first camera of each pair to its second."""
    first, second = views.unbind(1)
    back = state.rotation[second].transpose(1, 2)
    shift = (state.centre[first] - state.centre[second]).unsqueeze(-1)
    return back @ state.rotation[first], (back @ shift).squeeze(-1)


# A damped step over cameras, focal lengths, mean depths and scales of pairs at once.
#
# With :math:`B = R_m^T R_n` for the pair (n, m), the point y in the second camera changes by
#
# .. math::
#     dy = [y]_\times \omega_m - \tau_m - \sigma B [X]_\times \omega_n + B \tau_n
#          + \sigma B X \, d \log \sigma
#
# for turns :math:`R \to R \exp [\omega]_\times` and moves :math:`c \to c + R \tau`; the point in
# the first changes with the scale alone. Scales are eliminated pair by pair (Schur complement), so
# that the normal equations have seven unknowns a photograph and one a lens.
#
# References:
#     Triggs, McLauchlan, Hartley and Fitzgibbon, Bundle adjustment: a modern synthesis, 1999.


CHUNK = 64
"""Pairs that are worked on at once: memory beside the samples stays that of these."""

_OWN = 7
"""Unknowns of a photograph: three of its turn, three of its move, the logarithm of its depth."""

_SCALE = 2 * _OWN + 2
"""Column of the pair's scale, after both photographs and both focal lengths."""

_MAX_CHANGE = 0.1
"""Largest change of the logarithm of a focal length, a depth or a scale in a step."""


def damped_step(problem: Problem, state: Aligned, damping: float) -> Aligned:
    """The step of Levenberg and Marquardt.

    Args:
        problem: What is minimised.
        state: Where it begins.
        damping: What is added to the diagonal, shares of it.
    """
    count = len(problem.views)
    columns, size = _columns(problem, len(state.centre))
    normal = torch.zeros(size * size, dtype=torch.float64)
    right = torch.zeros(size, dtype=torch.float64)
    back: list[Tensor] = []
    for chunk, where in zip(problem.pairs.split(CHUNK), columns.split(CHUNK), strict=True):
        local, slope = normal_equations(problem, state, chunk)
        pivot = (1 + damping) * local[:, _SCALE, _SCALE] + 1e-30
        beside = local[:, :_SCALE, _SCALE]
        # Of the scale's step: what it is by itself, and what it loses to each other unknown's.
        gain, loss = slope[:, _SCALE] / pivot, beside / pivot[:, None]
        reduced = local[:, :_SCALE, :_SCALE] - beside.unsqueeze(-1) * loss[:, None]
        own = local.diagonal(dim1=1, dim2=2)[:, :_SCALE]
        reduced.diagonal(dim1=1, dim2=2).add_(damping * own)
        index = where[:, :, None] * size + where[:, None]
        normal.index_add_(0, index.flatten(), reduced.flatten())
        right.index_add_(0, where.flatten(), (slope[:, :_SCALE] - beside * gain[:, None]).flatten())
        back.append(torch.cat((loss, gain[:, None]), dim=1))
    step = _solved(normal.view(size, size), right, still=_OWN * count)
    found = torch.cat(back)
    scales = found[:, _SCALE] - (found[:, :_SCALE] * step[columns]).sum(dim=1)
    return _moved(problem, state, step, scales)


def normal_equations(
    problem: Problem, state: Aligned, pairs: Int64[Tensor, "n"]
) -> tuple[Float[Tensor, "n 17 17"], Float[Tensor, "n 17"]]:
    """Of each pair by itself: weighted squares of the Jacobian, and its product with residuals.

    Columns are turn, move and depth of the first photograph, those of the second, logarithms of
    both focal lengths, and that of the scale.
    """
    samples = problem.samples
    found = seen(samples, state, pairs)
    views = samples.views[pairs]
    jacobian = torch.zeros(*found.along.shape, 3, _SCALE + 1, dtype=torch.float64)
    by_pose = _projected(found.camera[:, 1]) @ _by_pose(problem, state, pairs, found.camera[:, 1])
    jacobian[:, 1, ..., :6] = by_pose[..., :6]
    jacobian[:, 1, ..., _OWN : _OWN + 6] = by_pose[..., 6:12]
    jacobian[:, 1, ..., _SCALE] = by_pose[..., 12]
    jacobian[:, 0, :, 2, _SCALE] = 1.0
    plane = ray_directions(samples.offsets[views], state.focal[views])[..., :2]
    for slot in range(2):
        jacobian[:, slot, :, 2, _OWN * slot + 6] = -1.0
        jacobian[:, slot, :, :2, 2 * _OWN + slot] = plane[:, slot]
    spread = problem.spread
    unit = jacobian.new_tensor([spread.across, spread.across, spread.along])
    residual = torch.cat((found.across, found.along.unsqueeze(-1)), dim=-1) / unit
    rows = (jacobian / unit[:, None]).flatten(1, 3)
    weights = problem.weights(state, pairs, found).unsqueeze(-1).expand_as(residual)
    heavy = (rows * weights.flatten(1).unsqueeze(-1)).transpose(1, 2)
    return heavy @ rows, -(heavy @ residual.flatten(1).unsqueeze(-1)).squeeze(-1)


def _by_pose(
    problem: Problem, state: Aligned, pairs: Tensor, second: Tensor
) -> Float[Tensor, "n samples 3 13"]:
    """How points in second cameras change with turn and move of both and with the scale."""
    turn, _ = second_from_first(state, problem.samples.views[pairs])
    turn = turn[:, None]
    scaled = state.scale[pairs, None, None] * problem.samples.points[pairs, 1].double()
    shape = (*second.shape, 3)
    eye = torch.eye(3, dtype=torch.float64)
    parts = (
        -turn @ cross_matrix(scaled),
        turn.expand(shape),
        cross_matrix(second),
        -eye.expand(shape),
        turn @ scaled.unsqueeze(-1),
    )
    return torch.cat(parts, dim=-1)


def _columns(problem: Problem, photographs: int) -> tuple[Int64[Tensor, "pairs 16"], int]:
    """Where unknowns of pairs stand among all, and how many there are.

    Photographs that stand still share the place after the last.
    """
    samples, count = problem.samples, len(problem.views)
    place = torch.full((photographs,), count)
    place[problem.views] = torch.arange(count)
    ends = samples.views[problem.pairs]
    own = _OWN * place[ends].unsqueeze(-1) + torch.arange(_OWN)
    lenses = _OWN * (count + 1) + samples.lenses[ends]
    size = _OWN * (count + 1) + int(samples.lenses.max()) + 1
    return torch.cat((own.flatten(1), lenses), dim=1), size


def _solved(matrix: Tensor, right: Tensor, *, still: int) -> Tensor:
    """The step; 0 for the seven unknowns from `still` on, those of photographs that do not move."""
    free = torch.ones(len(right), dtype=torch.bool)
    free[still : still + _OWN] = False
    matrix = torch.where(free[:, None] & free, matrix, 0.0)
    # What no point tells stays as it is.
    matrix = matrix + torch.diag((matrix.diagonal() <= 0).double() + 1e-30)
    return torch.linalg.solve(matrix, torch.where(free, right, 0.0))


def _moved(problem: Problem, state: Aligned, step: Tensor, scales: Tensor) -> Aligned:
    """The world after a step."""
    views = problem.views
    own = step[: _OWN * len(views)].view(-1, _OWN)
    zooms = step[_OWN * (len(views) + 1) :].clamp(-_MAX_CHANGE, _MAX_CHANGE)
    fields = {
        name: getattr(state, name).clone() for name in ("rotation", "centre", "depth", "scale")
    }
    rotation = state.rotation[views]
    fields["rotation"][views] = rotation @ rotation_of_vector(own[:, :3])
    fields["centre"][views] += (rotation @ own[:, 3:6].unsqueeze(-1)).squeeze(-1)
    fields["depth"][views] *= own[:, 6:].clamp(-_MAX_CHANGE, _MAX_CHANGE).exp()
    fields["scale"][problem.pairs] *= scales.clamp(-_MAX_CHANGE, _MAX_CHANGE).exp()
    return replace(state, focal=state.focal * zooms.exp()[problem.samples.lenses], **fields)


def _projected(camera: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """How x / z, y / z and log z change with a point; one behind the camera has no weight."""
    x, y, z = camera.unbind(-1)
    z = torch.where(z.abs() < 1e-9, 1e-9, z)
    zero, inverse = torch.zeros_like(z), 1 / z
    rows = (inverse, zero, -x / z**2, zero, inverse, -y / z**2, zero, zero, inverse)
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


# The aligned world once more, with the points of each pair in its first camera's frame.
#
# Eq. 5 gives each pair a pose of its own, though a network answers in the frame of the first
# camera, and counts all directions alike, though it errs along rays more than across them. Here
# the pose of a pair is that of its first camera, and residuals are divided by how large they are
# along rays and across them (`_residuals`), which is measured anew each round, as is how much a
# pair is believed. Within a round all unknowns but the depths move together (`_bundle`), and
# depths follow as weighted means.


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
