"""Pairs of groups of segments, whose overlaps are kept while groups join.

A round of joins changes few of the groups. What is known of a pair of two others stays as it is,
so that a round costs what it changes and not what there is.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

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


def seen_by(seen: Any, members: Any, one: NDArray[Any], other: NDArray[Any]) -> NDArray[np.float64]:
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
