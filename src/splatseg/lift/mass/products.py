"""Products of sparse matrices by the native kernel: one pass, sums in double precision."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg import _native

Entries = tuple[NDArray[np.int64], NDArray[np.int32], NDArray[Any]]
"""Where rows begin, with the end of the last one; columns; values."""


def sparse_product(
    left: Any, right: Entries, width: int, *, begin: NDArray[np.int64] | None = None
) -> Any:
    """``left @ right`` as a scipy matrix of float64, columns ascending, without zeros.

    Every sum runs over a row of `left` in its order and in double precision, on any number of
    threads.

    Args:
        left: A scipy matrix of compressed rows of float32, or of float64 where `right` has
            float32.
        right: Rows of float32 or float64, or of the bits of half-precision numbers as uint16.
        width: Columns of `right`.
        begin: Where the wanted entries of each row of `right` begin; None takes all.
    """
    import scipy.sparse

    indptr, columns, values = right
    found = _native.sparse_product(
        left.indptr.astype(np.int64),
        left.indices.astype(np.int32, copy=False),
        left.data,
        indptr[:-1] if begin is None else begin,
        indptr[1:],
        columns,
        values,
        width,
    )
    rows: Any = scipy.sparse.csr_matrix(
        (found[2], found[1], found[0]), shape=(left.shape[0], width), copy=False
    )
    rows.has_sorted_indices = True
    return rows


def entries_of(rows: Any) -> Entries:
    """Where rows of a scipy matrix begin, their columns and values."""
    return rows.indptr.astype(np.int64), rows.indices.astype(np.int32, copy=False), rows.data
