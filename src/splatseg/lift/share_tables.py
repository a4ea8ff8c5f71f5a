"""Sparse tables of the shares of ids, a row a Gaussian, and their largest entries."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import UNLABELLED

_MIN_SHARE = 1e-6
"""Shares below this are dropped."""


def share_table(
    ids: NDArray[np.int64], shares: NDArray[Any], kept: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], Any]:
    """Ids in use, ascending, and a sparse table (n, ids) of each row's shares of them.

    Args:
        ids: (n, k): ids of each row.
        shares: (n, k): their shares.
        kept: (n, k): entries that are in the table.
    """
    import scipy.sparse

    column_ids, columns = np.unique(ids[kept], return_inverse=True)
    # Nothing known is one column of nothing.
    column_ids = column_ids if len(column_ids) else np.array([UNLABELLED])
    table = scipy.sparse.csr_matrix(
        (shares[kept], (np.nonzero(kept)[0], columns)), shape=(len(ids), len(column_ids))
    )
    return column_ids, table


def ranked_entries(table: Any) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Row, entry and rank within its row of all entries, by row, the largest first.

    Of equals the one with the smaller column comes first.
    """
    sizes = np.diff(table.indptr)
    row = np.repeat(np.arange(len(sizes)), sizes)
    order = np.lexsort((table.indices, -table.data, row))
    return row, order, np.arange(len(order)) - np.repeat(table.indptr[:-1], sizes)


def strongest(table: Any, count: int) -> Any:
    """The table with at most so many entries a row, its largest."""
    import scipy.sparse

    table.data[table.data < _MIN_SHARE] = 0
    table.eliminate_zeros()
    table.sort_indices()
    sizes = np.diff(table.indptr)
    if not len(sizes) or sizes.max() <= count:
        return table
    _, order, rank = ranked_entries(table)
    chosen = np.sort(order[rank < count])
    starts = np.concatenate(([0], np.cumsum(np.minimum(sizes, count))))
    return scipy.sparse.csr_matrix(
        (table.data[chosen], table.indices[chosen], starts), shape=table.shape
    )


def ranked(table: Any, count: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Columns (n, count), largest first, -1 where there are fewer, and their values."""
    table = strongest(table.tocsr().copy(), count)
    row, order, rank = ranked_entries(table)
    columns = np.full((table.shape[0], count), -1, dtype=np.int64)
    values = np.zeros((table.shape[0], count), dtype=np.float32)
    columns[row, rank] = table.indices[order]
    values[row, rank] = table.data[order]
    return columns, values


def ranked_ids(
    table: Any, column_ids: NDArray[np.int64], count: int
) -> tuple[Int[Tensor, "n k"], Float[Tensor, "n k"]]:
    """Ids (n, count) by their shares, -1 where there are fewer, and the shares."""
    columns, shares = ranked(table, count)
    ids = np.where(columns >= 0, column_ids[np.maximum(columns, 0)], UNLABELLED)
    shares = np.where(ids == UNLABELLED, np.float32(0), shares)
    # Sums in float32 may leave a lone id's share a hair above 1.
    return torch.from_numpy(ids.astype(np.int32)), torch.from_numpy(shares).clamp(0, 1)
