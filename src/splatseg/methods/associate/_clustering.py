"""What segments share, pair by pair: products of their masses."""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg.lift.voting.segment_masses import entries_of, sparse_product

MIN_COSINE = 0.05
"""Least cosine of two segments' masses: of two sets one a 400th of the other's size reaches it."""

_BLOCK = 512
"""Segments that are compared with all others at a time."""


def shared_masses(masses: Any) -> Any:
    """Products of the rows with each other, without those of nearly nothing, sparse, symmetric.

    Args:
        masses: Sparse (segments, Gaussians), float32.
    """
    import scipy.sparse

    columns: Any = masses.T.tocsr()
    count, width = masses.shape
    squares = np.square(masses.data, dtype=np.float64)
    row = np.repeat(np.arange(count, dtype=np.int32), np.diff(masses.indptr))
    length = np.sqrt(np.bincount(row, squares, minlength=count))
    entries = entries_of(columns)
    begin = entries[0][:-1].copy()
    columns_of: list[Any] = [np.zeros(0, np.int32)]
    values_of: list[Any] = [np.zeros(0, np.float32)]
    kept_of = np.zeros(count + 1, np.int64)
    for start in range(0, count, _BLOCK):
        rows = masses[start : start + _BLOCK]
        block = sparse_product(rows, entries, count, begin=begin).tocoo()
        row, column = block.row + start, block.col
        kept = block.data > MIN_COSINE * length[row] * length[column]
        kept &= column >= row
        kept_of[1:] += np.bincount(row[kept], minlength=count)
        columns_of.append(column[kept])
        values_of.append(block.data[kept].astype(np.float32))
        # What is before a block was multiplied with it before.
        begin += np.bincount(rows.indices, minlength=width)
    ends = np.cumsum(kept_of)
    upper: Any = scipy.sparse.csr_matrix(
        (np.concatenate(values_of), np.concatenate(columns_of), ends), shape=(count, count)
    )
    del columns_of, values_of
    lower = scipy.sparse.triu(upper, 1).T.tocsr()
    return (upper + lower).tocsr()


_CELLS = 1 << 20
"""Groups x views that are unrolled at a time."""

_PAIRS = 1 << 20
"""Pairs x views of a group that are summed at a time."""


def join_pairs(
    row: NDArray[Any], column: NDArray[Any], value: NDArray[Any], target: NDArray[Any]
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float64]]:
    """Pairs of what groups have become, ordered, each once, with the sum of its values.

    Args:
        row: (pairs,): one group.
        column: (pairs,): the other; each pair is given in one of its two orders.
        value: (pairs,): what they share.
        target: (groups,): where each group goes.

    Returns:
        Rows below columns, ascending, and values. Pairs that became one group are gone.
    """
    import scipy.sparse

    # Pairs are many: what is not wanted again is not kept.
    short = target.astype(np.int32)
    one, other = short[row], short[column]
    apart = one != other
    one, other = one[apart], other[apart]
    index = np.minimum(one, other), np.maximum(one, other)
    del one, other
    count = len(target)
    sums: Any = scipy.sparse.csr_matrix(
        (value[apart].astype(np.float64, copy=False), index), shape=(count, count)
    )
    del index
    sums.sort_indices()
    rows = np.repeat(np.arange(count, dtype=np.int32), np.diff(sums.indptr))
    return rows, sums.indices, sums.data


def visible_in(
    seen: Any, members: Any, one: NDArray[Any], other: NDArray[Any]
) -> NDArray[np.float64]:
    """What the views of the segments of one group see of the other, for pairs.

    Args:
        seen: Sparse rows (groups, views): what each view sees of each group.
        members: Sparse rows (groups, views): segments of each group in each view.
        one: (pairs,): the groups that are seen.
        other: (pairs,): the groups whose views see them.
    """
    order = np.argsort(one, kind="stable")
    first, second = one[order], other[order]
    sums = np.empty(len(order))
    block = max(1, _CELLS // max(seen.shape[1], 1))
    lengths = np.diff(members.indptr)
    for start in range(0, seen.shape[0], block):
        begin, end = np.searchsorted(first, (start, start + block))
        if begin == end:
            continue
        dense = seen[start : start + block].toarray()
        ends = np.cumsum(lengths[second[begin:end]])
        cuts = np.searchsorted(ends, np.arange(0, int(ends[-1]) + _PAIRS, _PAIRS), side="right")
        bounds = np.unique(np.append(cuts, (0, end - begin)))
        for low, high in zip(bounds[:-1] + begin, bounds[1:] + begin, strict=True):
            few = lengths[second[low:high]]
            stop = np.cumsum(few)
            at = np.arange(int(stop[-1])) + np.repeat(
                members.indptr[second[low:high]] - (stop - few), few
            )
            rows = np.repeat(first[low:high] - start, few)
            values = dense[rows, members.indices[at]] * members.data[at]
            pair = np.repeat(np.arange(high - low), few)
            sums[low:high] = np.bincount(pair, values, minlength=high - low)
    result = np.empty(len(order))
    result[order] = sums
    return result


_ROUNDS = 1000

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
    r"""The group of each segment, numbered in the order of each group's first segment.

    Two groups of segments A and B are compared wherever a segment of one meets a view of the other:

    .. math:: I(A, B) = \sum_{a \in A} \sum_{b \in B} I(a, b), \qquad
              U(A, B) = \sum_{a \in A} \sum_{b \in B}
                        \bigl(m(a \mid v_b) + m(b \mid v_a) - I(a, b)\bigr)

    with :math:`I(a, b)` the mass that both cover and :math:`m(a \mid v)` the mass of a that view v
    sees at all, so that what is hidden or out of the picture in one of the views counts for neither
    side. Their ratio is the mean intersection over union of all pairs, weighted by size. Groups
    that are each other's best join, round after round, while the ratio is at least a threshold.
    Segments of one view share nothing and see all of each other, so that to join them costs what it
    should and is not forbidden: where a model split an object in one view, the other views outvote
    it.

    Where segments of a view may lie inside each other, that says that they are of different levels
    (`nesting`), and so of different groups: two groups stay apart if their segments
    contradict each other so in more than a fifth of the views of the smaller.

    No step looks at names, ids or the order of the views. Ties go to the earlier segment.

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
        union = visible_in(self.seen, self.members, row, column)
        union += visible_in(self.seen, self.members, column, row) - shared
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


MIN_CONTAINMENT = 0.7
"""C(a, b) from which on a lies inside b: less than that is a seam they share."""

MIN_KNOWN_SIZE = (MIN_COSINE / MIN_CONTAINMENT) ** 2
"""A mask that lies inside one that is larger still shares too little with it to be counted: one
of less than a 196th of its mass."""

_SAME = 0.8
"""Intersection over union from which on two segments of one view are the same thing twice."""


_ROWS = 256
"""Segments whose pairs are looked at at a time."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Nesting:
    """Segments of one view inside each other."""

    agreement: Agreement
    """The agreement in which segments of one view that overlap share nothing, except those that
    are the same thing twice."""

    inside: Any
    """Sparse boolean (segments, segments): the row lies inside the column, in one view."""

    forbidden: Any
    """Sparse symmetric boolean (segments, segments): pairs of one view to which the model gave
    different levels."""

    @property
    def conflicts(self) -> Any:
        """Sparse symmetric (segments, segments): above 0 where two are of different levels.

        1 where their shapes say so, which other views may outvote; where the model says so, as
        many as there are views, which none can.
        """
        both = self.inside + self.inside.T
        both.data[:] = 1.0
        views = self.agreement.seen.shape[1]
        return both.maximum(self.forbidden * float(views)).tocsr()


def nesting(agreement: Agreement, level: NDArray[np.int64] | None = None) -> Nesting:
    r"""Find what lies inside what within each view.

    With the soft share :math:`s_{ai}` of Gaussian i that segment a holds of what its view sees,

    .. math:: C(a, b) = \frac{\sum_i \bar m_i\, s_{ai}\, s_{bi}}{\sum_i \bar m_i\, s_{ai}^2}

    is about 1 where a lies inside b, and near 0 where they are apart. Both sums stand in the
    agreement of all segments already, so that no pixel is read again.

    Where the model itself gives levels, they decide: two segments of one view with different levels
    are never one instance, even if they hold the same Gaussians, and of two such the finer is the
    one that lies inside. Between segments of one level, and where there are no levels, C decides
    alone.

    Args:
        agreement: What all pairs of segments share, with what each shares with itself on the
            diagonal.
        level: (segments,): granularity that the model gave to each segment, 0 the finest. None
            and all alike say nothing.
    """
    import scipy.sparse

    if level is None:
        level = np.zeros(len(agreement.view), np.int64)
    shared = agreement.shared.tocsr()
    own = np.asarray(shared.diagonal(), dtype=np.float64)
    kept = np.ones(len(shared.data), bool)
    inner, outer = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    # Pairs go with the square of the segments: some rows of them are looked at at a time.
    for start in range(0, len(own), _ROWS):
        ends = shared.indptr[start : start + _ROWS + 1]
        row = np.repeat(np.arange(start, start + len(ends) - 1), np.diff(ends))
        column = shared.indices[ends[0] : ends[-1]]
        same_view = (agreement.view[row] == agreement.view[column]) & (row != column)
        place = ends[0] + np.flatnonzero(same_view)
        row, column, both = row[same_view], column[same_view], shared.data[place]
        union = own[row] + own[column] - both
        step = level[column] - level[row]
        twice = (both >= _SAME * union) & (step == 0)
        finer = (step > 0) | ((step == 0) & (own[row] < own[column]))
        inside = ~twice & (both >= MIN_CONTAINMENT * own[row]) & finer
        kept[place[~twice]] = False
        inner.append(row[inside])
        outer.append(column[inside])
    ends = np.append(0, np.cumsum(kept))[shared.indptr]
    pairs = np.concatenate(inner), np.concatenate(outer)
    return Nesting(
        agreement=replace(
            agreement,
            shared=scipy.sparse.csr_matrix(
                (shared.data[kept], shared.indices[kept], ends), shape=shared.shape
            ),
        ),
        inside=scipy.sparse.csr_matrix((np.ones(len(pairs[0])), pairs), shape=shared.shape),
        forbidden=_different_levels(agreement.view, level),
    )


def _different_levels(view: NDArray[np.int64], level: NDArray[np.int64]) -> Any:
    """Sparse symmetric (segments, segments): 1 where two of one view differ in level."""
    import scipy.sparse

    order = np.argsort(view, kind="stable")
    bounds = np.flatnonzero(np.diff(view[order], prepend=-1, append=-1))
    pairs = [np.zeros((2, 0), np.int64)]
    for start, stop in pairwise(bounds.tolist()):
        own = order[start:stop]
        row, column = np.nonzero(level[own][:, None] != level[own][None, :])
        pairs.append(np.stack((own[row], own[column])))
    row, column = np.concatenate(pairs, axis=1)
    count = len(view)
    return scipy.sparse.csr_matrix((np.ones(len(row)), (row, column)), shape=(count, count))
