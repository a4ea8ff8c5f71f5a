"""What segments share, pair by pair: products of their masses."""

from typing import Any

import numpy as np

from splatseg.lift.mass.products import entries_of, sparse_product

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
