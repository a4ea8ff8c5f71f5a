"""Votes of groups of segments become labels."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import UNLABELLED, Labels
from splatseg.lift.segments.table import SegmentTable

CANDIDATES = 8
"""Ids of a Gaussian that are kept, those with most votes."""


def by_mass(group: NDArray[np.int64], votes: Any) -> tuple[NDArray[np.int64], Any]:
    """Groups numbered anew by the votes they have, most first; groups without any go."""
    total = np.asarray(votes.sum(axis=0)).ravel()
    order = np.lexsort((np.arange(len(total)), -total))
    order = order[total[order] > 0]
    rank = np.full(len(total) + 1, -1)
    rank[order] = np.arange(len(order))
    return rank[group], votes.tocsc()[:, order].tocsr()


def view_counts(table: SegmentTable) -> Tensor:
    """(Gaussians,): how many of the views that were compared see each."""
    seen = np.bincount(table.sights().indices, minlength=table.gaussians)
    return torch.from_numpy(seen.astype(np.float32))


def majority(votes: Any, effective_views: Tensor | None = None) -> Labels:
    """The strongest ids of each Gaussian (the smaller among equals), their shares, all votes.

    Args:
        votes: Sparse (Gaussians, groups); group 0 gets the id 1.
        effective_views: How many views see each Gaussian, where that is known.
    """
    count = votes.shape[0]
    votes.sort_indices()
    rows = np.repeat(np.arange(count), np.diff(votes.indptr))
    # The sort is stable, and indices ascend within a row: the smaller comes first among equals.
    order = np.lexsort((-votes.data, rows))
    rows = rows[order]
    first = np.ones(len(rows), bool)
    first[1:] = rows[1:] != rows[:-1]
    rank = np.arange(len(rows)) - np.flatnonzero(first)[np.cumsum(first) - 1]
    kept = rank < CANDIDATES
    total = np.asarray(votes.sum(axis=1)).ravel()
    ids = np.full((count, CANDIDATES), UNLABELLED, np.int32)
    shares = np.zeros((count, CANDIDATES), np.float32)
    index = rows[kept], rank[kept]
    ids[index] = votes.indices[order][kept] + 1
    shares[index] = (votes.data[order][kept] / total[index[0]]).clip(0, 1)
    return Labels(
        ids=torch.from_numpy(ids[:, 0].copy()),
        confidence=torch.from_numpy(shares[:, 0].copy()),
        candidates=torch.from_numpy(ids),
        shares=torch.from_numpy(shares),
        evidence=torch.from_numpy(total.astype(np.float32)),
        effective_views=effective_views,
    )
