r"""Samples of rays composited front to back: eq. 5, with what is behind them all.

.. math:: \hat c_r = \sum_{j=1}^L T_j \sigma_j c_j + T_{L+1} c_{bg}, \qquad
          T_j = \prod_{i<j} (1 - \sigma_i)

`splatseg.street.radiance.reference` is the readable twin, ray by ray.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def ray_weights(
    opacity: Float[Tensor, "n hits"],
) -> tuple[Float[Tensor, "n hits"], Float[Tensor, "n"]]:
    r"""The weights :math:`T_j \sigma_j` of the samples of rays, and what passes them all.

    Args:
        opacity: In [0, 1], front to back; 0 where a ray has no sample.
    """
    passed = torch.ones_like(opacity[:, 0])
    weights: list[Tensor] = []
    for one in opacity.unbind(dim=1):
        weights.append(passed * one)
        passed = passed * (1 - one)
    return torch.stack(weights, dim=1), passed


def composite(
    opacity: Float[Tensor, "n hits"],
    values: Float[Tensor, "n hits c"],
    background: Float[Tensor, "n c"],
) -> Float[Tensor, "n c"]:
    """What rays show: values of samples, front to back, then the background."""
    weights, passed = ray_weights(opacity)
    return torch.einsum("nl,nlc->nc", weights, values) + passed[:, None] * background
