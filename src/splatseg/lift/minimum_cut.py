r"""The exact minimum of a binary energy, by maximum flow.

Boykov and Jolly, Interactive Graph Cuts for Optimal Boundary & Region Segmentation (2001);
Kolmogorov and Zabih, What Energy Functions Can Be Minimized via Graph Cuts? (2004), theorem 4.1.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

_MAX_CAPACITY = 2**30 - 1
"""Largest capacity: a residual capacity is up to twice one, and SciPy's are int32."""

_MAX_FLOW = 2**31 - 1


def minimum_cut(
    unary: NDArray[np.float64],
    first: NDArray[np.int64],
    second: NDArray[np.int64],
    weights: NDArray[np.float64],
) -> NDArray[np.bool_]:
    r"""Which nodes are in, for the least :math:`-\sum_i u_i x_i + \sum_e w_e [x_a \ne x_b]`.

    Exact for values that are whole numbers of the unit in which capacities are rounded; of
    several labellings of least energy, the one with the fewest nodes in.

    Args:
        unary: u (n,), what is gained by node i being in; negative where it is lost.
        first: One end a of each edge, each edge once.
        second: The other end b.
        weights: w, what an edge costs whose ends differ, 0 or more.
    """
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow

    count = len(unary)
    if not count or not (unary > 0).any():
        return np.zeros(count, dtype=np.bool_)
    source, sink = count, count + 1
    scale = _scale(unary, weights)
    edge_units = np.rint(weights * scale).astype(np.int32)
    gains = np.rint(unary * scale).astype(np.int64)
    nodes = np.arange(count)
    tails = np.concatenate((first, second, np.full(count, source), nodes))
    heads = np.concatenate((second, first, nodes, np.full(count, sink)))
    units = np.concatenate((edge_units, edge_units, np.maximum(gains, 0), np.maximum(-gains, 0)))
    capacities: Any = csr_matrix(
        (units.astype(np.int32), (tails, heads)), shape=(count + 2, count + 2)
    )
    capacities.eliminate_zeros()
    flow = maximum_flow(capacities, source, sink).flow
    residual = capacities - flow
    residual.data = np.maximum(residual.data, 0)
    residual.eliminate_zeros()
    reached = breadth_first_order(residual, source, return_predecessors=False)
    result = np.zeros(count + 2, dtype=np.bool_)
    result[reached] = True
    return result[:count]


def _scale(unary: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    """Units of capacity per unit of energy: as fine as whole numbers of 32 bits allow."""
    largest = max(float(np.abs(unary).max()), float(weights.max(initial=0.0)))
    # No flow is more than what leaves the source, or what enters the sink.
    flow = min(float(np.maximum(unary, 0).sum()), float(np.maximum(-unary, 0).sum()))
    return min(
        _MAX_CAPACITY / max(largest, 1e-300),
        (_MAX_FLOW - len(unary)) / max(flow, 1e-300),
    )
