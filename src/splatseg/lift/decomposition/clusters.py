"""Clusters of directions: found in a sample, given to all by their centres.

HDBSCAN compares every two of what it clusters, so that it sees a sample. What is not like any
centre is sampled again: things of which the first sample holds too few have most of the second.
"""

import numpy as np
import torch
from jaxtyping import Float, Int64
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import normalize

_ROWS = 1 << 15
"""Directions that are held against all centres at a time."""


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
    return np.sort(rows[np.argpartition(-keys, count)[:count]])


def hdbscan(
    directions: Float[Tensor, "m channels"], *, min_cluster: int, epsilon: float
) -> Float[Tensor, "clusters channels"]:
    """Centres of the clusters of some directions: the directions of their means.

    Args:
        directions: Of length 1.
        min_cluster: Rows that a cluster needs.
        epsilon: Clusters that are nearer than this distance, of directions as points, are one.
    """
    if len(directions) < max(min_cluster, 2):
        return directions[:0]
    cluster = _fitted(directions, min_cluster, single=False)
    if not bool((cluster >= 0).any()):
        # What is all alike has no clusters but itself.
        cluster = _fitted(directions, min_cluster, single=True)
    sizes = torch.bincount(cluster[cluster >= 0]).to(directions)
    return joined(mean_directions(directions, cluster), sizes, epsilon=epsilon)


def _fitted(directions: Tensor, min_cluster: int, *, single: bool) -> Int64[Tensor, "m"]:
    from sklearn.cluster import HDBSCAN

    # Its own cluster_selection_epsilon fails on some trees (scikit-learn 1.9); `joined` has it.
    found = HDBSCAN(
        min_cluster_size=min_cluster, allow_single_cluster=single, copy=True
    ).fit_predict(directions.double().numpy())
    return torch.from_numpy(found.astype(np.int64))


def joined(
    centres: Float[Tensor, "clusters channels"], sizes: Float[Tensor, "clusters"], *, epsilon: float
) -> Float[Tensor, "joined channels"]:
    """Centres, of which those that are nearer than epsilon to another have become one with it.

    HDBSCAN never answers that all it was given is one cluster, but divides it somewhere.

    Args:
        centres: Of length 1.
        sizes: How much each counts in the direction of what it is joined to.
        epsilon: Distance of directions as points.
    """
    import scipy.sparse
    from scipy.sparse.csgraph import connected_components

    near = (2 - 2 * centres @ centres.T).clamp_min(0) < epsilon**2
    graph = scipy.sparse.csr_matrix(near.numpy())
    _, of = connected_components(graph, directed=False)
    return mean_directions(centres * sizes[:, None], torch.from_numpy(of.astype(np.int64)))


def mean_directions(
    directions: Float[Tensor, "m channels"], cluster: Int64[Tensor, "m"]
) -> Float[Tensor, "clusters channels"]:
    """The direction of the mean of each cluster.

    Args:
        directions: Of length 1.
        cluster: The cluster of each, counted from 0 without gaps, -1 for none.
    """
    inside = cluster >= 0
    sums = directions.new_zeros(int(cluster.max()) + 1 if len(cluster) else 0, directions.shape[1])
    sums.index_add_(0, cluster[inside], directions[inside])
    return normalize(sums, dim=1)


def nearest(
    directions: Float[Tensor, "n channels"], centres: Float[Tensor, "clusters channels"], k: int
) -> tuple[Float[Tensor, "n k"], Int64[Tensor, "n k"]]:
    """Similarities of each direction with the k centres most like it, and which these are.

    Where there are fewer centres, there are fewer columns; the first of equal ones comes first.
    """
    k = min(k, len(centres))
    similarity = directions.new_zeros(len(directions), k)
    index = torch.zeros(len(directions), k, dtype=torch.int64)
    for start in range(0, len(directions), _ROWS):
        rows = slice(start, start + _ROWS)
        values, order = (directions[rows] @ centres.T).sort(dim=1, descending=True, stable=True)
        similarity[rows], index[rows] = values[:, :k], order[:, :k]
    return similarity, index
