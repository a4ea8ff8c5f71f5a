r"""The aligned world once more, with the points of each pair in its first camera's frame.

Eq. 5 gives each pair a pose of its own, though a network answers in the frame of the first camera,
and counts all directions alike, though it errs along rays more than across them. Here the pair's
pose is that of its first camera n, and for its point X of pixel i of photograph v

.. math::
    y = R_v^T (\sigma_e R_n X + c_n - c_v), \qquad
    \rho^2 = \frac{\| y_{xy} / y_z - q_i / f_v \|^2}{s_a^2}
           + \frac{(\log y_z - \log D_i^v)^2}{s_d^2}, \qquad
    \min \sum w_e \, w_i^{v,e} \left( \sqrt{1 + \rho^2} - 1 \right)

with :math:`s_a, s_d` the spreads of what is left across and along rays, measured anew each round,
and :math:`w_e` how much the pair is believed, likewise. Steps are Levenberg's and Marquardt's over
cameras, focal lengths and the mean depth of each photograph, with the scales of the pairs
eliminated (Schur complement); depths follow as weighted means.

References:
    Triggs et al., Bundle adjustment: a modern synthesis, 1999.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.pose.pointmaps._align import Aligned, normalised, place_pairs
from splatseg.pose.pointmaps._averaging import geman_mcclure
from splatseg.pose.pointmaps._samples import PairSamples
from splatseg.pose.pointmaps._start import rotation_of_vector

_ROUNDS = 3
_STEPS = 10
"""Most steps of a round."""

_TOGETHER = 200
"""Photographs that move together; the others stand still meanwhile. The normal equations take
8 (7 N)^2 bytes."""

_BELIEVED = 0.3
"""Pairs with less weight tell nothing of how large residuals are."""

_TIMES = 2.5
_MIN_ACROSS = 2e-4  # tangent of the angle to the ray
_MIN_ALONG = 1e-3  # share of the depth
_MIN_RATIO = 0.5
_MIN_DEPTH_SHARE = 0.02
_STILL = 1e-5
"""Movement of cameras at which a round ends, shares of their depth."""

_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-4, 1e-9, 1e4
_MAX_CHANGE = 0.1
"""Largest change of the logarithm of a focal length, a depth or a scale in a step."""

_CHUNK = 64
_OWN = 7
"""Unknowns of a photograph: three of its turn, three of its move, the logarithm of its depth."""

_SCALE = 2 * _OWN + 2
"""Column of the pair's scale, after both photographs and both focal lengths."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Spread:
    """What residuals are divided by."""

    across: float
    """Tangent of the angle between a point and the ray of its pixel."""

    along: float
    """Share of the depth."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Seen:
    """Points of some pairs in the cameras of their photographs."""

    camera: Float[Tensor, "pairs 2 samples 3"]
    across: Float[Tensor, "pairs 2 samples 2"]
    along: Float[Tensor, "pairs 2 samples"]
    ahead: Float[Tensor, "pairs 2 samples"]
    """1 where the point lies before the camera, else 0."""

    def square(self, spread: Spread) -> Float[Tensor, "pairs 2 samples"]:
        """The residual :math:`\\rho^2`."""
        across = self.across.square().sum(-1) / spread.across**2
        return across + self.along.square() / spread.along**2


def refine(
    samples: PairSamples, start: Aligned, *, progress: Callable[[int, int], None]
) -> Aligned:
    """Cameras, focal lengths, depths and scales together, by rounds.

    Args:
        samples: The pairs.
        start: A world near the right one, with a weight for each pair.
        progress: Told of steps.
    """
    count = len(start.centre)
    blocks = [torch.arange(i, min(i + _TOGETHER, count)) for i in range(0, count, _TOGETHER)]
    total, done = _ROUNDS * len(blocks) * _STEPS, 0
    state = start
    for _ in range(_ROUNDS):
        state, spread = _weighed(samples, state)
        for views in blocks:
            begin = done
            state = _round(
                samples, state, views, spread, lambda n, b=begin: progress(b + n, total)
            )
            done += _STEPS
            progress(done, total)
    tied = replace(
        state,
        pair_rotation=state.rotation[samples.first],
        pair_translation=state.centre[samples.first],
    )
    # Clouds are made with the similarity that fits each pair best.
    return normalised(place_pairs(samples, tied, torch.arange(len(samples))))


def _round(
    samples: PairSamples,
    state: Aligned,
    views: Int64[Tensor, "n"],
    spread: Spread,
    progress: Callable[[int], None],
) -> Aligned:
    """Steps that each make the sum less; with more damping after one that does not."""
    pairs = torch.isin(samples.views, views).any(dim=1).nonzero()[:, 0]
    state = _with_depths(samples, state, views, pairs, spread)
    cost, damping = _cost(samples, state, pairs, spread), _FIRST_DAMPING
    for step in range(_STEPS):
        tried = _stepped(samples, state, views, pairs, spread, damping)
        tried = _with_depths(samples, tried, views, pairs, spread)
        after = _cost(samples, tried, pairs, spread)
        progress(step + 1)
        if not after < cost:
            damping *= 100
            if damping > _MOST_DAMPING:
                break
            continue
        way = (tried.centre - state.centre).norm(dim=1).max() / state.depth.median()
        state, cost, damping = tried, after, max(damping / 10, _LEAST_DAMPING)
        if float(way) < _STILL:
            break
    return state


def _seen(samples: PairSamples, state: Aligned, pairs: Int64[Tensor, "n"]) -> _Seen:
    views = samples.views[pairs]
    scaled = state.scale[pairs, None, None, None] * samples.points[pairs].double()
    turn, shift = _second_from_first(state, views)
    second = scaled[:, 1] @ turn.transpose(1, 2) + shift[:, None]
    camera = torch.stack((scaled[:, 0], second), dim=1)
    expected = state.depth[views]
    depth = torch.maximum(camera[..., 2], _MIN_DEPTH_SHARE * expected)
    plane = samples.offsets[views] / state.focal[views][..., None, None]
    return _Seen(
        camera=camera,
        across=camera[..., :2] / depth.unsqueeze(-1) - plane,
        along=(depth / expected).log(),
        ahead=(camera[..., 2] > _MIN_DEPTH_SHARE * expected).double(),
    )


def _second_from_first(state: Aligned, views: Int64[Tensor, "n 2"]) -> tuple[Tensor, Tensor]:
    first, second = views.unbind(1)
    back = state.rotation[second].transpose(1, 2)
    shift = (state.centre[first] - state.centre[second]).unsqueeze(-1)
    return back @ state.rotation[first], (back @ shift).squeeze(-1)


def _weighed(samples: PairSamples, state: Aligned) -> tuple[Aligned, Spread]:
    """Spreads of the residuals of believed pairs, and how much each pair is believed by them."""
    across: list[Tensor] = []
    along: list[Tensor] = []
    for chunk in torch.arange(len(samples)).split(_CHUNK):
        seen = _seen(samples, state, chunk)
        across.append(seen.across.norm(dim=-1).median(dim=-1).values)
        along.append(seen.along.abs().median(dim=-1).values)
    beside, ahead = torch.cat(across), torch.cat(along)
    believed = state.weight >= min(_BELIEVED, float(state.weight.max()))
    # Medians of Gaussian residuals of unit spread: 1.1774 in two directions, 0.6745 in one.
    spread = Spread(
        across=max(float(beside[believed].median()) / 1.1774, _MIN_ACROSS),
        along=max(float(ahead[believed].median()) / 0.6745, _MIN_ALONG),
    )
    ratio = (beside / spread.across).square() + (ahead / spread.along).square()
    weight = geman_mcclure(ratio.sqrt().amax(dim=1), _MIN_RATIO, times=_TIMES)
    return replace(state, weight=weight), spread


def _cost(samples: PairSamples, state: Aligned, pairs: Tensor, spread: Spread) -> float:
    total = 0.0
    for chunk in pairs.split(_CHUNK):
        root = (1 + _seen(samples, state, chunk).square(spread)).sqrt() - 1
        weights = samples.weights[chunk].double() * state.weight[chunk, None, None]
        total += float((weights * root).sum())
    return total


def _with_depths(
    samples: PairSamples, state: Aligned, views: Tensor, pairs: Tensor, spread: Spread
) -> Aligned:
    """The best depths of these photographs for given cameras and scales."""
    logs = torch.zeros_like(state.depth)
    sums = torch.zeros_like(state.depth)
    for chunk in pairs.split(_CHUNK):
        seen = _seen(samples, state, chunk)
        weights = _weights(samples, state, chunk, seen, spread)
        ends = samples.views[chunk].flatten()
        logs.index_add_(0, ends, (weights * seen.along).flatten(0, 1))
        sums.index_add_(0, ends, weights.flatten(0, 1))
    depth = state.depth.clone()
    depth[views] = depth[views] * (logs[views] / sums[views].clamp_min(1e-300)).exp()
    return replace(state, depth=depth)


def _weights(
    samples: PairSamples, state: Aligned, pairs: Tensor, seen: _Seen, spread: Spread
) -> Float[Tensor, "pairs 2 samples"]:
    """Of squares of residuals, of which the sum has the slope of what is minimised."""
    confidence = samples.weights[pairs].double() * state.weight[pairs, None, None]
    return confidence * seen.ahead / (1 + seen.square(spread)).sqrt()


def _stepped(
    samples: PairSamples,
    state: Aligned,
    views: Int64[Tensor, "n"],
    pairs: Int64[Tensor, "m"],
    spread: Spread,
    damping: float,
) -> Aligned:
    """A damped step of Gauss and Newton."""
    count = len(views)
    place = torch.full((len(state.centre),), count)
    place[views] = torch.arange(count)
    lenses = int(samples.lenses.max()) + 1
    size = _OWN * (count + 1) + lenses  # the photograph after the last takes what stands still
    normal = torch.zeros(size * size, dtype=torch.float64)
    right = torch.zeros(size, dtype=torch.float64)
    rows: list[Tensor] = []
    columns = _columns(samples, place, pairs, size - lenses)
    for chunk, where in zip(pairs.split(_CHUNK), columns.split(_CHUNK), strict=True):
        local, slope = _normal_of_pairs(samples, state, chunk, spread)
        local[:, _SCALE, _SCALE] *= 1 + damping
        local[:, _SCALE, _SCALE] += 1e-30
        scale = local[:, _SCALE] / local[:, _SCALE, _SCALE, None]
        gain = slope[:, _SCALE] / local[:, _SCALE, _SCALE]
        beside = local[:, :_SCALE, _SCALE]
        reduced = local[:, :_SCALE, :_SCALE] - beside.unsqueeze(-1) * scale[:, None, :_SCALE]
        index = where[:, :, None] * size + where[:, None]
        normal.index_add_(0, index.flatten(), reduced.flatten())
        right.index_add_(0, where.flatten(), (slope[:, :_SCALE] - beside * gain[:, None]).flatten())
        rows.append(torch.cat((scale[:, :_SCALE], gain[:, None]), dim=1))
    matrix = normal.view(size, size)
    free = torch.ones(size, dtype=torch.bool)
    free[_OWN * count : _OWN * (count + 1)] = False
    matrix = torch.where(free[:, None] & free, matrix, 0.0)
    diagonal = matrix.diagonal()
    # Where points do not tell something, it stays as it is.
    matrix = matrix + torch.diag(torch.where(diagonal > 0, damping * diagonal, 1.0) + 1e-30)
    step = torch.linalg.solve(matrix, torch.where(free, right, 0.0))
    back = torch.cat(rows)
    scales = back[:, _SCALE] - (back[:, :_SCALE] * step[columns]).sum(dim=1)
    return _moved(samples, state, views, pairs, step=step, scales=scales)


def _columns(samples: PairSamples, place: Tensor, pairs: Tensor, lenses_from: int) -> Tensor:
    """Where the unknowns of pairs but for their scales stand among all, (pairs, 16)."""
    ends = samples.views[pairs]
    own = _OWN * place[ends].unsqueeze(-1) + torch.arange(_OWN)
    return torch.cat((own.flatten(1), lenses_from + samples.lenses[ends]), dim=1)


def _moved(
    samples: PairSamples,
    state: Aligned,
    views: Tensor,
    pairs: Tensor,
    *,
    step: Tensor,
    scales: Tensor,
) -> Aligned:
    own = step[: _OWN * len(views)].view(-1, _OWN)
    zooms = step[_OWN * (len(views) + 1) :].clamp(-_MAX_CHANGE, _MAX_CHANGE)
    fields = {
        name: getattr(state, name).clone() for name in ("rotation", "centre", "depth", "scale")
    }
    rotation = state.rotation[views]
    fields["rotation"][views] = rotation @ rotation_of_vector(own[:, :3])
    fields["centre"][views] += (rotation @ own[:, 3:6].unsqueeze(-1)).squeeze(-1)
    fields["depth"][views] *= own[:, 6:].clamp(-_MAX_CHANGE, _MAX_CHANGE).exp()
    fields["scale"][pairs] *= scales.clamp(-_MAX_CHANGE, _MAX_CHANGE).exp()
    return replace(state, focal=state.focal * zooms.exp()[samples.lenses], **fields)


def _normal_of_pairs(
    samples: PairSamples, state: Aligned, pairs: Tensor, spread: Spread
) -> tuple[Float[Tensor, "n 17 17"], Float[Tensor, "n 17"]]:
    r"""Normal equations of each pair by itself.

    With :math:`B = R_m^T R_n` the second camera's y changes by :math:`[y]_\times \omega_m - \tau_m`
    and by :math:`B \tau_n - \sigma B [X]_\times \omega_n`, the scale's logarithm adds
    :math:`\sigma B X`, and what y changes by goes through :math:`(y_{xy} / y_z, \log y_z)`.
    """
    seen = _seen(samples, state, pairs)
    views = samples.views[pairs]
    turn, _ = _second_from_first(state, views)
    scaled = state.scale[pairs, None, None] * samples.points[pairs, 1].double()
    own = seen.camera[:, 1]
    eye = torch.eye(3, dtype=torch.float64).expand(*own.shape, 3)
    by_pose = torch.cat(
        (
            -turn[:, None] @ _cross(scaled),
            turn[:, None].expand(*own.shape, 3),
            _cross(own),
            -eye,
            (turn[:, None] @ scaled.unsqueeze(-1)),
        ),
        dim=-1,
    )
    through = _through_projection(own) @ by_pose
    jacobian = torch.zeros(*seen.along.shape, 3, _SCALE + 1, dtype=torch.float64)
    second = jacobian[:, 1]
    second[..., :6] = through[..., :6]
    second[..., _OWN : _OWN + 6] = through[..., 6:12]
    second[..., _SCALE] = through[..., 12]
    jacobian[:, 0, :, 2, _SCALE] = 1.0
    plane = samples.offsets[views] / state.focal[views][..., None, None]
    for slot in range(2):
        jacobian[:, slot, :, 2, _OWN * slot + 6] = -1.0
        jacobian[:, slot, :, :2, 2 * _OWN + slot] = plane[:, slot]
    unit = jacobian.new_tensor([spread.across, spread.across, spread.along])
    jacobian = (jacobian / unit[:, None]).flatten(1, 3)
    residual = torch.cat((seen.across, seen.along.unsqueeze(-1)), dim=-1) / unit
    weights = _weights(samples, state, pairs, seen, spread)
    heavy = jacobian * weights.unsqueeze(-1).expand_as(residual).flatten(1).unsqueeze(-1)
    slope = -(heavy.transpose(1, 2) @ residual.flatten(1).unsqueeze(-1)).squeeze(-1)
    return heavy.transpose(1, 2) @ jacobian, slope


def _through_projection(camera: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """How x / z, y / z and log z change with a point; one behind the camera has no weight."""
    x, y, z = camera.unbind(-1)
    z = torch.where(z.abs() < 1e-9, 1e-9, z)
    zero, inverse = torch.zeros_like(z), 1 / z
    rows = (inverse, zero, -x / z**2, zero, inverse, -y / z**2, zero, zero, inverse)
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def _cross(vector: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """The matrix of the cross product with a vector."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    rows = (zero, -z, y, z, zero, -x, -y, x, zero)
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))
