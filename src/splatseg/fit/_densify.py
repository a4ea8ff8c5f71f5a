"""Density control of 3DGS-MCMC: dead Gaussians are relocated to live ones, and new ones are added.

3DGS as Markov chain Monte Carlo (Kheradmand et al. 2024): when several Gaussians share one
position, their opacities and scales are reduced so that the rendered image hardly changes. (The
noise added to the centres is part of each step's update, see `_update`.)
"""

from functools import cache

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.fit._options import FitOptions
from splatseg.fit._parameters import Parameters

_MAX_COPIES = 51
# Shared opacities are kept this far from 0 and 1, so that their logits are finite.
_MIN_OPACITY = 0.005
_MIN_TRANSPARENCY = 1e-6
# Largest growth of one round, as a share of the current number: copies need steps to diverge.
_MAX_GROWTH = 0.5


def shared_shape(
    opacities: Float[Tensor, "n"], copies: Int64[Tensor, "n"]
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    r"""Opacity of each of N copies of a Gaussian, and the factor of their scales.

    Their blend equals the one Gaussian at its centre, and in the integral along a line
    (Kheradmand et al. 2024, eq. 9):

    .. math:: o' = 1 - (1 - o)^{1/N}, \qquad
              \frac{s'}{s} = \frac{o}{\sum_{i=1}^{N} \sum_{k=0}^{i-1} \binom{i-1}{k}
              \frac{(-1)^k o'^{k+1}}{\sqrt{k+1}}}

    Args:
        opacities: In (0, 1).
        copies: N, at least 1; more than 51 count as 51, where the alternating sum is exact.
    """
    n = copies.clamp(1, _MAX_COPIES)
    opacity = opacities.double()
    shared = 1 - (1 - opacity) ** (1 / n)
    k = torch.arange(_MAX_COPIES, dtype=torch.float64, device=opacity.device)
    powers = shared[:, None] ** (k + 1) * (-1) ** k / (k + 1).sqrt()
    denominator = (powers * _binomial_sums().to(opacity.device)[n - 1]).sum(dim=1)
    return shared.to(opacities), (opacity / denominator).to(opacities)


@cache
def _binomial_sums() -> Tensor:
    """Row N - 1, column k: the sum over i = 1 .. N of binomial(i - 1, k)."""
    rows = torch.zeros(_MAX_COPIES, _MAX_COPIES, dtype=torch.float64)
    rows[:, 0] = 1
    for i in range(1, _MAX_COPIES):
        rows[i, 1:] = rows[i - 1, 1:] + rows[i - 1, :-1]
    return rows.cumsum(dim=0)


def relocated(
    parameters: Parameters,
    first: Parameters,
    second: Parameters,
    *,
    count: int,
    options: FitOptions,
    generator: torch.Generator,
) -> tuple[Parameters, Parameters, Parameters]:
    """Parameters and moments with dead Gaussians relocated and new ones added.

    Targets are sampled with probability proportional to opacity. The arguments are not changed,
    so an interrupted call leaves the fit as it was.

    Args:
        parameters: The Gaussians.
        first: Adam's first moments.
        second: Adam's second moments.
        count: How many Gaussians there should be; never fewer than there are.
        options: Opacity up to which a Gaussian counts as dead.
        generator: Source of randomness, on the CPU.
    """
    opacities = parameters.logits.sigmoid().squeeze(1)
    dead = opacities <= options.dead_opacity
    if bool(dead.all()):
        return parameters, first, second
    added = max(0, min(count - len(parameters), int(_MAX_GROWTH * len(parameters))))
    targets = torch.cat(
        (
            dead.nonzero().squeeze(1),
            torch.arange(len(parameters), len(parameters) + added, device=dead.device),
        )
    )
    if not len(targets):
        return parameters, first, second
    sources = _sampled_indices(torch.where(dead, 0.0, opacities), len(targets), generator)

    copies = torch.bincount(sources, minlength=len(parameters)) + 1
    chosen = (copies > 1).nonzero().squeeze(1)
    shared, factor = shared_shape(opacities[chosen], copies[chosen])
    shared = shared.clamp(_MIN_OPACITY, 1 - _MIN_TRANSPARENCY)

    grown = parameters.with_zeros(added)
    grown.logits[chosen] = shared.logit()[:, None]
    grown.log_scales[chosen] += factor.log()[:, None]
    moments = (first.with_zeros(added), second.with_zeros(added))
    for _, tensor in grown.tensors():
        tensor[targets] = tensor[sources]
    for moment in moments:
        for _, tensor in moment.tensors():
            tensor[targets] = 0
            tensor[chosen] = 0
    return grown, *moments


def _sampled_indices(weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Indices with probability proportional to `weights`, with replacement."""
    # torch.multinomial stops at 2^24 categories; the inverse of the distribution does not.
    total = weights.double().cumsum(dim=0)
    quantiles = torch.rand(count, generator=generator, dtype=torch.float64).to(weights.device)
    indices = torch.searchsorted(total, quantiles * total[-1], right=True)
    return indices.clamp_max(len(weights) - 1)
