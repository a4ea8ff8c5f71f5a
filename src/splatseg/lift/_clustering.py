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

No step looks at names, ids or the order of the views. Ties go to the earlier segment.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

_ROUNDS = 1000
_PAIRS = 1 << 17
"""Pairs of groups whose unions are computed at a time."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Agreement:
    """What pairs of segments share, and what each view sees of each segment."""

    shared: Any
    """Sparse symmetric (segments, segments): I(a, b). The diagonal means nothing."""

    seen: Any
    """Sparse (segments, views): m(a | v)."""

    view: NDArray[np.int64]
    """(segments,): the view that each segment comes from."""


def cluster(agreement: Agreement, threshold: float) -> NDArray[np.int64]:
    """The group of each segment, numbered in the order of each group's first segment.

    Args:
        agreement: How segments overlap.
        threshold: Least ratio at which two groups join, in (0, 1].
    """
    import scipy.sparse

    count, views = agreement.seen.shape
    group = np.arange(count)
    shared: Any = scipy.sparse.csr_matrix(agreement.shared, dtype=np.float64)
    seen: Any = scipy.sparse.csr_matrix(agreement.seen, dtype=np.float64)
    members: Any = scipy.sparse.csr_matrix(
        (np.ones(count), (group, agreement.view)), shape=(count, views)
    )
    for _ in range(_ROUNDS):
        target = _mutual_best(shared, seen, members, threshold)
        if target is None:
            break
        names, compact = np.unique(target, return_inverse=True)
        join: Any = scipy.sparse.csr_matrix(
            (np.ones(len(target)), (compact, np.arange(len(target)))),
            shape=(len(names), len(target)),
        )
        shared = (join @ shared @ join.T).tocsr()
        seen, members = (join @ seen).tocsr(), (join @ members).tocsr()
        group = compact[group]
    return group


def _mutual_best(shared: Any, seen: Any, members: Any, threshold: float) -> NDArray[Any] | None:
    """Where each group goes: to the earlier of two that are each other's best; None if none do."""
    pairs = shared.tocoo()
    apart = (pairs.row < pairs.col) & (pairs.data > 0)
    row, column, both = pairs.row[apart], pairs.col[apart], pairs.data[apart]
    ratio = np.empty(len(row))
    for start in range(0, len(row), _PAIRS):
        part = slice(start, start + _PAIRS)
        r, c = row[part], column[part]
        union = np.asarray(seen[r].multiply(members[c]).sum(axis=1)).ravel()
        union += np.asarray(members[r].multiply(seen[c]).sum(axis=1)).ravel()
        ratio[part] = both[part] / np.maximum(union - both[part], 1e-12)
    enough = ratio >= threshold
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
