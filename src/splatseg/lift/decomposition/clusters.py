r"""Clusters of directions that hang together in space.

Neighbours in space are joined as long as the directions that become one have little to lose: Ward's
method on a graph. Joining clusters of a and b of n samples, with means m, raises the mean squared
distance of samples from their means by

.. math:: \Delta = \frac{1}{n} \frac{a b}{a + b} \, \| m_a - m_b \|^2 ,

and clusters stay two where that exceeds what is allowed. Density alone (HDBSCAN, as the published
code of SAGA has it) chains objects together through the Gaussians at their borders, whose features
lie between: `docs/decisions/0032-decomposition.md`.

References:
    Ward, Hierarchical Grouping to Optimize an Objective Function (1963).
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64
from numpy.typing import NDArray
from torch import Tensor

from splatseg.neighbours import NeighbourIndex

_ROWS = 1 << 14
"""Points that are held against their neighbours at a time."""


def sampled(
    weights: NDArray[np.float64], count: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Rows drawn without replacement, likely as their weights; ascending.

    Args:
        weights: 0 is never drawn.
        count: How many at most.
        rng: Draws.
    """
    rows = np.flatnonzero(weights > 0)
    if len(rows) <= count:
        return rows
    # The largest of u^(1/w) are a weighted sample (Efraimidis and Spirakis 2006).
    keys = np.log(rng.random(len(rows))) / weights[rows]
    return np.sort(rows[np.argpartition(-keys, count - 1)[:count]])


def ward(
    directions: Float[Tensor, "m channels"],
    points: Float[Tensor, "m 3"],
    *,
    neighbours: int,
    increase: float,
) -> NDArray[np.int64]:
    """The cluster of each sample, counted from 0 in the order of their first samples.

    Args:
        directions: Of length 1.
        points: Where the samples are.
        neighbours: Others nearest to it that a sample may be joined with; what no path of them
            connects is never joined.
        increase: Delta that joining two clusters may cost.
    """
    import scipy.sparse
    from scipy.sparse.csgraph import connected_components

    count = len(directions)
    if count < 2:
        return np.zeros(count, dtype=np.int64)
    k = min(neighbours, count - 1)
    near = NeighbourIndex(points).nearest_others(k).indices.numpy()
    edges = (np.ones(count * k), (np.repeat(np.arange(count), k), near.reshape(-1)))
    graph: Any = scipy.sparse.csr_matrix(edges, shape=(count, count))
    graph = graph.maximum(graph.T).tocsr()
    _, piece = connected_components(graph, directed=False)
    # scikit-learn's distance is sqrt(2 n Delta).
    limit = float(np.sqrt(2 * count * increase))
    values = directions.double().numpy()
    cluster = np.zeros(count, dtype=np.int64)
    after = 0
    for rows in np.split(np.argsort(piece, kind="stable"), np.cumsum(np.bincount(piece))[:-1]):
        cluster[rows] = after + _joined(values[rows], graph[rows][:, rows], limit)
        after = int(cluster[rows].max()) + 1
    _, first, found = np.unique(cluster, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[found].astype(np.int64)


def _joined(values: NDArray[np.float64], graph: Any, limit: float) -> NDArray[np.int64]:
    """Clusters of what one graph connects."""
    if len(values) < 2:
        return np.zeros(len(values), dtype=np.int64)
    from sklearn.cluster import AgglomerativeClustering

    by_distance: Any = None  # its annotation knows numbers only
    made = AgglomerativeClustering(
        n_clusters=by_distance, distance_threshold=limit, linkage="ward", connectivity=graph
    )
    return made.fit_predict(values).astype(np.int64)


def votes(
    directions: Float[Tensor, "n channels"],
    points: Float[Tensor, "n 3"],
    samples: Int64[Tensor, "m"],
    cluster: NDArray[np.int64],
    *,
    voters: int,
    temperature: float,
) -> tuple[Int64[Tensor, "n k"], Float[Tensor, "n k"]]:
    r"""Clusters of all, by votes of the samples nearest to them in space.

    .. math:: a_{ic} \propto \sum_{j \in N_k(i),\; c_j = c} \exp(\langle d_i, d_j \rangle / \tau)

    Args:
        directions: Of length 1.
        points: Where they are.
        samples: Rows of the samples.
        cluster: The cluster of each sample.
        voters: k, samples that vote; where there are fewer, there are fewer columns.
        temperature: Tau.

    Returns:
        Clusters, the one with the largest share first, -1 where there are fewer, and shares, which
        add up to 1.
    """
    k = min(voters, len(samples))
    near = NeighbourIndex(points[samples]).nearest(points, k).indices
    index = torch.full((len(points), k), -1)
    shares = torch.zeros(len(points), k)
    known, of = directions[samples], torch.from_numpy(cluster)
    for start in range(0, len(points), _ROWS):
        rows = slice(start, start + _ROWS)
        similarity = torch.einsum("nc,nkc->nk", directions[rows], known[near[rows]])
        vote = torch.softmax(similarity / temperature, dim=1)
        found = of[near[rows]]
        same = found[:, :, None] == found[:, None, :]
        total = (vote[:, None, :] * same).sum(dim=2)
        # Of the voters of one cluster the nearest stands for all.
        later = torch.tril(same, diagonal=-1).any(dim=2)
        total = torch.where(later, -1.0, total)
        total, order = total.sort(dim=1, descending=True, stable=True)
        index[rows] = torch.where(total < 0, -1, found.gather(1, order))
        shares[rows] = total.clamp_min(0)
    return index, shares
