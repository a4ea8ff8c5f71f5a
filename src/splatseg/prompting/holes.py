r"""Holes, specks and hidden Gaussians of a selection.

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
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatseg._check import check_range, check_values
from splatseg.core import Selection
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import RangeError
from splatseg.lift.neighbour_graph import transition_matrix
from splatseg.prompting.graph import NeighbourGraph
from splatseg.selection import pieces


@dataclass(frozen=True, slots=True, kw_only=True)
class HoleOptions:
    """Which pieces are holes, specks and hidden Gaussians."""

    max_hole: int = 20
    """Most Gaussians of a hole that is filled; 0 fills none."""

    min_enclosed: float = 0.9
    """Minimum share, in [0, 1], of the neighbours around a hole that are selected."""

    max_speck: int = 10
    """Most Gaussians of a speck that is removed; 0 removes none."""

    spread_steps: int = 20
    """Steps over the graph that memberships spread to hidden Gaussians; at least 1."""

    min_member: float = 0.25
    """Membership, in (0, 0.5], of a Gaussian from which it spreads to hidden ones; those that
    none so likely leads to are out. The lower, the more of the scene is looked at."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_range("min_enclosed", self.min_enclosed, 0.0, 1.0)
        if not 0 < self.min_member <= 0.5:
            raise RangeError(f"min_member: expected a value in (0, 0.5], got {self.min_member}.")
        for name, least in (("max_hole", 0), ("max_speck", 0), ("spread_steps", 1)):
            if getattr(self, name) < least:
                raise RangeError(f"{name}: expected at least {least}, got {getattr(self, name)}.")


@boundary
def holes(
    graph: NeighbourGraph, selection: Selection, *, options: HoleOptions | None = None
) -> Selection:
    """Gaussians that are not selected and lie in holes of the selection.

    Args:
        graph: The neighbours of the scene's Gaussians, see `build_graph`.
        selection: What may have holes.
        options: Which pieces are holes.

    Returns:
        The Gaussians of the holes; ``selection | holes(graph, selection)`` has none.

    Raises:
        ShapeError: If the selection is of other Gaussians than the graph.
    """
    options = options or HoleOptions()
    graph.check("selection", selection.mask)
    mask = selection.mask.cpu()
    filled = torch.zeros_like(mask)
    if not options.max_hole or not selection.count or selection.count == len(selection):
        return Selection(mask=filled)
    rows, piece_of = _small_pieces(graph, mask, options.max_hole)
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
    hole = (selected > 0) & (selected >= options.min_enclosed * total)
    filled[rows[hole[piece_of]]] = True
    return Selection(mask=filled)


def _small_pieces(
    graph: NeighbourGraph, mask: Bool[Tensor, "n"], largest: int
) -> tuple[Int64[Tensor, "m"], Int64[Tensor, "m"]]:
    """Whole pieces of at most `largest` rows outside `mask`, among them all that border on it.

    Grows from the rows that border on the mask, a step at a time, until every piece is whole or
    too large. Returns rows, and the number of the piece of each.
    """
    edges = graph.edges(torch.nonzero(mask).squeeze(1))
    rows = torch.unique(edges.second[~mask[edges.second]])
    reached = torch.zeros(len(mask), dtype=torch.bool)
    reached[rows] = True
    position = torch.full((len(mask),), -1, dtype=torch.int64)
    while True:
        position[rows] = torch.arange(len(rows))
        edges = graph.edges(rows)
        linked = edges.touching & ~mask[edges.second]
        first, second = edges.first[linked], edges.second[linked]
        known = reached[second]
        piece_of = pieces(len(rows), first[known], position[second[known]])
        small = torch.bincount(piece_of) <= largest
        # Rows that are reached next are those that small pieces have not ended at.
        ahead = ~known & small[piece_of[first]]
        further = torch.unique(second[ahead])
        if not len(further):
            whole = small[piece_of]
            return rows[whole], torch.unique(piece_of[whole], return_inverse=True)[1]
        rows = torch.cat((rows, further))
        reached[further] = True


@boundary
def specks(
    graph: NeighbourGraph,
    selection: Selection,
    *,
    clicked: Selection | None = None,
    options: HoleOptions | None = None,
) -> Selection:
    """Selected Gaussians in small pieces apart from what was clicked, or from the largest piece.

    Args:
        graph: The neighbours of the scene's Gaussians, see `build_graph`.
        selection: What may have specks.
        clicked: Gaussians that a person pointed at: a piece that holds one is no speck. None, or
            none of them selected, keeps the largest piece.
        options: Which pieces are specks.

    Returns:
        The Gaussians of the specks, all of them selected.

    Raises:
        ShapeError: If a selection is of other Gaussians than the graph.
    """
    options = options or HoleOptions()
    graph.check("selection", selection.mask)
    if clicked is not None:
        graph.check("clicked", clicked.mask)
    mask = selection.mask.cpu()
    found = torch.zeros_like(mask)
    rows = torch.nonzero(mask).squeeze(1)
    if not len(rows) or not options.max_speck:
        return Selection(mask=found)
    piece_of = pieces_of(graph, rows)
    sizes = torch.bincount(piece_of)
    speck = sizes <= options.max_speck
    held = piece_of[clicked.mask.cpu()[rows]] if clicked is not None else piece_of[:0]
    speck[held if len(held) else sizes.argmax()] = False
    found[rows[speck[piece_of]]] = True
    return Selection(mask=found)


def pieces_of(graph: NeighbourGraph, rows: Int64[Tensor, "m"]) -> Int64[Tensor, "m"]:
    """The connected piece of each of some distinct rows among them, numbered by first row."""
    position = torch.full((len(graph),), -1, dtype=torch.int64)
    position[rows] = torch.arange(len(rows))
    edges = graph.edges(rows)
    linked = edges.touching & (position[edges.second] >= 0)
    return pieces(len(rows), edges.first[linked], position[edges.second[linked]])


@boundary
def complete_membership(
    graph: NeighbourGraph,
    membership: Float[Tensor, "n"],
    hidden: Bool[Tensor, "n"],
    *,
    options: HoleOptions | None = None,
) -> Float[Tensor, "n"]:
    """Memberships of Gaussians that no view explains, from those of their neighbours.

    Args:
        graph: The neighbours of the scene's Gaussians, see `build_graph`.
        membership: Probability in [0, 1] that a Gaussian belongs; of hidden ones it is not read.
        hidden: True where nothing is known of a Gaussian.
        options: How far memberships spread.

    Returns:
        The memberships, with those of hidden Gaussians the share that arrived; 0 where only hidden
        and unlikely ones are around.

    Raises:
        ShapeError: If a value is not of the graph's Gaussians.
        RangeError: If a membership is not in [0, 1].

    Example:
        >>> from splatseg.core import Gaussians
        >>> from splatseg.prompting.graph import GraphOptions, build_graph
        >>> row = torch.arange(3.0).unsqueeze(1) * torch.tensor([[1.0, 0.0, 0.0]])
        >>> g = Gaussians(means=row, rotations=torch.eye(4)[:1].expand(3, 4),
        ...               scales=torch.ones(3, 3), opacities=torch.ones(3),
        ...               sh=torch.zeros(3, 1, 3))
        >>> graph = build_graph(g, options=GraphOptions(neighbours=1))
        >>> complete_membership(graph, torch.tensor([1.0, 0, 0]), torch.tensor([0, 1, 0]).bool())
        tensor([1.0000, 0.5000, 0.0000])
    """
    options = options or HoleOptions()
    graph.check("membership", membership)
    graph.check("hidden", hidden)
    unknown = hidden.cpu()
    values = torch.where(unknown, 0.0, membership.detach().cpu().double())
    check_values("membership", values, 0.0, 1.0)
    rows = _near_members(graph, values >= options.min_member, unknown, options.spread_steps)
    if not len(rows):
        return values.float()
    transition = transition_matrix(graph.strengths[rows.numpy()])
    known = (~unknown).double()
    shares = torch.stack((values, known - values), dim=1).numpy()
    source = transition @ shares
    among_hidden = transition[:, rows.numpy()]
    arrived = source
    for _ in range(options.spread_steps - 1):
        arrived = source + among_hidden @ arrived
    total = torch.from_numpy(arrived.sum(axis=1))
    inferred = torch.from_numpy(arrived[:, 0]) / total.clamp_min(1e-300)
    return values.index_copy(0, rows, inferred.clamp(0, 1)).float()


def _near_members(
    graph: NeighbourGraph, member: Tensor, hidden: Tensor, steps: int
) -> Int64[Tensor, "m"]:
    """Hidden rows that so many steps over hidden ones lead to from a member, ascending."""
    reached = torch.zeros_like(hidden)
    rows = torch.nonzero(hidden).squeeze(1)
    edges = graph.edges(rows)
    frontier = torch.unique(rows[edges.first[member[edges.second]]])
    for _ in range(steps):
        if not len(frontier):
            break
        reached[frontier] = True
        ahead = graph.edges(frontier).second
        frontier = torch.unique(ahead[hidden[ahead] & ~reached[ahead]])
    return torch.nonzero(reached).squeeze(1)
