r"""Which segments of one view lie inside each other, and so are of different levels.

With the soft share :math:`s_{ai}` of Gaussian i that segment a holds of what its view sees,

.. math:: C(a, b) = \frac{\sum_i \bar m_i\, s_{ai}\, s_{bi}}{\sum_i \bar m_i\, s_{ai}^2}

is about 1 where a lies inside b, and near 0 where they are apart. Both sums stand in the
agreement of all segments already, so that no pixel is read again.

Where the model itself gives levels, they decide: two segments of one view with different levels
are never one instance, even if they hold the same Gaussians, and of two such the finer is the one
that lies inside. Between segments of one level, and where there are no levels, C decides alone.
"""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg.lift.segments.clustering import Agreement
from splatseg.lift.segments.shared import MIN_COSINE

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

    @property
    def share(self) -> float:
        """Share of the segments that lie inside another or have another inside, in [0, 1]."""
        both = (self.inside + self.inside.T).tocsr()
        return float(np.mean(np.diff(both.indptr) > 0)) if both.shape[0] else 0.0


def nesting(agreement: Agreement, level: NDArray[np.int64] | None = None) -> Nesting:
    """Find what lies inside what within each view.

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
