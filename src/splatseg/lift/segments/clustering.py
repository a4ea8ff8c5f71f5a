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

_ROUNDS = 1000
_PAIRS = 1 << 17
"""Pairs of groups whose unions are computed at a time."""

_DENSE = 0.002
"""Share of all pairs above which the unions of all are computed, as products of dense blocks."""

_BLOCK = 512
"""Rows of such a block."""

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
    group = np.arange(count)
    shared: Any = scipy.sparse.csr_matrix(agreement.shared, dtype=np.float64)
    seen: Any = scipy.sparse.csr_matrix(agreement.seen, dtype=np.float64)
    members: Any = scipy.sparse.csr_matrix(
        (np.ones(count), (group, agreement.view)), shape=(count, views)
    )
    apart: Any = None if conflicts is None else scipy.sparse.csr_matrix(conflicts, dtype=np.float64)
    for _ in range(_ROUNDS):
        target = _mutual_best(shared, seen, members, threshold, apart)
        if target is None:
            break
        names, compact = np.unique(target, return_inverse=True)
        join: Any = scipy.sparse.csr_matrix(
            (np.ones(len(target)), (compact, np.arange(len(target)))),
            shape=(len(names), len(target)),
        )
        shared = (join @ shared @ join.T).tocsr()
        seen, members = (join @ seen).tocsr(), (join @ members).tocsr()
        if apart is not None:
            apart = (join @ apart @ join.T).tocsr()
        group = compact[group]
    return group


def _mutual_best(
    shared: Any, seen: Any, members: Any, threshold: float, conflicts: Any
) -> NDArray[Any] | None:
    """Where each group goes: to the earlier of two that are each other's best; None if none do."""
    pairs = shared.tocoo()
    apart = (pairs.row < pairs.col) & (pairs.data > 0)
    row, column, both = pairs.row[apart], pairs.col[apart], pairs.data[apart]
    order = np.argsort(row, kind="stable")
    row, column, both = row[order], column[order], both[order]
    ratio = both / np.maximum(_unions(seen, members, row, column) - both, 1e-12)
    enough = ratio >= threshold
    if conflicts is not None:
        enough[enough] = _compatible(members, conflicts, row[enough], column[enough])
    if not enough.any():
        return None
    row, column, ratio = row[enough], column[enough], ratio[enough]
    one = np.concatenate((row, column))
    other = np.concatenate((column, row))
    value = np.concatenate((ratio, ratio))
    order = np.lexsort((other, -value, one))
    first = np.unique(one[order], return_index=True)
    best = np.full(seen.shape[0], -1)
    best[first[0]] = other[order][first[1]]
    target = np.arange(seen.shape[0])
    has = np.flatnonzero(best >= 0)
    mutual = has[best[best[has]] == has]
    target[mutual] = np.minimum(mutual, best[mutual])
    return target


def _compatible(
    members: Any, conflicts: Any, row: NDArray[Any], column: NDArray[Any]
) -> NDArray[np.bool_]:
    """Whether the segments of two groups contradict each other in few of the views, for pairs."""
    views = np.asarray((members > 0).sum(axis=1)).ravel()
    against = np.asarray(conflicts[row, column]).ravel()
    return against <= _MAX_CONFLICT * np.minimum(views[row], views[column])


def _unions(
    seen: Any, members: Any, row: NDArray[Any], column: NDArray[Any]
) -> NDArray[np.float64]:
    """What views of either group see of the other, for pairs (row, column) with rows ascending."""
    union = np.empty(len(row))
    count = seen.shape[0]
    if len(row) <= _DENSE * count**2:
        for start in range(0, len(row), _PAIRS):
            part = slice(start, start + _PAIRS)
            r, c = row[part], column[part]
            union[part] = np.asarray(seen[r].multiply(members[c]).sum(axis=1)).ravel()
            union[part] += np.asarray(members[r].multiply(seen[c]).sum(axis=1)).ravel()
        return union
    whole_seen, whole_members = seen.toarray(), members.toarray()
    for start in range(0, count, _BLOCK):
        block = slice(start, start + _BLOCK)
        first, last = np.searchsorted(row, [start, start + _BLOCK])
        sums = whole_seen[block] @ whole_members.T + whole_members[block] @ whole_seen.T
        union[first:last] = sums[row[first:last] - start, column[first:last]]
    return union
