"""Minimum cuts of graphs with two terminals, exact, by SciPy's maximum flow."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_range, check_values
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, RangeError
from splatseg.prompting.graph import NeighbourGraph

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


# Graph cut: the border of a selection goes where neighbours are least alike.
#
# Every Gaussian i is in (x = 1) or out (x = 0). What is known of it is its membership p, what
# neighbours say is how alike they are; the labelling of least energy is taken,
#
# .. math:: E(x) = \sum_i e_i \bigl(-x_i \log p_i - (1 - x_i) \log (1 - p_i)\bigr)
#           + \frac{\lambda}{\bar d} \sum_{(i, j)} w_{ij} [x_i \ne x_j]
#
# with e the weight of a Gaussian's evidence in [0, 1], w the strengths of the neighbour graph
# (`graph`) and :math:`\bar d` their mean sum over the neighbours of a Gaussian. Gaussians that a
# person clicked are held.
#
# The least energy is that of a minimum cut, found exactly by maximum flow. Only a *band* around the
# border takes part: Gaussians a few steps over the graph from an edge whose ends differ, and the
# unsure ones that hang together with them. All others stay on their side. That leaves out nothing
# that is alone: a piece whose members all rather are out, and which touches nothing that is in,
# has a lesser energy out.
#
# References:
#     Boykov, Veksler and Zabih, Fast Approximate Energy Minimization via Graph Cuts (2001).
#     Kolmogorov and Zabih, What Energy Functions Can Be Minimized via Graph Cuts? (2004), thm. 4.1.
#     Boykov and Jolly, Interactive Graph Cuts for Optimal Boundary & Region Segmentation (2001):
#     hard seeds, and unary terms from what was marked.


@dataclass(frozen=True, slots=True, kw_only=True)
class RefineOptions:
    """How the border of a selection is moved."""

    smoothness: float = 4.0
    """Lambda: what it costs a Gaussian to be on another side than all of its neighbours, which
    are as alike as they are on average in the scene, in nats of its membership. 4 outweighs a
    membership of 0.98. 0 changes nothing."""

    min_probability: float = 0.02
    """Membership is taken to be at least this and at most 1 less this, in (0, 0.5): how sure the
    source of it can be."""

    band: int = 2
    """Steps over the graph from the border that Gaussians are decided anew; at least 1."""

    unsure: float = 0.25
    """Gaussians whose membership and its complement are both at least this, in [0, 0.5], are
    decided anew where they hang together with the band."""

    max_band: int = 20_000
    """Most Gaussians that are decided anew, those nearest to the border over the graph first."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if not 0 <= self.smoothness < float("inf"):
            raise RangeError(f"smoothness: expected 0 or more, got {self.smoothness}.")
        if not 0 < self.min_probability < 0.5:
            raise RangeError(
                f"min_probability: expected a value in (0, 0.5), got {self.min_probability}."
            )
        check_range("unsure", self.unsure, 0.0, 0.5)
        for name in ("band", "max_band"):
            if getattr(self, name) < 1:
                raise RangeError(f"{name}: expected at least 1, got {getattr(self, name)}.")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Refined:
    """A selection whose border was moved."""

    confidence: Float[Tensor, "n"]
    """Probability in [0, 1] that a Gaussian belongs, given its own membership and the sides that
    its neighbours are on; more than 0.5 for exactly those that are in. Outside the band it is the
    membership given."""

    band: Int64[Tensor, "m"]
    """Rows that were decided anew, ascending."""

    @property
    def mask(self) -> Bool[Tensor, "n"]:
        """Which Gaussians are in."""
        return self.confidence > 0.5


@boundary
def refine(
    graph: NeighbourGraph,
    membership: Float[Tensor, "n"],
    *,
    evidence: Float[Tensor, "n"] | None = None,
    inside: Int64[Tensor, "a"] | None = None,
    outside: Int64[Tensor, "b"] | None = None,
    options: RefineOptions | None = None,
) -> Refined:
    """Move the border of a selection to where neighbours are least alike.

    Args:
        graph: The neighbours of the scene's Gaussians, see `build_graph`.
        membership: p, the probability in [0, 1] that a Gaussian belongs; more than 0.5 is in.
        evidence: e, how much that counts, in [0, 1]; None is 1 everywhere. 0 leaves a Gaussian
            to its neighbours.
        inside: Rows that are in, whatever else is known.
        outside: Rows that are out.
        options: How the border is moved.

    Returns:
        The membership of before with that of the band decided anew.

    Raises:
        ShapeError: If a value is not of the graph's Gaussians.
        RangeError: If a membership or an evidence is not in [0, 1], or a row is none.
        InputError: If a row is both in and out.

    Example:
        >>> from splatseg.core import Gaussians
        >>> from splatseg.prompting.graph import GraphOptions, build_graph
        >>> row = torch.arange(5.0).unsqueeze(1) * torch.tensor([[1.0, 0.0, 0.0]])
        >>> g = Gaussians(means=row, rotations=torch.eye(4)[:1].expand(5, 4),
        ...               scales=torch.ones(5, 3), opacities=torch.ones(5),
        ...               sh=torch.zeros(5, 1, 3))
        >>> graph = build_graph(g, options=GraphOptions(neighbours=2))
        >>> refine(graph, torch.tensor([0.9, 0.9, 0.4, 0.9, 0.9])).mask
        tensor([True, True, True, True, True])
    """
    options = options or RefineOptions()
    _check(graph, membership, evidence)
    seeds = _seeds(len(graph), inside, outside)
    p = membership.detach().cpu().double()
    p = torch.where(seeds != 0, (seeds + 1) / 2, p)
    mask = p > 0.5
    band = _band(graph, p, mask, seeds == 0, options)
    if not len(band):
        return Refined(confidence=p.float(), band=band)
    weight = None if evidence is None else evidence.detach().cpu().double()[band]
    unary = log_odds(p[band], options.min_probability)
    unary = unary if weight is None else unary * weight
    terms = _band_terms(graph, band, mask, unary, options.smoothness)
    chosen = minimum_cut(terms.unary, terms.first, terms.second, terms.weights)
    conditional = torch.from_numpy(_conditional(terms, chosen)).float()
    decided = torch.from_numpy(chosen)
    just_in = float(np.nextafter(np.float32(0.5), np.float32(1)))
    conditional = torch.where(decided, conditional.clamp_min(just_in), conditional.clamp_max(0.5))
    return Refined(confidence=p.float().index_copy(0, band, conditional), band=band)


def log_odds(probability: Float[Tensor, "n"], min_probability: float) -> Float[Tensor, "n"]:
    """log(p / (1 - p)), with p kept away from 0 and 1."""
    return torch.logit(probability.clamp(min_probability, 1 - min_probability))


def _check(graph: NeighbourGraph, membership: Tensor, evidence: Tensor | None) -> None:
    graph.check("membership", membership)
    check_values("membership", membership, 0.0, 1.0)
    if evidence is not None:
        graph.check("evidence", evidence)
        check_values("evidence", evidence, 0.0, 1.0)


def _seeds(count: int, inside: Tensor | None, outside: Tensor | None) -> Tensor:
    """1 where a row is held in, -1 where it is held out, 0 elsewhere."""
    seeds = torch.zeros(count, dtype=torch.float64)
    for name, rows, side in (("inside", inside, 1.0), ("outside", outside, -1.0)):
        if rows is None or not len(rows):
            continue
        low, high = int(rows.min()), int(rows.max())
        if not 0 <= low <= high < count:
            raise RangeError(f"{name}: expected rows in [0, {count}), got {low} to {high}.")
        both = seeds[rows.cpu()] == -side
        if bool(both.any()):
            row = int(rows.cpu()[both][0])
            raise InputError(
                f"outside: expected rows that are not held inside, got {row} ({int(both.sum())} "
                f"of {len(rows)} rows)."
            )
        seeds[rows.cpu()] = side
    return seeds


def _band(
    graph: NeighbourGraph, p: Tensor, mask: Tensor, free: Tensor, options: RefineOptions
) -> Int64[Tensor, "m"]:
    """Rows that are decided anew: near the border, and unsure ones that hang together with them."""
    rows = _at_border(graph, mask)
    taken = torch.zeros(len(graph), dtype=torch.bool)
    taken[rows] = True
    unsure = torch.minimum(p, 1 - p) >= options.unsure
    found = [rows[free[rows]]]
    count, step = len(found[0]), 1
    while len(rows) and count < options.max_band:
        near = graph.edges(rows).second
        near = near[~taken[near]]
        if step >= options.band:
            near = near[unsure[near]]
        rows = torch.unique(near)
        taken[rows] = True
        found.append(rows[free[rows]])
        count += len(found[-1])
        step += 1
    return torch.cat(found)[: options.max_band].sort().values


def _at_border(graph: NeighbourGraph, mask: Tensor) -> Int64[Tensor, "m"]:
    """Rows with a neighbour on the other side, ascending."""
    # The members are few and the scene is large: what they border on is found from their side.
    lesser = mask if 2 * int(mask.sum()) <= len(mask) else ~mask
    rows = torch.nonzero(lesser).squeeze(1)
    edges = graph.edges(rows)
    across = ~lesser[edges.second]
    return torch.unique(torch.cat((rows[edges.first[across]], edges.second[across])))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _BandTerms:
    """The energy of the band alone; positive unary terms prefer in."""

    unary: NDArray[np.float64]
    first: NDArray[np.int64]
    second: NDArray[np.int64]
    weights: NDArray[np.float64]


def _band_terms(
    graph: NeighbourGraph, band: Tensor, mask: Tensor, unary: Tensor, smoothness: float
) -> _BandTerms:
    """Neighbours outside the band stay on their side: edges to them are unary terms."""
    edges = graph.edges(band)
    weights = edges.strengths.double() * (smoothness / graph.mean_degree)
    position = torch.full((len(graph),), -1, dtype=torch.int64)
    position[band] = torch.arange(len(band))
    other = position[edges.second]
    fixed = other < 0
    sides = torch.where(mask[edges.second[fixed]], 1.0, -1.0)
    unary = unary.index_add(0, edges.first[fixed], weights[fixed] * sides)
    once = edges.first < other
    return _BandTerms(
        unary=unary.numpy(),
        first=edges.first[once].numpy(),
        second=other[once].numpy(),
        weights=weights[once].numpy(),
    )


def _conditional(terms: "_BandTerms", chosen: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Probability of each node being in, given the sides of its neighbours.

    On a labelling of least energy a node prefers the side it is on, so that it is more than 0.5
    for exactly the nodes that are in, up to the rounding of capacities.
    """
    sides = np.where(chosen, 1.0, -1.0)
    field = terms.unary.copy()
    np.add.at(field, terms.first, terms.weights * sides[terms.second])
    np.add.at(field, terms.second, terms.weights * sides[terms.first])
    return 1 / (1 + np.exp(-np.clip(field, -500, 500)))
