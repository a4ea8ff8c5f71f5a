r"""Global alignment as published (eq. 5): Adam on all of it.

.. math:: \min \sum_e \sum_{v \in e} \sum_i w_i^{v,e} \| \chi_i^v - \sigma_e P_e X_i^{v,e} \|

Unknowns are each photograph's pose, focal length and depths, and each pair's pose and scale; the
scales are divided by their geometric mean in every step, so that their product is one. Settings are
those of DUSt3R's code: 300 steps, a rate of 0.01 that falls to 1e-6 along a cosine, betas 0.9 and
0.9, logarithms of depth, focal length (20 times the rate) and scale, confidences as their
logarithms. It works on the sampled pixels, as `_align` does.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from splatseg.core.rigid import quaternion_from_rotation, rotation_from_quaternion
from splatseg.pose.pointmaps._align import Aligned, pair_residuals, place_pairs
from splatseg.pose.pointmaps._samples import PairSamples

_RATE = 0.01
_LAST_RATE = 1e-6
_BETAS = (0.9, 0.9)
_FOCAL_FACTOR = 20.0


def align_by_gradients(
    samples: PairSamples,
    start: Aligned,
    *,
    iterations: int,
    progress: Callable[[int, int], None],
) -> Aligned:
    """Improve a start by gradients; all pairs count alike.

    Args:
        samples: The pairs.
        start: Where to begin; its pairs are placed first.
        iterations: Steps.
        progress: Told of steps.
    """
    every = torch.arange(len(samples))
    placed = place_pairs(samples, start, every)
    # In units in which depths are about one, so that the rate means the same everywhere.
    unit = float(placed.depth.median())
    unknowns = {
        "turn": quaternion_from_rotation(placed.rotation),
        "centre": placed.centre / unit,
        "focal": placed.focal.log() * _FOCAL_FACTOR,
        "depth": (placed.depth / unit).log(),
        "scale": (placed.scale / unit).log(),
        "pair_turn": quaternion_from_rotation(placed.pair_rotation),
        "pair_translation": placed.pair_translation / unit,
    }
    unknowns = {name: value.clone().requires_grad_() for name, value in unknowns.items()}
    optimiser = torch.optim.Adam(unknowns.values(), lr=_RATE, betas=_BETAS)
    for step in range(iterations):
        share = step / max(1, iterations - 1)
        rate = _LAST_RATE + (_RATE - _LAST_RATE) * (1 + math.cos(math.pi * share)) / 2
        for group in optimiser.param_groups:
            group["lr"] = rate
        optimiser.zero_grad()
        loss = _loss(samples, _state(start, unknowns, samples))
        torch.autograd.backward(loss)
        optimiser.step()
        progress(step + 1, iterations)
    found = {name: value.detach() for name, value in unknowns.items()}
    state = _state(start, found, samples)
    weight = torch.ones(len(samples), dtype=torch.float64)
    return replace(state, residual=pair_residuals(samples, state, every), weight=weight)


def _state(start: Aligned, unknowns: dict[str, Tensor], samples: PairSamples) -> Aligned:
    """The world that the unknowns stand for, in the unit in which the scales' product is one."""
    logs = unknowns["scale"]
    unit = logs.mean().exp()
    count = int(samples.lenses.max()) + 1
    members = torch.nn.functional.one_hot(samples.lenses, count).double()
    focal = (members.T @ unknowns["focal"]) / members.sum(dim=0).clamp_min(1) / _FOCAL_FACTOR
    return replace(
        start,
        rotation=rotation_from_quaternion(unknowns["turn"]),
        centre=unknowns["centre"] / unit,
        focal=focal[samples.lenses].exp(),
        depth=unknowns["depth"].exp() / unit,
        scale=(logs - logs.mean()).exp(),
        pair_rotation=rotation_from_quaternion(unknowns["pair_turn"]),
        pair_translation=unknowns["pair_translation"] / unit,
    )


def _loss(samples: PairSamples, state: Aligned) -> Tensor:
    views = samples.views
    points = samples.points.double().flatten(1, 2)
    target = state.points(samples, views.flatten()).reshape(points.shape)
    turned = points @ state.pair_rotation.transpose(1, 2)
    placed = state.scale[:, None, None] * turned + state.pair_translation[:, None]
    return (samples.weights.double().flatten(1, 2) * (target - placed).norm(dim=-1)).mean()
