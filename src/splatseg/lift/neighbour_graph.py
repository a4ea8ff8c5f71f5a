r"""The neighbour graph of Gaussians, and diffusion of label shares over it.

Nodes are Gaussians, edges their nearest neighbours. An edge is as strong as its ends are alike:

.. math:: w_{ij} = \exp\Bigl(-\frac{|x_i - x_j|^2}{2\,\sigma_i \sigma_j}
              - \frac{|c_i - c_j|^2}{2\,\sigma_c^2}\Bigr)
              \; \exp\Bigl(-\frac{|f_i - f_j|^2}{b\, m^2}\Bigr)
              \; \exp\Bigl(-\frac{|n_i \times n_j|^2}{2\,\sigma_n^2}\Bigr)

with :math:`\sigma_i` the distance to node i's farthest neighbour, so that the graph does not
depend on the unit of length, c colours in [0, 1], f features of unit length and m the median
:math:`|f_i - f_j|` of all edges. A Gaussian's normal n is its shortest axis, as long as the
Gaussian is flat (`flat_normals`), so that :math:`|n_i \times n_j|` is the sine between two flat
ones whichever way either axis points, and 0 where one of them is round.

Shares of ids are kept sparsely, a few a node, so that memory does not grow with the number of
ids.

References:
    Zelnik-Manor and Perona, Self-Tuning Spectral Clustering (2004), eq. 5: the local widths.
    Marrie et al., LUDVIG (2024), section 3.3: the feature affinity.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import Gaussians
from splatseg.core.rigid import rotation_from_quaternion
from splatseg.lift.share_tables import strongest
from splatseg.neighbours import NeighbourIndex

_ROWS = 1 << 14
"""Nodes handled at a time."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NodeAttributes:
    """What edges compare, one row a node."""

    positions: NDArray[np.float64]
    colours: NDArray[np.float32] | None = None
    features: NDArray[np.float32] | None = None
    """Of any length; a row of zeros is a node of which nothing is known."""

    normals: NDArray[np.float32] | None = None
    """n, as long as a node is flat, in [0, 1]; the sign means nothing. See `flat_normals`."""


def flat_normals(gaussians: Gaussians) -> NDArray[np.float32]:
    r"""Shortest axis of each Gaussian (n, 3), as long as it is flat.

    .. math:: |n| = 1 - s_{min} / s_{mid}

    of the least and the middle scale: 1 for a disc, 0 for a ball or a needle.
    """
    scales, order = gaussians.scales.detach().cpu().double().sort(dim=1)
    middle = scales[:, 1]
    flatness = torch.where(middle > 0, 1 - scales[:, 0] / middle.clamp_min(1e-300), 0.0)
    axes = rotation_from_quaternion(gaussians.rotations.detach().cpu().double())
    shortest = axes.gather(2, order[:, :1, None].expand(-1, 3, 1)).squeeze(2)
    return (shortest * flatness.unsqueeze(1)).float().numpy()


def neighbour_graph(
    nodes: NodeAttributes,
    *,
    neighbours: int,
    colour_width: float,
    feature_width: float,
    normal_width: float = 1.0,
    rows: NDArray[np.int64] | None = None,
) -> Any:
    """Symmetric edge strengths, scipy sparse rows (n, n), nothing on the diagonal.

    An edge is there where either end is among the nearest of the other. Every node with a
    neighbour keeps at least a trace of its edges, however unlike its neighbours are.

    Args:
        nodes: What edges compare.
        neighbours: Nearest neighbours of a node, itself not counted, at least 1.
        colour_width: Standard deviation of colours that count as alike.
        feature_width: The factor b of the squared median distance of features.
        normal_width: Standard deviation of the sine between normals that count as alike.
        rows: Nodes whose rows are wanted, ascending; None is all of them.
    """
    import scipy.sparse

    count = len(nodes.positions)
    wanted = count if rows is None else len(rows)
    neighbours = min(neighbours, count - 1)
    if neighbours < 1 or not wanted:
        return scipy.sparse.csr_matrix((wanted, count), dtype=np.float32)
    nearest, values = _nearest(nodes.positions, neighbours)
    # Where neighbours share a position all of them are as near as can be.
    local_width = np.maximum(values[:, -1].astype(np.float64), 1e-30)
    # A million nodes have 12 million edges: distances become strengths where they are.
    for block in _blocks(count):
        scale = local_width[block, None] * local_width[nearest[block]]
        values[block] = values[block] ** 2 / (2 * scale)
        if nodes.colours is not None:
            squared = _squared(nodes.colours, block, nearest[block])
            values[block] += squared / (2 * colour_width**2)
        if nodes.normals is not None:
            squared = _squared_sines(nodes.normals, block, nearest[block])
            values[block] += squared / (2 * normal_width**2)
    if nodes.features is not None:
        values += _feature_distances(nodes.features, nearest) / feature_width
    # Beyond this float32 would leave a node with unlike neighbours without any.
    np.minimum(values, 60.0, out=values)
    np.exp(np.negative(values, out=values), out=values)
    graph = _to_and_from(nearest, values, rows)
    graph.sort_indices()
    return graph


def _to_and_from(
    nearest: NDArray[np.int32], values: NDArray[np.float32], rows: NDArray[np.int64] | None
) -> Any:
    """Edges that either end has, of all nodes or of some: sparse (rows, n)."""
    import scipy.sparse

    count, neighbours = nearest.shape
    if rows is None:
        starts = np.arange(count + 1, dtype=np.int64) * neighbours
        graph = scipy.sparse.csr_matrix(
            (values.reshape(-1), nearest.reshape(-1), starts), shape=(count, count)
        )
        return graph.maximum(graph.T).tocsr()
    starts = np.arange(len(rows) + 1, dtype=np.int64) * neighbours
    shape = (len(rows), count)
    to: Any = scipy.sparse.csr_matrix(
        (values[rows].reshape(-1), nearest[rows].reshape(-1), starts), shape=shape
    )
    place = np.full(count, -1, np.int32)
    place[rows] = np.arange(len(rows), dtype=np.int32)
    entries: list[tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]] = []
    for block in _blocks(count):
        row = place[nearest[block]]
        one, other = np.nonzero(row >= 0)
        found = (block.start + one).astype(np.int32)
        entries.append((row[one, other], found, values[block][one, other]))
    ends, begins, strengths = (np.concatenate(part) for part in zip(*entries, strict=True))
    came: Any = scipy.sparse.csr_matrix((strengths, (ends, begins)), shape=shape)
    return to.maximum(came).tocsr()


def _nearest(
    positions: NDArray[np.float64], neighbours: int
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Each node's nearest others (n, k) and how far they are, near ones first."""
    count = len(positions)
    index = NeighbourIndex(torch.from_numpy(positions))
    nearest = np.empty((count, neighbours), dtype=np.int32)
    distance = np.empty((count, neighbours), dtype=np.float32)
    for rows in _blocks(count):
        found = index.nearest_others(neighbours, rows=torch.arange(rows.start, rows.stop))
        nearest[rows] = found.indices.numpy()
        distance[rows] = found.distances.numpy()
    return nearest, distance


def _squared(
    values: NDArray[np.float32], rows: slice, nearest: NDArray[np.int32]
) -> NDArray[np.float32]:
    """Squared distances of a block of nodes to their neighbours, a channel at a time."""
    total = np.zeros(nearest.shape, dtype=np.float32)
    for channel in range(values.shape[1]):
        column = values[:, channel]
        total += (column[rows, None] - column[nearest]) ** 2
    return total


def _squared_sines(
    normals: NDArray[np.float32], rows: slice, nearest: NDArray[np.int32]
) -> NDArray[np.float32]:
    """Squared length of the cross products with the neighbours, a component at a time."""
    total = np.zeros(nearest.shape, dtype=np.float32)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        own_i, own_j = normals[rows, i, None], normals[rows, j, None]
        total += (own_i * normals[:, j][nearest] - own_j * normals[:, i][nearest]) ** 2
    return total


def _feature_distances(
    features: NDArray[np.float32], nearest: NDArray[np.int32]
) -> NDArray[np.float32]:
    """Squared distances of unit features along edges, over their squared median.

    Edges with an end of which nothing is known count as the median.
    """
    length = np.linalg.norm(features, axis=1)
    known = length > 0
    unit = (features / np.where(known, length, 1)[:, None]).astype(np.float32)
    squared = np.concatenate(
        [_squared(unit, rows, nearest[rows]) for rows in _blocks(len(nearest))]
    )
    both = known[:, None] & known[nearest]
    median = float(np.median(squared[both])) if both.any() else 0.0
    if not median > 0:
        return np.zeros_like(squared)
    return np.where(both, squared / median, np.float32(1.0))


def transition_matrix(graph: Any) -> Any:
    r"""Rows that add up to 1: :math:`P = D^{-1} W`, a step of a random walk.

    Power iterations of P are those of the symmetric :math:`D^{-1/2} W D^{-1/2}` in other
    coordinates, :math:`P = D^{-1/2} (D^{-1/2} W D^{-1/2}) D^{1/2}`; P's values are probabilities.
    """
    import scipy.sparse

    degree = np.asarray(graph.sum(axis=1)).reshape(-1)
    inverse = np.divide(1.0, degree, out=np.zeros_like(degree), where=degree > 0)
    return (scipy.sparse.diags(inverse.astype(np.float32)) @ graph).tocsr()


def diffuse(
    transition: Any,
    shares: Any,
    known: NDArray[np.bool_],
    *,
    steps: int,
    max_shares: int,
) -> Any:
    r"""Shares after some steps of label propagation, from known nodes, which keep theirs.

    .. math:: x_i \leftarrow \sum_j P_{ij} x_j

    Args:
        transition: The rows of P of unknown nodes, sparse (unknown, n); they add up to at most 1.
        shares: Those of known nodes, sparse (n, ids), rows that add up to at most 1.
        known: (n,).
        steps: How often.
        max_shares: Largest shares of a node that are carried on, at least 1.

    Returns:
        x, sparse (n, ids).
    """
    import scipy.sparse

    free_rows, clamped_rows = np.flatnonzero(~known), np.flatnonzero(known)
    if not len(free_rows):
        return shares
    transition.sort_indices()  # so that sums do not depend on the order of what came
    # The part of known neighbours never changes.
    source = (transition[:, clamped_rows] @ shares[clamped_rows]).tocsr()
    free_transition = transition[:, free_rows].tocsr()
    current = shares[free_rows]
    for _ in range(steps):
        current = scipy.sparse.vstack(
            [
                strongest((source[rows] + free_transition[rows] @ current).tocsr(), max_shares)
                for rows in _blocks(len(free_rows))
            ],
            format="csr",
        )
    order = np.argsort(np.concatenate((free_rows, clamped_rows)), kind="stable")
    merged: Any = scipy.sparse.vstack([current, shares[clamped_rows]], format="csr")
    return merged[order]


def _blocks(count: int) -> Iterator[slice]:
    for start in range(0, count, _ROWS):
        yield slice(start, min(start + _ROWS, count))
