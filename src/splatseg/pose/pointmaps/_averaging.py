r"""All pairs at once: rotations, depths and centres by averaging over the graph.

Each is a least squares problem on the graph of pairs, with weights that leave out pairs that
contradict the others (Geman and McClure's). With :math:`R_n` of camera n, :math:`R_{mn}` of pair
(n, m), levels :math:`l`, logarithms of scale :math:`s` and baselines :math:`b`:

.. math::
    \delta_{mn} = \log(R_m R_{mn} R_n^T) &\approx \omega_n - \omega_m \\
    L_n - L_m &= l_{n,e} - l_{m,e}, \qquad s_e = L_n - l_{n,e} \\
    c_m - c_n &= e^{s_e} R_n b_e

References:
    Chatterjee and Govindu, Robust relative rotation averaging, PAMI 2018.
    Wilson and Snavely, Robust global translations with 1DSfM, ECCV 2014.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.pose.pointmaps._geometry import PairGeometry
from splatseg.pose.pointmaps._samples import PairSamples
from splatseg.pose.pointmaps._start import World, rotation_of_vector, rotation_vector

_STEPS = 20
_MIN_ANGLE = math.radians(0.2)
_MIN_LEVEL = 0.005
_MIN_BASE = 0.005
"""Residuals of pairs that count as none: angle, logarithm of scale, share of the baseline."""

_LEAST_WEIGHT = 1e-9


def average(samples: PairSamples, geometry: PairGeometry, start: World) -> World:
    """Improve a world that a tree of pairs gave by all pairs."""
    first, second = samples.first, samples.second
    rotation, trust = _rotations(samples, geometry, start.rotation)
    level, trust = _levels(samples, geometry, start.level, trust)
    log_scale = 0.5 * (level[samples.views] - geometry.levels).sum(dim=1)
    base = (rotation[first] @ geometry.centre.unsqueeze(-1)).squeeze(-1)
    steps = log_scale.exp().unsqueeze(-1) * base
    centre = start.centre
    length = steps.norm(dim=-1).clamp_min(1e-12)
    # A short baseline is as uncertain as the depths are, not as it is short.
    length = torch.maximum(length, 0.1 * length.median())
    for _ in range(_STEPS):
        residual = (centre[second] - centre[first] - steps).norm(dim=-1) / length
        weights = _held(trust * geman_mcclure(residual, _MIN_BASE)) / length.square()
        centre = graph_solve(first, second, steps, weights, len(centre))
    return World(rotation=rotation, centre=centre, level=level)


def geman_mcclure(
    residual: Float[Tensor, "pairs"], least: float, *, times: float = 3.0
) -> Float[Tensor, "pairs"]:
    """Weights of residuals: 1 of none, a quarter at `times` the median, little far beyond."""
    scale = times * max(float(residual.median()), least)
    return (1 + (residual / scale).square()).square().reciprocal()


def graph_solve(
    first: Tensor,
    second: Tensor,
    differences: Float[Tensor, "pairs channels"],
    weights: Float[Tensor, "pairs"],
    count: int,
) -> Float[Tensor, "views channels"]:
    """Values of which the second's minus the first's are nearest to `differences`; mean 0.

    Pairs with weights must connect all of them.
    """
    laplacian = torch.zeros(count, count, dtype=torch.float64)
    flat = laplacian.view(-1)
    flat.index_add_(0, first * count + first, weights)
    flat.index_add_(0, second * count + second, weights)
    flat.index_add_(0, first * count + second, -weights)
    flat.index_add_(0, second * count + first, -weights)
    right = torch.zeros(count, differences.shape[1], dtype=torch.float64)
    right.index_add_(0, second, weights.unsqueeze(-1) * differences)
    right.index_add_(0, first, -weights.unsqueeze(-1) * differences)
    # Adding 1 1^T fixes what differences leave open, the mean, at 0.
    return torch.linalg.solve(laplacian + weights.mean() / count, right)


def _held(weights: Tensor) -> Tensor:
    """A pair without weight still holds its ends together where nothing else does."""
    return weights.clamp_min(_LEAST_WEIGHT)


def _rotations(
    samples: PairSamples, geometry: PairGeometry, rotation: Tensor
) -> tuple[Tensor, Tensor]:
    first, second = samples.first, samples.second
    weights = torch.ones(len(samples), dtype=torch.float64)
    for _ in range(_STEPS):
        between = rotation[second] @ geometry.rotation @ rotation[first].transpose(1, 2)
        delta = rotation_vector(between)
        weights = geman_mcclure(delta.norm(dim=-1), _MIN_ANGLE)
        step = graph_solve(first, second, -delta, _held(weights), len(rotation))
        rotation = rotation_of_vector(step) @ rotation
    return rotation, weights


def _levels(
    samples: PairSamples, geometry: PairGeometry, level: Tensor, trust: Tensor
) -> tuple[Tensor, Tensor]:
    first, second = samples.first, samples.second
    wanted = geometry.levels[:, 1] - geometry.levels[:, 0]
    weights = trust
    for _ in range(_STEPS):
        residual = (level[second] - level[first] - wanted).abs()
        weights = trust * geman_mcclure(residual, _MIN_LEVEL)
        level = graph_solve(first, second, wanted[:, None], _held(weights), len(level))[:, 0]
    return level, weights
