r"""Which segments of one view lie inside each other, and so are of different levels.

With the soft share :math:`s_{ai}` of Gaussian i that segment a holds of what its view sees,

.. math:: C(a, b) = \frac{\sum_i \bar m_i\, s_{ai}\, s_{bi}}{\sum_i \bar m_i\, s_{ai}^2}

is about 1 where a lies inside b, and near 0 where they are apart. Both sums stand in the
agreement of all segments already, so that no pixel is read again.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from splatseg.lift.segments.clustering import Agreement

MIN_CONTAINMENT = 0.7
"""C(a, b) from which on a lies inside b: less than that is a seam they share."""

_SAME = 0.8
"""Intersection over union from which on two segments of one view are the same thing twice."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Nesting:
    """Segments of one view inside each other."""

    agreement: Agreement
    """The agreement in which segments of one view that overlap share nothing, except those that
    are the same thing twice."""

    inside: Any
    """Sparse boolean (segments, segments): the row lies inside the column, in one view."""

    @property
    def conflicts(self) -> Any:
        """Sparse symmetric (segments, segments): 1 where two segments are of different levels."""
        both = self.inside + self.inside.T
        both.data[:] = 1.0
        return both.tocsr()

    @property
    def share(self) -> float:
        """Share of the segments that lie inside another or have another inside, in [0, 1]."""
        return float(np.mean(np.diff(self.conflicts.indptr) > 0)) if self.inside.shape[0] else 0.0


def nesting(agreement: Agreement) -> Nesting:
    """Find what lies inside what within each view.

    Args:
        agreement: What all pairs of segments share, with what each shares with itself on the
            diagonal.
    """
    import scipy.sparse

    pairs = agreement.shared.tocoo()
    own = np.asarray(agreement.shared.diagonal(), dtype=np.float64)
    same_view = (agreement.view[pairs.row] == agreement.view[pairs.col]) & (pairs.row != pairs.col)
    row, column, both = pairs.row[same_view], pairs.col[same_view], pairs.data[same_view]
    union = own[row] + own[column] - both
    twice = both >= _SAME * union
    inside = ~twice & (both >= MIN_CONTAINMENT * own[row]) & (own[row] < own[column])
    kept = np.ones(len(pairs.data), bool)
    kept[np.flatnonzero(same_view)[~twice]] = False
    shape = pairs.shape
    return Nesting(
        agreement=replace(
            agreement,
            shared=scipy.sparse.csr_matrix(
                (pairs.data[kept], (pairs.row[kept], pairs.col[kept])), shape=shape
            ),
        ),
        inside=scipy.sparse.csr_matrix(
            (np.ones(int(inside.sum())), (row[inside], column[inside])), shape=shape
        ),
    )
