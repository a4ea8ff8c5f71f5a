r"""What neighbours say of a selection: specks, holes, hidden Gaussians, and its border.

The neighbour graph of a scene says which Gaussians are neighbours, how alike they are
(`lift.neighbour_graph`: distance, colour, normal), and whether they touch. For 400 k Gaussians
that takes seconds to find and milliseconds to look up, so a session keeps one.

A *hole* is a connected piece of Gaussians that are not selected and around which nearly all are;
a *speck* is a small connected piece of selected ones apart from the rest. Pieces hang together
where ellipsoids touch (`selection.components`). A hole is looked for from the selection outwards
and only as far as holes may be large, so that the time depends on the selection and not on the
scene.

A *hidden* Gaussian is one that no view explains: it lies inside or behind things. Its membership
is the share of random walks over the neighbour graph that first meet evidence inside, among those
that meet any, as in `lift.completion`,

.. math:: (a_i, b_i) \leftarrow \sum_j P_{ij} (a_j, b_j), \qquad P = D^{-1} W, \qquad
          p_i = \frac{a_i}{a_i + b_i}

with (p, 1 - p) held where p is known.

The *border* of a selection goes where neighbours are least alike: every Gaussian i is in (x = 1) or
out (x = 0), and of all labellings the one of least energy is taken,

.. math:: E(x) = \sum_i \bigl(-x_i \log p_i - (1 - x_i) \log (1 - p_i)\bigr)
          + \frac{\lambda}{\bar d} \sum_{(i, j)} w_{ij} [x_i \ne x_j]

with the strengths w of the graph and :math:`\bar d` their mean sum over the neighbours of a
Gaussian. Gaussians that a person clicked are held. The least energy is that of a minimum cut, found
exactly by maximum flow. Only a *band* around the border takes part: Gaussians a few steps over the
graph from an edge whose ends differ, and the unsure ones that hang together with them.

Boykov and Jolly, Interactive Graph Cuts for Optimal Boundary & Region Segmentation (2001);
Kolmogorov and Zabih, What Energy Functions Can Be Minimized via Graph Cuts? (2004), theorem 4.1.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_shape, check_values
from splatseg.core import Gaussians, Selection
from splatseg.core.boundary import boundary
from splatseg.core.options import Count
from splatseg.lift.minimum_cut import minimum_cut
from splatseg.lift.neighbour_graph import (
    NodeAttributes,
    flat_normals,
    neighbour_graph,
    transition_matrix,
)
from splatseg.selection import touching

_NEIGHBOURS = 12
"""Nearest Gaussians of each one; an edge is there where either end is among the other's."""

_COLOUR_WIDTH = 0.1
"""Standard deviation of colours in [0, 1] that count as alike."""

_NORMAL_WIDTH = 0.5
"""Standard deviation of the sine between normals of flat Gaussians that count as alike."""

_MAX_HOLE = 20
"""Most Gaussians of a hole that is filled."""

_MIN_ENCLOSED = 0.9
"""Minimum share of the neighbours around a hole that are selected."""

_MAX_SPECK = 10
"""Most Gaussians of a speck that is removed."""

_SPREAD_STEPS = 20
"""Steps over the graph that memberships spread to hidden Gaussians."""

_MIN_MEMBER = 0.25
"""Membership of a Gaussian from which it spreads to hidden ones; those that none so likely leads to
are out. The lower, the more of the scene is looked at."""

_SMOOTHNESS = 4.0
"""Lambda: what it costs a Gaussian to be on another side than all of its neighbours, which are as
alike as they are on average in the scene, in nats of its membership: outweighs one of 0.98."""

_MIN_PROBABILITY = 0.02
"""Membership is taken to be at least this and at most 1 less this: how sure a source can be."""

_BAND = 2
"""Steps over the graph from the border that Gaussians are decided anew."""

_UNSURE = 0.25
"""Gaussians whose membership and its complement are both at least this are decided anew where they
hang together with the band."""

_MAX_BAND = 20_000
"""Most Gaussians that are decided anew, those nearest to the border over the graph first."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Edges:
    """Edges that leave some rows, in the order of the rows asked for."""

    first: Int64[Tensor, "edges"]
    """Index into the rows that were asked for."""

    second: Int64[Tensor, "edges"]
    """The neighbour, a row of the scene."""

    strengths: Float[Tensor, "edges"]
    """How alike the ends are, in (0, 1]."""

    touching: Bool[Tensor, "edges"]
    """Whether their ellipsoids of two standard deviations touch."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NeighbourGraph:
    """Neighbours of every Gaussian, how alike they are and whether they touch; symmetric.

    Make it with `build_graph`. 9 bytes an edge and 5 one that touches: about 60 MB for 334 k
    Gaussians.
    """

    strengths: Any
    """``scipy.sparse.csr_matrix`` (n, n) of float32 in (0, 1], nothing on the diagonal."""

    touching: Bool[Tensor, "edges"]
    """Of each entry of `strengths`, in its order."""

    mean_degree: float
    """Mean sum of the strengths of a Gaussian's edges; 1 where there are no edges."""

    contacts: Any = field(init=False, repr=False)
    """``scipy.sparse.csr_matrix`` (n, n) of bool: the edges that touch."""

    def __post_init__(self) -> None:
        from scipy.sparse import csr_matrix

        matrix, there = self.strengths, self.touching.numpy()
        before = np.concatenate(([0], np.cumsum(there, dtype=np.int32)), dtype=np.int32)
        entries = (there[there], matrix.indices[there], before[matrix.indptr])
        object.__setattr__(self, "contacts", csr_matrix(entries, shape=matrix.shape))

    def __len__(self) -> int:
        return int(self.strengths.shape[0])

    def edges(self, rows: Int64[Tensor, "m"]) -> Edges:
        """All edges that leave some rows; a row may be asked for twice."""
        matrix = self.strengths
        chosen = rows.numpy()
        starts = matrix.indptr[chosen].astype(np.int64)
        sizes = matrix.indptr[chosen + 1].astype(np.int64) - starts
        before = np.cumsum(sizes) - sizes
        entries = np.repeat(starts - before, sizes) + np.arange(int(sizes.sum()))
        return Edges(
            first=torch.from_numpy(np.repeat(np.arange(len(chosen)), sizes)),
            second=torch.from_numpy(matrix.indices[entries].astype(np.int64)),
            strengths=torch.from_numpy(matrix.data[entries]),
            touching=self.touching[torch.from_numpy(entries)],
        )


@boundary
def build_graph(gaussians: Gaussians, *, neighbours: Count = _NEIGHBOURS) -> NeighbourGraph:
    """Find the neighbours of every Gaussian; seconds for a scene, so keep what it returns.

    Args:
        gaussians: The Gaussians of the scene.
        neighbours: Nearest Gaussians of each one that are its neighbours.

    Raises:
        RangeError: If a value is NaN or infinite.
    """
    gaussians.check_values()
    gaussians = gaussians.to(device="cpu")
    matrix = neighbour_graph(
        NodeAttributes(
            positions=gaussians.means.detach().double().numpy(),
            colours=gaussians.colours.detach().float().clamp(0, 1).numpy(),
            normals=flat_normals(gaussians),
        ),
        neighbours=neighbours,
        colour_width=_COLOUR_WIDTH,
        feature_width=1.0,
        normal_width=_NORMAL_WIDTH,
    )
    first = torch.from_numpy(np.repeat(np.arange(len(gaussians)), np.diff(matrix.indptr)))
    second = torch.from_numpy(matrix.indices.astype(np.int64))
    degree = float(matrix.data.sum(dtype=np.float64)) / max(len(gaussians), 1)
    # Each edge is asked for in both directions alike, so that rounding agrees.
    low, high = torch.minimum(first, second), torch.maximum(first, second)
    return NeighbourGraph(
        strengths=matrix,
        touching=touching(gaussians, low, high),
        mean_degree=degree if degree > 0 else 1.0,
    )


def holes(graph: NeighbourGraph, selection: Selection) -> Selection:
    """Gaussians that are not selected and lie in holes of the selection.

    ``selection | holes(graph, selection)`` has none.
    """
    check_shape("selection", selection.mask, (len(graph),))
    mask = selection.mask.cpu()
    filled = torch.zeros_like(mask)
    if not selection.count or selection.count == len(selection):
        return Selection(mask=filled)
    rows, piece_of = _small_pieces(graph, mask, _MAX_HOLE)
    if not len(rows):
        return Selection(mask=filled)
    count = int(piece_of.max()) + 1
    number = torch.full((len(mask),), -1, dtype=torch.int64)
    number[rows] = piece_of
    edges = graph.edges(rows)
    own = piece_of[edges.first]
    around = number[edges.second] != own
    total = torch.bincount(own[around], minlength=count)
    selected = torch.bincount(own[around & mask[edges.second]], minlength=count)
    hole = (selected > 0) & (selected >= _MIN_ENCLOSED * total)
    filled[rows[hole[piece_of]]] = True
    return Selection(mask=filled)


def _small_pieces(
    graph: NeighbourGraph, mask: Bool[Tensor, "n"], largest: int
) -> tuple[Int64[Tensor, "m"], Int64[Tensor, "m"]]:
    """Whole pieces of at most `largest` rows outside `mask`, among them all that border on it.

    Grows from the rows that border on the mask, a step at a time, until every piece is whole or
    too large. Returns rows, and the number of the piece of each.
    """
    outside = ~mask.numpy()
    beside = np.zeros(len(outside), dtype=np.bool_)
    beside[graph.strengths[~outside].indices] = True
    rows = np.flatnonzero(beside & outside)
    position = np.full(len(outside), -1, dtype=np.int32)
    while True:
        position[rows] = np.arange(len(rows), dtype=np.int32)
        near = graph.contacts[rows]
        piece_of = _pieces_among(near, position)
        small = np.bincount(piece_of) <= largest
        # Rows that are reached next are those that small pieces have not ended at.
        growing = np.repeat(small[piece_of], np.diff(near.indptr))
        ahead = near.indices[growing]
        beside[:] = False
        beside[ahead[position[ahead] < 0]] = True
        further = np.flatnonzero(beside & outside)
        if not len(further):
            whole = small[piece_of]
            numbers = np.unique(piece_of[whole], return_inverse=True)[1]
            return torch.from_numpy(rows[whole]), torch.from_numpy(numbers)
        rows = np.concatenate((rows, further))


def _pieces_among(near: Any, position: NDArray[np.int32]) -> NDArray[np.int64]:
    """Pieces of some rows that hang together among themselves, numbered by their first row.

    Args:
        near: The contacts of each of the rows, in all of the scene; symmetric among them.
        position: Which of the rows a Gaussian is, -1 for none.
    """
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    count = near.shape[0]
    other = position[near.indices]
    there = other >= 0
    before = np.concatenate(([0], np.cumsum(there, dtype=np.int32)), dtype=np.int32)
    other = other[there]
    ones = np.ones(len(other))  # of 64 bits: what SciPy would convert them to
    links = csr_matrix((ones, other, before[near.indptr]), shape=(count, count))
    # All links go both ways: strongly connected is connected, and needs no transpose.
    found, labels = connected_components(links, directed=True, connection="strong")
    first = np.empty(found, dtype=np.int64)
    first[labels[::-1]] = np.arange(count)[::-1]  # the first row of each is written last
    number = np.empty(found, dtype=np.int64)
    number[np.argsort(first)] = np.arange(found)
    return number[labels]


def specks(
    graph: NeighbourGraph, selection: Selection, *, clicked: Selection | None = None
) -> Selection:
    """Selected Gaussians in small pieces apart from what was clicked, or from the largest piece.

    Args:
        graph: The neighbours of the scene's Gaussians.
        selection: What may have specks.
        clicked: Gaussians that a person pointed at: a piece that holds one is no speck. None, or
            none of them selected, keeps the largest piece.
    """
    check_shape("selection", selection.mask, (len(graph),))
    if clicked is not None:
        check_shape("clicked", clicked.mask, (len(graph),))
    mask = selection.mask.cpu()
    found = torch.zeros_like(mask)
    rows = torch.nonzero(mask).squeeze(1)
    if not len(rows):
        return Selection(mask=found)
    position = np.full(len(graph), -1, dtype=np.int32)
    position[rows.numpy()] = np.arange(len(rows), dtype=np.int32)
    piece_of = torch.from_numpy(_pieces_among(graph.contacts[rows.numpy()], position))
    sizes = torch.bincount(piece_of)
    speck = sizes <= _MAX_SPECK
    held = piece_of[clicked.mask.cpu()[rows]] if clicked is not None else piece_of[:0]
    speck[held if len(held) else sizes.argmax()] = False
    found[rows[speck[piece_of]]] = True
    return Selection(mask=found)


def complete_membership(
    graph: NeighbourGraph, membership: Float[Tensor, "n"], hidden: Bool[Tensor, "n"]
) -> Float[Tensor, "n"]:
    """Memberships of Gaussians that no view explains, from those of their neighbours.

    Args:
        graph: The neighbours of the scene's Gaussians.
        membership: Probability in [0, 1] that a Gaussian belongs; of hidden ones it is not read.
        hidden: True where nothing is known of a Gaussian.

    Returns:
        The memberships, with those of hidden Gaussians the share that arrived; 0 where only hidden
        and unlikely ones are around.
    """
    check_shape("membership", membership, (len(graph),))
    check_shape("hidden", hidden, (len(graph),))
    unknown = hidden.cpu()
    values = torch.where(unknown, 0.0, membership.detach().cpu().double())
    check_values("membership", values, 0.0, 1.0)
    rows = _near_members(graph, values >= _MIN_MEMBER, unknown)
    if not len(rows):
        return values.float()
    transition = transition_matrix(graph.strengths[rows.numpy()])
    known = (~unknown).double()
    shares = torch.stack((values, known - values), dim=1).numpy()
    source = transition @ shares
    among_hidden = transition[:, rows.numpy()]
    arrived = source
    for _ in range(_SPREAD_STEPS - 1):
        arrived = source + among_hidden @ arrived
    total = torch.from_numpy(arrived.sum(axis=1))
    inferred = torch.from_numpy(arrived[:, 0]) / total.clamp_min(1e-300)
    return values.index_copy(0, rows, inferred.clamp(0, 1)).float()


def _near_members(graph: NeighbourGraph, member: Tensor, hidden: Tensor) -> Int64[Tensor, "m"]:
    """Hidden rows that so many steps over hidden ones lead to from a member, ascending."""
    reached = torch.zeros_like(hidden)
    rows = torch.nonzero(hidden).squeeze(1)
    edges = graph.edges(rows)
    frontier = torch.unique(rows[edges.first[member[edges.second]]])
    for _ in range(_SPREAD_STEPS):
        if not len(frontier):
            break
        reached[frontier] = True
        ahead = graph.edges(frontier).second
        frontier = torch.unique(ahead[hidden[ahead] & ~reached[ahead]])
    return torch.nonzero(reached).squeeze(1)


def graph_cut(
    graph: NeighbourGraph,
    membership: Float[Tensor, "n"],
    *,
    inside: Int64[Tensor, "a"],
    outside: Int64[Tensor, "b"],
) -> Float[Tensor, "n"]:
    """Move the border of a selection to where neighbours are least alike.

    Args:
        graph: The neighbours of the scene's Gaussians.
        membership: p, the probability in [0, 1] that a Gaussian belongs; more than 0.5 is in.
        inside: Rows that are in, whatever else is known.
        outside: Rows that are out, none of them inside.

    Returns:
        Probability in [0, 1] that a Gaussian belongs, given its own membership and the sides that
        its neighbours are on; more than 0.5 for exactly those that are in. Outside the band it is
        the membership given.
    """
    check_shape("membership", membership, (len(graph),))
    check_values("membership", membership, 0.0, 1.0)
    p = membership.detach().cpu().double().clone()
    held = torch.zeros(len(p), dtype=torch.bool)
    for rows, value in ((inside.cpu(), 1.0), (outside.cpu(), 0.0)):
        p[rows] = value
        held[rows] = True
    mask = p > 0.5
    band = _band(graph, p, mask, ~held)
    if not len(band):
        return p.float()
    unary = torch.logit(p[band].clamp(_MIN_PROBABILITY, 1 - _MIN_PROBABILITY))
    terms = _band_terms(graph, band, mask, unary)
    chosen = minimum_cut(terms.unary, terms.first, terms.second, terms.weights)
    conditional = torch.from_numpy(_conditional(terms, chosen)).float()
    just_in = float(np.nextafter(np.float32(0.5), np.float32(1)))
    conditional = torch.where(
        torch.from_numpy(chosen), conditional.clamp_min(just_in), conditional.clamp_max(0.5)
    )
    return p.float().index_copy(0, band, conditional)


def _band(graph: NeighbourGraph, p: Tensor, mask: Tensor, free: Tensor) -> Int64[Tensor, "m"]:
    """Rows that are decided anew: near the border, and unsure ones that hang together with them."""
    rows = _at_border(graph, mask)
    taken = torch.zeros(len(graph), dtype=torch.bool)
    taken[rows] = True
    unsure = torch.minimum(p, 1 - p) >= _UNSURE
    found = [rows[free[rows]]]
    count, step = len(found[0]), 1
    while len(rows) and count < _MAX_BAND:
        near = graph.edges(rows).second
        near = near[~taken[near]]
        if step >= _BAND:
            near = near[unsure[near]]
        rows = torch.unique(near)
        taken[rows] = True
        found.append(rows[free[rows]])
        count += len(found[-1])
        step += 1
    return torch.cat(found)[:_MAX_BAND].sort().values


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


def _band_terms(graph: NeighbourGraph, band: Tensor, mask: Tensor, unary: Tensor) -> _BandTerms:
    """Neighbours outside the band stay on their side: edges to them are unary terms."""
    edges = graph.edges(band)
    weights = edges.strengths.double() * (_SMOOTHNESS / graph.mean_degree)
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
