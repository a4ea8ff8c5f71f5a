"""The neighbour term that identities are trained with, see `lift.identity`."""

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.neighbours import NeighbourIndex

_TINY = 1e-10
"""Added to probabilities before their logarithm, as published."""


class NeighbourLoss:
    r"""How far Gaussians' ids are from those of their neighbours in space.

    .. math:: \frac{1}{C} \, \mathrm{mean}_{i, j \in N_k(i)}
              \sum_c q_{ic} (\log q_{ic} - \log q_{jc})

    Args:
        means: Centres of all Gaussians.
        neighbours: k, a Gaussian itself counted.
        points: Gaussians that take part at most; more are drawn from once and for all.
        rng: Draws them.
    """

    def __init__(
        self,
        means: Float[Tensor, "n 3"],
        *,
        neighbours: int,
        points: int,
        rng: np.random.Generator,
    ) -> None:
        kept = np.arange(len(means))
        if len(means) > points:
            kept = np.sort(rng.choice(len(means), points, replace=False))
        self._kept = kept
        self._index = NeighbourIndex(means[torch.from_numpy(kept)])
        self._neighbours = min(neighbours, len(kept))

    def draw(self, samples: int, rng: np.random.Generator) -> Int64[Tensor, "samples k"]:
        """Some Gaussians' neighbours, nearest first: each itself, then the nearest others.

        Fewer than asked for are drawn where there are fewer.
        """
        count = min(samples, len(self._kept))
        drawn = rng.choice(len(self._kept), count, replace=False)
        rows = torch.from_numpy(drawn)
        near = rows[:, None]
        if self._neighbours > 1:
            others = self._index.nearest_others(self._neighbours - 1, rows=rows)
            near = torch.cat((near, others.indices), dim=1)
        return torch.from_numpy(self._kept)[near]

    def loss(
        self,
        features: Float[Tensor, "m channels"],
        pairs: Int64[Tensor, "samples k"],
        weight: Float[Tensor, "classes channels"],
        bias: Float[Tensor, "classes"],
    ) -> Float[Tensor, ""]:
        """The term, for rows `pairs` of `features`: each row's first against all of it."""
        probabilities = torch.softmax(features @ weight.T + bias, dim=-1)
        logs = torch.log(probabilities + _TINY)
        own = pairs[:, :1]
        divergence = (probabilities[own] * (logs[own] - logs[pairs])).sum(dim=-1)
        return divergence.mean() / len(bias)
