r"""Features smoothed over the nearest Gaussians.

.. math:: \bar f_i = \frac{1}{k} \sum_{j \in N_k(i)} \frac{f_j}{\|f_j\|}

with the Gaussian itself among its k neighbours. What neighbours agree on stays; what one Gaussian
alone has learnt, from few pixels or from behind others, fades.
"""

import numpy as np
import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor
from torch.nn.functional import normalize

from splatseg.neighbours import NeighbourIndex
from splatseg.render import CompactRows, SparseWeights

_ROWS = 1 << 16
"""Gaussians smoothed at a time."""


class Smoother:
    """Means over the nearest Gaussians.

    Args:
        means: Centres of all Gaussians.
        neighbours: k, the Gaussian itself counted; 1 leaves features as they are.
    """

    def __init__(self, means: Float[Tensor, "n 3"], *, neighbours: int) -> None:
        count = len(means)
        k = min(neighbours, count)
        itself = torch.arange(count, dtype=torch.int32)[:, None]
        if k > 1:
            others = NeighbourIndex(means).nearest_others(k - 1).indices
            itself = torch.cat((itself, others.int()), dim=1)
        self._table: Int32[Tensor, "n k"] = itself

    def rows(
        self,
        gaussians: Int64[Tensor, "t"],
        *,
        drop: float = 0.0,
        rng: np.random.Generator | None = None,
    ) -> CompactRows:
        """The mean as a sparse map to some Gaussians.

        Args:
            gaussians: Those whose smoothed features are wanted.
            drop: Share of the other neighbours, in [0, 1), that is left out.
            rng: Draws which, the same ranks for all Gaussians.
        """
        table = self._table
        count = table.shape[1]
        if rng is not None and drop > 0 and count > 1:
            kept = max(1, round((1 - drop) * (count - 1)))
            drawn = 1 + np.sort(rng.choice(count - 1, kept, replace=False))
            columns = torch.from_numpy(np.concatenate(([0], drawn)))
            table = table[:, columns]
        picked = table[gaussians]
        share = torch.full((picked.numel(),), 1 / picked.shape[1])
        return SparseWeights(
            indptr=torch.arange(len(picked) + 1) * picked.shape[1],
            ids=picked.reshape(-1),
            weights=share,
            gaussians=len(table),
        ).compact()

    def smoothed(self, features: Float[Tensor, "n channels"]) -> Float[Tensor, "n channels"]:
        """All features with length 1, then smoothed."""
        unit = normalize(features, dim=1)
        found = torch.empty_like(unit)
        for start in range(0, len(unit), _ROWS):
            some = torch.arange(start, min(start + _ROWS, len(unit)))
            rows = self.rows(some)
            found[some] = rows.product(unit[rows.touched])
        return found
