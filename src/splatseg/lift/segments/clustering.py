r"""Segments of many views joined into instances by how well they agree on Gaussians.

Two groups of segments A and B are compared wherever a segment of one meets a view of the other:

.. math:: I(A, B) = \sum_{a \in A} \sum_{b \in B} I(a, b), \qquad
          U(A, B) = \sum_{a \in A} \sum_{b \in B}
                    \bigl(m(a \mid v_b) + m(b \mid v_a) - I(a, b)\bigr)

with :math:`I(a, b)` the mass that both cover and :math:`m(a \mid v)` the mass of a that view v
sees at all, so that what is hidden or out of the picture in one of the views counts for neither
side. Their ratio is the mean intersection over union of all pairs, weighted by size. Groups that
are each other's best join, round after round, while the ratio is at least a threshold. Segments
of one view share nothing and see all of each other, so that to join them costs what it should
and is not forbidden: where a model split an object in one view, the other views outvote it.

Where segments of a view may lie inside each other, that says that they are of different levels
(`lift.segments.nesting`), and so of different groups: two groups stay apart if their segments
contradict each other so in more than a fifth of the views of the smaller.

No step looks at names, ids or the order of the views. Ties go to the earlier segment.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg.lift.segments.pairs import join_pairs, seen_by

_ROUNDS = 1000

_PAIRS = 1 << 20
"""Pairs that are compared at a time."""

_MAX_CONFLICT = 0.2
"""Two groups stay apart if they contradict each other in more of the views of the smaller: that
leaves room for a mask that is wrong now and then, and none for two levels."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Agreement:
    """What pairs of segments share, and what each view sees of each segment."""

    shared: Any
    """Sparse symmetric (segments, segments): I(a, b). The diagonal means nothing."""

    seen: Any
    """Sparse (segments, views): m(a | v)."""

    view: NDArray[np.int64]
    """(segments,): the view that each segment comes from."""


def cluster(agreement: Agreement, threshold: float, *, conflicts: Any = None) -> NDArray[np.int64]:
    """The group of each segment, numbered in the order of each group's first segment.

    Args:
        agreement: How segments overlap.
        threshold: Least ratio at which two groups join, in (0, 1].
        conflicts: Sparse symmetric (segments, segments), 1 where two segments of a view cannot
            be of one group; None where there are no such pairs.
    """
    import scipy.sparse

    count, views = agreement.seen.shape
    every = np.arange(count)
    seen: Any = scipy.sparse.csr_matrix(agreement.seen, dtype=np.float64)
    members: Any = scipy.sparse.csr_matrix(
        (np.ones(count), (every, agreement.view)), shape=(count, views)
    )
    candidates = _Candidates(_upper(agreement.shared), seen, members, threshold)
    if conflicts is not None:
        candidates.conflicts = _upper(conflicts)
    group = every
    candidates.update(every, np.ones(count, bool))
    for _ in range(_ROUNDS):
        target = candidates.mutual_best()
        if target is None:
            break
        changed = target != every
        changed[target[changed]] = True
        join: Any = scipy.sparse.csr_matrix((np.ones(count), (target, every)), shape=(count, count))
        candidates.seen, candidates.members = join @ candidates.seen, join @ candidates.members
        candidates.update(target, changed)
        group = target[group]
    return np.unique(group, return_inverse=True)[1]


def _upper(pairs: Any) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """The pairs above the diagonal of a symmetric sparse matrix."""
    entries = pairs.tocoo()
    above = (entries.row < entries.col) & (entries.data > 0)
    return entries.row[above], entries.col[above], entries.data[above]


class _Candidates:
    """Pairs of groups, and which of them may join; groups are named after their first segment."""

    def __init__(
        self,
        pairs: tuple[NDArray[Any], NDArray[Any], NDArray[Any]],
        seen: Any,
        members: Any,
        threshold: float,
    ) -> None:
        self.row, self.column, self.shared = pairs
        self.ratio = np.zeros(len(self.row))
        """0 for pairs that do not join."""
        self.seen, self.members = seen, members
        self.conflicts: tuple[NDArray[Any], NDArray[Any], NDArray[Any]] | None = None
        self._threshold = threshold

    def update(self, target: NDArray[Any], changed: NDArray[np.bool_]) -> None:
        """Join groups, and compare those that changed with all others anew."""
        touched = changed[self.row] | changed[self.column]
        row, column, shared = join_pairs(
            self.row[touched], self.column[touched], self.shared[touched], target
        )
        if self.conflicts is not None:
            self.conflicts = join_pairs(*self.conflicts, target)
        kept = ~touched
        self.row = np.concatenate((self.row[kept], row))
        self.column = np.concatenate((self.column[kept], column))
        self.shared = np.concatenate((self.shared[kept], shared))
        ratio = self.ratio[kept]
        del row, column, shared, touched, kept
        new = slice(len(ratio), None)
        found = self._ratios(self.row[new], self.column[new], self.shared[new])
        self.ratio = np.concatenate((ratio, found))

    def _ratios(
        self, row: NDArray[Any], column: NDArray[Any], shared: NDArray[Any]
    ) -> NDArray[np.float64]:
        """Ratios of pairs, each by itself, some at a time: 0 for those that do not join."""
        ratio = np.empty(len(row))
        for start in range(0, len(row), _PAIRS):
            some = slice(start, start + _PAIRS)
            ratio[some] = self._some_ratios(row[some], column[some], shared[some])
        return ratio

    def _some_ratios(
        self, row: NDArray[Any], column: NDArray[Any], shared: NDArray[Any]
    ) -> NDArray[np.float64]:
        union = seen_by(self.seen, self.members, row, column)
        union += seen_by(self.seen, self.members, column, row) - shared
        ratio = shared / np.maximum(union, 1e-12)
        enough = np.flatnonzero(ratio >= self._threshold)
        joins = enough[self._compatible(row[enough], column[enough])]
        found = np.zeros(len(ratio))
        found[joins] = ratio[joins]
        return found

    def _compatible(self, row: NDArray[Any], column: NDArray[Any]) -> NDArray[np.bool_]:
        """Whether the segments of two groups contradict each other in few of the views."""
        if self.conflicts is None or not len(self.conflicts[0]):
            return np.ones(len(row), bool)
        one, other, times = self.conflicts
        count = self.seen.shape[0]
        keys = one.astype(np.int64) * count + other  # ascending
        wanted = row.astype(np.int64) * count + column
        index = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        against = np.where(keys[index] == wanted, times[index], 0.0)
        views = np.diff(self.members.indptr)
        return against <= _MAX_CONFLICT * np.minimum(views[row], views[column])

    def mutual_best(self) -> NDArray[Any] | None:
        """Where each group goes: to the earlier of two that are each other's best, or None."""
        enough = np.flatnonzero(self.ratio >= self._threshold)
        if not len(enough):
            return None
        row, column, ratio = self.row[enough], self.column[enough], self.ratio[enough]
        one = np.concatenate((row, column))
        other = np.concatenate((column, row))
        value = np.concatenate((ratio, ratio))
        count = self.seen.shape[0]
        highest = np.zeros(count)
        np.maximum.at(highest, one, value)
        ties = np.flatnonzero(value == highest[one])
        best = np.full(count, count)
        np.minimum.at(best, one[ties], other[ties])
        best[best == count] = -1
        target = np.arange(count)
        has = np.flatnonzero(best >= 0)
        mutual = has[best[best[has]] == has]
        target[mutual] = np.minimum(mutual, best[mutual])
        return target
