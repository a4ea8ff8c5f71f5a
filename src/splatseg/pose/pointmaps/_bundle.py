r"""A damped step over cameras, focal lengths, mean depths and scales of pairs at once.

With :math:`B = R_m^T R_n` for the pair (n, m), the point y in the second camera changes by

.. math::
    dy = [y]_\times \omega_m - \tau_m - \sigma B [X]_\times \omega_n + B \tau_n
         + \sigma B X \, d \log \sigma

for turns :math:`R \to R \exp [\omega]_\times` and moves :math:`c \to c + R \tau`; the point in the
first changes with the scale alone. Scales are eliminated pair by pair (Schur complement), so that
the normal equations have seven unknowns a photograph and one a lens.

References:
    Triggs, McLauchlan, Hartley and Fitzgibbon, Bundle adjustment: a modern synthesis, 1999.
"""

from dataclasses import replace

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.pose.pointmaps._align import Aligned
from splatseg.pose.pointmaps._geometry import ray_directions
from splatseg.pose.pointmaps._residuals import Problem, second_from_first, seen
from splatseg.pose.pointmaps._start import rotation_of_vector

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
        -turn @ _cross(scaled),
        turn.expand(shape),
        _cross(second),
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


def _cross(vector: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """The matrix of the cross product with a vector."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    rows = (zero, -z, y, z, zero, -x, -y, x, zero)
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))
