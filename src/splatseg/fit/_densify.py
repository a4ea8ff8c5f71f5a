"""Where Gaussians are needed: dead ones move to living ones, new ones come beside them.

3DGS as Markov chain Monte Carlo (Kheradmand et al. 2024): a Gaussian that is joined by others
at its place shares its opacity and shrinks so that the picture hardly changes. (That faint ones
wander is part of the update of each step, see `_update`.)
"""

from functools import cache

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.fit._options import FitOptions
from splatseg.fit._parameters import Parameters

_MOST_COPIES = 51
# Opacities stay this far from 0 and 1 when they are shared, so that their logits are finite.
_LEAST_OPACITY = 0.005
_LEAST_TRANSPARENCY = 1e-6
# Growth of one round, as a share of what is there: copies need steps to grow apart.
_MOST_GROWTH = 0.5


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
    n = copies.clamp(1, _MOST_COPIES)
    opacity = opacities.double()
    shared = 1 - (1 - opacity) ** (1 / n)
    k = torch.arange(_MOST_COPIES, dtype=torch.float64, device=opacity.device)
    powers = shared[:, None] ** (k + 1) * (-1) ** k / (k + 1).sqrt()
    denominator = (powers * _binomial_sums().to(opacity.device)[n - 1]).sum(dim=1)
    return shared.to(opacities), (opacity / denominator).to(opacities)


@cache
def _binomial_sums() -> Tensor:
    """Row N - 1, column k: the sum over i = 1 .. N of binomial(i - 1, k)."""
    rows = torch.zeros(_MOST_COPIES, _MOST_COPIES, dtype=torch.float64)
    rows[:, 0] = 1
    for i in range(1, _MOST_COPIES):
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
    """New parameters and moments with dead Gaussians moved and new ones added.

    Where they go is drawn with the opacity as probability. Nothing given is changed, so an
    interrupted call leaves the fit as it was.

    Args:
        parameters: The Gaussians.
        first: Adam's first moments.
        second: Adam's second moments.
        count: How many Gaussians there should be; never fewer than there are.
        options: Opacity from which on one counts as dead.
        generator: Source of randomness, on the CPU.
    """
    opacities = parameters.logits.sigmoid().squeeze(1)
    dead = opacities <= options.dead_opacity
    if bool(dead.all()):
        return parameters, first, second
    added = max(0, min(count - len(parameters), int(_MOST_GROWTH * len(parameters))))
    targets = torch.cat(
        (
            dead.nonzero().squeeze(1),
            torch.arange(len(parameters), len(parameters) + added, device=dead.device),
        )
    )
    if not len(targets):
        return parameters, first, second
    sources = _draw(torch.where(dead, 0.0, opacities), len(targets), generator)

    copies = torch.bincount(sources, minlength=len(parameters)) + 1
    chosen = (copies > 1).nonzero().squeeze(1)
    shared, factor = shared_shape(opacities[chosen], copies[chosen])
    shared = shared.clamp(_LEAST_OPACITY, 1 - _LEAST_TRANSPARENCY)

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


def _draw(weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Indices with probability proportional to `weights`, with replacement."""
    # torch.multinomial stops at 2^24 categories; the inverse of the distribution does not.
    total = weights.double().cumsum(dim=0)
    at = torch.rand(count, generator=generator, dtype=torch.float64).to(weights.device)
    drawn = torch.searchsorted(total, at * total[-1], right=True)
    return drawn.clamp_max(len(weights) - 1)
