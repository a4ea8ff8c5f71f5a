"""Of groups of overlapping masks, those that make one label of every Gaussian."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg.lift.segments.clustering import Agreement
from splatseg.lift.segments.table import SegmentTable

_MOST = 0.5

_MIN_VISIBILITY = 0.3
"""A view could have seen a group if it sees this share of what the group's best view does."""


def chosen_groups(
    table: SegmentTable, agreement: Agreement, group: NDArray[np.int64], *, overlap: float
) -> NDArray[np.int64]:
    """Groups that are taken keep their number, the others become -1.

    The groups come in the order of their support: the share of the views which could have seen
    them that did, times how well their segments agree. The larger comes first among equals.

    Args:
        table: The segments.
        agreement: How they overlap.
        group: The group of each segment, -1 for none.
        overlap: A group is left out if more than this share of it is covered already.
    """
    import scipy.sparse

    count = int(group.max(initial=-1)) + 1
    if count == 0:
        return group
    there = group >= 0
    mass = table.votes(group, np.ones(len(group)))
    joined: Any = scipy.sparse.csr_matrix(
        (np.ones(int(there.sum())), (group[there], np.flatnonzero(there))),
        shape=(count, len(group)),
    )
    support = _support(table, agreement, group, joined)
    whole = np.asarray(mass.sum(axis=0)).ravel()
    cores = _Cores(table, group, mass)
    covered = np.zeros(table.gaussians, bool)
    taken = np.zeros(count, bool)
    for place in np.lexsort((-whole, -support)).tolist():
        rows, weights = cores.of(place)
        size = weights.sum()
        if size > 0 and weights[covered[rows]].sum() <= overlap * size:
            taken[place] = True
            covered[rows] = True
    return np.where(there & taken[group], group, -1)


class _Cores:
    """The Gaussians that a group really holds: most of what its own views see of them.

    A single mask that spills over a neighbour does not make the neighbour a part of the group.
    """

    def __init__(self, table: SegmentTable, group: NDArray[np.int64], mass: Any) -> None:
        self._mass = mass.tocsc()
        self._seen = table.sights().power(2)
        there = group >= 0
        pairs = np.unique(np.stack((group[there], table.view[there])), axis=1)
        self._views = np.split(pairs[1], np.searchsorted(pairs[0], np.arange(1, mass.shape[1])))

    def of(self, place: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Rows of the Gaussians of a group, and the square roots of their masses."""
        entries = slice(self._mass.indptr[place], self._mass.indptr[place + 1])
        rows, mass = self._mass.indices[entries], self._mass.data[entries]
        seen = np.asarray(self._seen[:, self._views[place]].sum(axis=1)).ravel()
        holds = mass >= _MOST * seen[rows]
        return rows[holds], np.sqrt(mass[holds])


def _support(
    table: SegmentTable, agreement: Agreement, group: NDArray[np.int64], joined: Any
) -> NDArray[np.float64]:
    """How much speaks for each group, in [0, 1]."""
    count = joined.shape[0]
    members = np.bincount(group[group >= 0], minlength=count)
    sight = (joined @ agreement.seen).toarray() / np.maximum(members, 1)[:, None]
    could = sight >= _MIN_VISIBILITY * sight.max(axis=1, keepdims=True)
    did = np.zeros_like(could)
    there = group >= 0
    did[group[there], table.view[there]] = True
    seen = (could & did).sum(axis=1) / np.maximum(could.sum(axis=1), 1)
    inner = joined @ agreement.shared @ joined.T
    own = joined.multiply(agreement.shared.diagonal()[None, :]).sum(axis=1)
    both = inner.diagonal() - np.asarray(own).ravel()
    views: Any = np.zeros((count, len(table.views)))
    np.add.at(views, (group[there], table.view[there]), 1)
    # All ordered pairs of two different segments of the group.
    within = agreement.seen.tocsr()[np.flatnonzero(there), table.view[there]]
    itself = np.bincount(group[there], np.asarray(within).ravel(), minlength=count)
    union = 2 * ((sight * members[:, None]) * views).sum(axis=1) - 2 * itself - both
    return seen * np.where(union > 0, both / np.maximum(union, 1e-12), 0)
