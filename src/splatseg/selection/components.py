r"""Connected pieces of Gaussians, and what an edit would leave behind as specks.

Two Gaussians touch if their ellipsoids of two standard deviations do along the line between
their centres: :math:`|x_j - x_i| \le 2 (\sigma_i(u) + \sigma_j(u))` with u the direction of that
line and :math:`\sigma(u)^2 = u^\top \Sigma u`. Only the nearest 16 others of each are asked.
"""

from collections.abc import Iterator

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatseg.core import Gaussians, Labels, Selection
from splatseg.core.rigid import rotation_from_quaternion
from splatseg.errors import RangeError, ShapeError
from splatseg.neighbours import NeighbourIndex

NEIGHBOURS = 16
REACH = 2.0

_PAIRS = 1 << 18
"""Pairs looked at together."""

_KEPT = 1 << 21
"""Pairs that are kept before pieces are made of them, and at least two a Gaussian."""


def components(gaussians: Gaussians, among: Selection) -> Int64[Tensor, "n"]:
    """The connected piece of each Gaussian that is among some, numbered from 0; -1 for others.

    Pieces are numbered by their first Gaussian.

    Raises:
        ShapeError: If `among` is of other Gaussians.
    """
    _check_length("among", among, gaussians)
    rows = among.ids
    joined = _Pieces(len(rows))
    for first, second in _touching_pairs(gaussians[rows]):
        joined.add(first, second)
    result = torch.full((len(gaussians),), -1, dtype=torch.int64)
    result[rows] = joined.numbers()
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
    gone = removed.mask
    beside, at_removed = none.clone(), none.clone()
    staying = _Pieces(len(gaussians))
    for first, second in _touching_pairs(gaussians):
        one, other = gone[first], gone[second]
        beside[first[~one & other]] = True
        beside[second[one & ~other]] = True
        both = ~one & ~other
        staying.add(first[both], second[both])
    piece_of = staying.numbers()
    sizes = torch.bincount(piece_of, minlength=len(gaussians))
    at_removed[piece_of[beside]] = True
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


class _Pieces:
    """Connected pieces of pairs that come some at a time, of which few are kept."""

    def __init__(self, count: int) -> None:
        self._piece_of = torch.arange(count)
        self._pairs: list[Int64[Tensor, "2 pairs"]] = []
        self._kept = 0

    def add(self, first: Int64[Tensor, "pairs"], second: Int64[Tensor, "pairs"]) -> None:
        """More pairs of rows."""
        pairs = self._piece_of[torch.stack((first, second))]
        pairs = pairs[:, pairs[0] != pairs[1]].int()
        self._pairs.append(pairs)
        self._kept += pairs.shape[1]
        if self._kept > max(_KEPT, 2 * len(self._piece_of)):
            self._join()

    def numbers(self) -> Int64[Tensor, "n"]:
        """The piece of each row, numbered by their first row."""
        self._join()
        return self._piece_of

    def _join(self) -> None:
        count = len(self._piece_of)
        none = torch.zeros(2, 0, dtype=torch.int32)
        first, second = torch.cat([none, *self._pairs], dim=1)
        self._pairs, self._kept = [], 0
        # Pieces are numbered by their first row, and so are pieces of pieces.
        self._piece_of = pieces(count, first, second)[self._piece_of]


def _touching_pairs(
    gaussians: Gaussians,
) -> Iterator[tuple[Int64[Tensor, "pairs"], Int64[Tensor, "pairs"]]]:
    """Pairs of rows that touch, some rows at a time; each pair may come in both orders."""
    index, axes = NeighbourIndex(gaussians), _axes(gaussians)
    for rows in torch.arange(len(gaussians)).split(_PAIRS // NEIGHBOURS):
        second = index.nearest_others(NEIGHBOURS, rows=rows).indices.long()
        first = rows.unsqueeze(1).expand_as(second)
        there = second >= 0
        first, second = first[there], second[there]
        close = _close(gaussians.means, axes, first, second)
        yield first[close], second[close]


def _axes(gaussians: Gaussians) -> Float[Tensor, "n 3 3"]:
    """Principal axes, each as long as its standard deviation, in columns."""
    return rotation_from_quaternion(gaussians.rotations) * gaussians.scales.unsqueeze(1)


def touching(
    gaussians: Gaussians, first: Int64[Tensor, "pairs"], second: Int64[Tensor, "pairs"]
) -> Bool[Tensor, "pairs"]:
    """Which pairs of rows touch along the line between their centres."""
    axes = _axes(gaussians)
    parts = [
        _close(gaussians.means, axes, one, other)
        for one, other in zip(first.split(_PAIRS), second.split(_PAIRS), strict=True)
    ]
    return torch.cat(parts) if parts else torch.zeros(0, dtype=torch.bool)


def _close(
    means: Float[Tensor, "n 3"],
    axes: Float[Tensor, "n 3 3"],
    first: Int64[Tensor, "pairs"],
    second: Int64[Tensor, "pairs"],
) -> Bool[Tensor, "pairs"]:
    lines = means[second].double() - means[first].double()
    apart = torch.linalg.vector_norm(lines, dim=1)
    lines = (lines / apart.unsqueeze(1).clamp_min(1e-30)).to(axes)
    reach = sum(
        torch.linalg.vector_norm((axes[rows] * lines.unsqueeze(2)).sum(dim=1), dim=1)
        for rows in (first, second)
    )
    return apart <= REACH * reach


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
