r"""Connected pieces of Gaussians, and what an edit would leave behind as specks.

Two Gaussians touch if their ellipsoids of two standard deviations do along the line between
their centres: :math:`|x_j - x_i| \le 2 (\sigma_i(u) + \sigma_j(u))` with u the direction of that
line and :math:`\sigma(u)^2 = u^\top \Sigma u`. Only the nearest 16 others of each are asked.
"""

import torch
from jaxtyping import Bool, Int64
from torch import Tensor

from splatseg.core import Gaussians, Labels, Selection
from splatseg.core.rigid import rotation_from_quaternion
from splatseg.errors import RangeError, ShapeError
from splatseg.neighbours import NeighbourIndex

NEIGHBOURS = 16
REACH = 2.0

_PAIRS = 1 << 20
"""Pairs looked at together."""


def components(gaussians: Gaussians, among: Selection) -> Int64[Tensor, "n"]:
    """The connected piece of each Gaussian that is among some, numbered from 0; -1 for others.

    Pieces are numbered by their first Gaussian.

    Raises:
        ShapeError: If `among` is of other Gaussians.
    """
    _check_length("among", among, gaussians)
    rows = among.ids
    first, second = _touching_pairs(gaussians[rows])
    result = torch.full((len(gaussians),), -1, dtype=torch.int64)
    result[rows] = pieces(len(rows), first, second)
    return result


def leftovers(
    gaussians: Gaussians,
    removed: Selection,
    *,
    most: int,
    labels: Labels | None = None,
) -> Selection:
    """Small pieces that touch what is removed and nothing that stays: its specks.

    Args:
        gaussians: The Gaussians of the scene.
        removed: What is taken out.
        most: Most Gaussians of such a piece.
        labels: Labels of things. A piece that holds half or more of the Gaussians of an id is a
            thing of its own, however small, and stays.

    Returns:
        The specks; none of them is removed already.

    Raises:
        ShapeError: If `removed` or `labels` are of other Gaussians.
        RangeError: If `most` is negative.
    """
    _check_length("removed", removed, gaussians)
    if labels is not None:
        _check_length("labels", labels, gaussians)
    if most < 0:
        raise RangeError(f"most: expected 0 or more, got {most}.")
    none = torch.zeros(len(gaussians), dtype=torch.bool)
    if not most or not removed.count or removed.count == len(gaussians):
        return Selection(mask=none)
    first, second = _touching_pairs(gaussians)
    gone = removed.mask
    both = ~gone[first] & ~gone[second]
    piece_of = pieces(len(gaussians), first[both], second[both])
    sizes = torch.bincount(piece_of, minlength=len(gaussians))
    at_removed = torch.zeros(len(gaussians), dtype=torch.bool)
    for one, other in ((first, second), (second, first)):
        at_removed[piece_of[one[~gone[one] & gone[other]]]] = True
    small = at_removed & (sizes <= most)
    mask = small[piece_of] & ~gone
    if labels is not None:
        mask &= ~_own_things(piece_of, labels, mask)
    return Selection(mask=mask)


def _own_things(
    piece_of: Int64[Tensor, "n"], labels: Labels, mask: Bool[Tensor, "n"]
) -> Bool[Tensor, "n"]:
    """Which Gaussians are in a piece that holds half of an id's Gaussians or more."""
    own = torch.zeros(len(mask), dtype=torch.bool)
    named = labels.ids >= 0
    _, index, sizes = torch.unique(
        labels.ids[named].long(), return_inverse=True, return_counts=True
    )
    of = torch.full((len(mask),), -1, dtype=torch.int64)
    of[named] = index
    rows = named & mask
    pairs, shares = torch.unique(torch.stack((piece_of[rows], of[rows])), dim=1, return_counts=True)
    own[pairs[0, 2 * shares >= sizes[pairs[1]]]] = True
    return own[piece_of]


def _touching_pairs(gaussians: Gaussians) -> tuple[Int64[Tensor, "pairs"], Int64[Tensor, "pairs"]]:
    """Pairs of rows that touch; each pair may come in both orders."""
    found = NeighbourIndex(gaussians).nearest_others(NEIGHBOURS)
    first = torch.arange(len(gaussians)).repeat_interleave(found.indices.shape[1])
    second = found.indices.reshape(-1)
    there = second >= 0
    first, second = first[there], second[there]
    close = touching(gaussians, first, second)
    return first[close], second[close]


def touching(
    gaussians: Gaussians, first: Int64[Tensor, "pairs"], second: Int64[Tensor, "pairs"]
) -> Bool[Tensor, "pairs"]:
    """Which pairs of rows touch along the line between their centres."""
    axes = rotation_from_quaternion(gaussians.rotations) * gaussians.scales.unsqueeze(1)
    means = gaussians.means
    parts: list[Tensor] = []
    for start in range(0, len(first), _PAIRS):
        pair = (first[start : start + _PAIRS], second[start : start + _PAIRS])
        lines = means[pair[1]].double() - means[pair[0]].double()
        apart = torch.linalg.vector_norm(lines, dim=1)
        lines = (lines / apart.unsqueeze(1).clamp_min(1e-30)).to(axes)
        reach = sum(
            torch.linalg.vector_norm((axes[rows] * lines.unsqueeze(2)).sum(dim=1), dim=1)
            for rows in pair
        )
        parts.append(apart <= REACH * reach)
    return torch.cat(parts) if parts else torch.zeros(0, dtype=torch.bool)


def pieces(
    count: int, first: Int64[Tensor, "pairs"], second: Int64[Tensor, "pairs"]
) -> Int64[Tensor, "n"]:
    """Connected components of a graph of rows, numbered by their first row."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    ones = torch.ones(len(first), dtype=torch.bool).numpy()
    # Graphs of older SciPy have indices of 32 bits; there are never 2^31 Gaussians.
    pairs = (first.int().numpy(), second.int().numpy())
    graph = coo_array((ones, pairs), shape=(count, count))
    _, found = connected_components(graph, directed=False)
    labels = torch.from_numpy(found).long()
    firsts = torch.full((count,), count, dtype=torch.int64)
    firsts.scatter_reduce_(0, labels, torch.arange(count), "amin")
    return torch.unique(firsts[labels], return_inverse=True)[1]


def _check_length(name: str, rows: Selection | Labels, gaussians: Gaussians) -> None:
    if len(rows) != len(gaussians):
        raise ShapeError(f"{name}: expected {len(gaussians)} rows, got {len(rows)}.")
