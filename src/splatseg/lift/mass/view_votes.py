r"""Whether views err independently of each other: the votes of each on a sample of Gaussians.

A vote over many views removes errors that are independent from view to view, and a model of
such errors can infer what is usually missed (`confusion`). A network that calls a desk a
nightstand from one side does so in all neighbouring views, and there both fail. So each view is
held out in turn: is its vote on a Gaussian predicted better by its nearest view than by any other?

.. math:: \rho = \frac{\sum_i (a_i - e_i)}{\sum_i (1 - e_i)}

where, among the views that give Gaussian i one of its two strongest ids, :math:`a_i` is the
share of those that agree with the nearest other view, as seen from the Gaussian, and
:math:`e_i` that of all pairs that agree. Independent errors have 0, errors that neighbours always
share have 1 (Cohen's kappa of neighbouring views).

References:
    Cohen, A Coefficient of Agreement for Nominal Scales (1960), eq. 1.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int, Int64
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import UNLABELLED, Camera

_SAMPLE = 32768
"""Gaussians that are sampled, in even steps through their order."""

_CONTESTED = 2048
"""Contested ones among them that are compared, in even steps too."""

_CONTESTED_SHARE = 0.2
"""Least share of the second strongest id of a Gaussian on which views disagree."""

_MIN_VIEWS = 3
"""Views that must give a Gaussian one of its two ids."""

_MIN_GAUSSIANS = 30
"""Contested Gaussians below which there is no estimate."""


class ViewVotes:
    """The id that most of a view's votes give each Gaussian of a sample, view by view.

    Memory is 8 bytes for each of the sample and each view that votes for it: 40 MB for a thousand
    views that see a seventh of the scene each.

    Args:
        means: Centres of the Gaussians, (n, 3).
    """

    def __init__(self, means: Float[Tensor, "n 3"]) -> None:
        step = max(1, -(-len(means) // _SAMPLE))
        self._rows = torch.arange(0, len(means), step)
        self._index = torch.full((len(means),), -1, dtype=torch.int32)
        self._index[self._rows] = torch.arange(len(self._rows), dtype=torch.int32)
        self._means = means[self._rows].detach().cpu().double().numpy()
        self._parts: list[tuple[Tensor, Tensor, Tensor]] = []
        self._views: list[tuple[NDArray[np.int32], NDArray[np.int32]]] = []
        self._centres: list[NDArray[np.float64]] = []

    def add(
        self, ids: Sequence[int], sums: Float[Tensor, "m ids"], *, rows: Int64[Tensor, "m"]
    ) -> None:
        """Take in votes of the view at hand, one column an id."""
        index = self._index[rows]
        known = torch.nonzero(index >= 0).squeeze(1)
        row, column = torch.nonzero(sums[known] > 0, as_tuple=True)
        column_ids = torch.tensor(list(ids), dtype=torch.int64)
        self._parts.append((index[known][row], column_ids[column], sums[known][row, column]))

    def add_sparse(
        self, ids: Int64[Tensor, "m"], gaussians: Int64[Tensor, "m"], weights: Float[Tensor, "m"]
    ) -> None:
        """Take in votes of the view at hand as triples."""
        index = self._index[gaussians]
        known = (index >= 0) & (weights > 0)
        self._parts.append((index[known], ids[known], weights[known]))

    def end_view(self, camera: Camera) -> None:
        """Keep the strongest id of each Gaussian; what comes next is another view's."""
        columns = [torch.cat(column).numpy() for column in zip(*self._parts, strict=True)]
        self._parts = []
        if not columns:
            return
        index, ids, weights = columns
        # Equals go to the smaller id.
        order = np.lexsort((ids, -weights, index))
        index, ids = index[order], ids[order]
        first = np.flatnonzero(np.diff(index, prepend=-1))
        self._views.append((index[first].astype(np.int32), ids[first].astype(np.int32)))
        self._centres.append(camera.centre.double().numpy())

    def correlation(
        self, candidates: Int[Tensor, "n k"], shares: Float[Tensor, "n k"]
    ) -> float | None:
        """The agreement rho of neighbouring views, at most 1; None where too little is contested.

        Args:
            candidates: The strongest ids of each Gaussian, two or more.
            shares: Their shares of the votes.
        """
        top_two = candidates[self._rows, :2].cpu().numpy()
        contested = (shares[self._rows, 1].cpu().numpy() >= _CONTESTED_SHARE) & (
            top_two[:, 1] != UNLABELLED
        )
        chosen = np.flatnonzero(contested)
        if len(chosen) > _CONTESTED:
            chosen = chosen[np.linspace(0, len(chosen) - 1, _CONTESTED).astype(np.int64)]
        votes = self._votes_of(chosen)
        centres = np.array(self._centres).reshape(-1, 3)
        excess = max_excess = 0.0
        used = 0
        for view_ids, sample_row in zip(votes, chosen.tolist(), strict=True):
            views = np.flatnonzero(
                (view_ids == top_two[sample_row, 0]) | (view_ids == top_two[sample_row, 1])
            )
            votes_second = view_ids[views] == top_two[sample_row, 1]
            if len(views) < _MIN_VIEWS or votes_second.all() or not votes_second.any():
                continue
            expected = _agreement_by_chance(votes_second)
            nearest = _nearest(centres[views] - self._means[sample_row])
            excess += float((votes_second == votes_second[nearest]).mean()) - expected
            max_excess += 1 - expected
            used += 1
        return excess / max_excess if used >= _MIN_GAUSSIANS else None

    def _votes_of(self, chosen: NDArray[np.int64]) -> NDArray[np.int32]:
        """The id each view votes for, (chosen, views), -1 where it has no vote."""
        row_of = np.full(len(self._rows), -1)
        row_of[chosen] = np.arange(len(chosen))
        votes = np.full((len(chosen), len(self._views)), UNLABELLED, np.int32)
        for view, (index, ids) in enumerate(self._views):
            rows = row_of[index]
            votes[rows[rows >= 0], view] = ids[rows >= 0]
        return votes


def _agreement_by_chance(votes_second: NDArray[np.bool_]) -> float:
    """Share of all pairs of views that vote for the same id."""
    count, seconds = len(votes_second), int(votes_second.sum())
    firsts = count - seconds
    return (seconds * (seconds - 1) + firsts * (firsts - 1)) / (count * (count - 1))


def _nearest(offsets: NDArray[np.float64]) -> NDArray[np.int64]:
    """The view most like each, by the direction and the logarithm of the distance seen from."""
    distance = np.maximum(np.linalg.norm(offsets, axis=1), 1e-12)
    directions = offsets / distance[:, None]
    difference = -directions @ directions.T
    difference += 2 * np.abs(np.log(distance[:, None] / distance[None, :]))
    np.fill_diagonal(difference, np.inf)
    return difference.argmin(axis=1)
