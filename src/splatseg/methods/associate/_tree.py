"""Groups of segments of all levels become a tree: what lies inside what.

A node is a set of Gaussians, those that its segments hold most of (its core). It lies inside the
smallest other node that covers most of it, none that is of a finer level where the model gives
levels, unless the views say otherwise: where segments of both
are seen in one view, they must lie inside each other there as well (`nesting`).
Groups that few of the views saw which could have seen them are no nodes: where a model cuts a
thing along a shadow it does so in one view and not in the next.
"""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg.methods.associate._clustering import Agreement, Nesting
from splatseg.methods.associate._table import SegmentTable

_MIN_HELD = 0.5
"""Share of what the views with segments of a node see of a Gaussian from which on it is core."""

_MIN_VISIBILITY = 0.3
"""A view could have seen a node if it sees this share of what the best view sees of it."""

_ROWS = 1 << 16
"""Gaussians of a group whose views are looked up at a time."""

_SAME = 0.75
"""Intersection over union of two cores from which on they are one node: an object all but one
part of which is hidden, or a group that fell in two."""

_MIN_OVERLAP = 0.7
"""Share of a node that must lie in another for it to lie inside it."""

_MIN_NESTED = 0.5
"""Share of the views with both in which a node's segments must lie in those of its parent."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SegmentTree:
    """Nodes of the tree and the segments that they are made of."""

    node: NDArray[np.int64]
    """(segments,): the node of each segment, -1 for none."""

    parent: NDArray[np.int64]
    """(nodes,): row of the parent, -1 for none. Parents have larger cores, or are coarser where
    the model gives levels."""

    size: NDArray[np.float64]
    """(nodes,): square root of what is seen of each Gaussian, summed over the core."""

    support: NDArray[np.float64]
    """(nodes,): share of the views that could have seen the node which did, in [0, 1]."""

    views: NDArray[np.int64]
    """(nodes,): views with a segment of the node."""

    alone: NDArray[np.bool_]
    """(nodes,): whether the node is its parent without some of what lies in it
    (`separated_levels`)."""

    @property
    def children(self) -> list[list[int]]:
        """Rows of the children of each node, ascending."""
        found: list[list[int]] = [[] for _ in self.parent]
        for row, parent in enumerate(self.parent.tolist()):
            if parent >= 0:
                found[parent].append(row)
        return found

    def top_down(self) -> list[int]:
        """Rows of all nodes, parents before their children."""
        children = self.children
        order = np.flatnonzero(self.parent < 0).tolist()
        for row in order:  # grows while it is gone through
            order.extend(children[row])
        return order


def segment_tree(
    table: SegmentTable,
    agreement: Agreement,
    nested: Nesting,
    group: NDArray[np.int64],
    *,
    min_support: float,
    min_views: int,
) -> SegmentTree:
    """Build the tree of groups of segments.

    Args:
        table: The segments.
        agreement: What they share, and what the views see of them.
        nested: What lies inside what within each view.
        group: The group of each segment, -1 for none.
        min_support: Groups are nodes if this share of the views which could have seen them did.
        min_views: ... and at least so many.
    """
    support, views = _support(agreement, group, len(table.views))
    group = _renumbered(group, np.flatnonzero((support >= min_support) & (views >= min_views)))
    by_view = table.visibility().power(2)
    weight = np.sqrt(np.asarray(by_view.sum(axis=1)).ravel())
    seen = by_view.tocsr()
    cores = _cores(table, seen, group)
    both = _overlaps(cores, weight)
    same = _same_nodes(both, _forbidden(nested, group, len(both)))
    if same is not None:
        group = np.where(group >= 0, same[group], -1)
        both = _overlaps(_joined_cores(table, seen, cores, group, same), weight)
    support, views = _support(agreement, group, len(table.views))
    return SegmentTree(
        node=group,
        parent=_parents(table, nested, group, both),
        size=both.diagonal().copy(),
        support=support,
        views=views,
        alone=np.zeros(len(both), bool),
    )


def _renumbered(group: NDArray[np.int64], kept: NDArray[np.int64]) -> NDArray[np.int64]:
    """Groups that are kept, numbered in their order; the others are -1."""
    place = np.full(int(group.max(initial=-1)) + 2, -1)
    place[kept] = np.arange(len(kept))
    return place[group]


def _support(
    agreement: Agreement, group: NDArray[np.int64], view_count: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Share of the views that could have seen each group which did, and their number."""
    import scipy.sparse

    count = int(group.max(initial=-1)) + 1
    member = np.flatnonzero(group >= 0)
    joined: Any = scipy.sparse.csr_matrix(
        (np.ones(len(member)), (group[member], member)), shape=(count, len(group))
    )
    visible = (joined @ agreement.seen).toarray()
    could = visible >= _MIN_VISIBILITY * visible.max(axis=1, keepdims=True, initial=0)
    did = np.zeros((count, view_count), bool)
    did[group[member], agreement.view[member]] = True
    return (could & did).sum(axis=1) / np.maximum(could.sum(axis=1), 1), did.sum(axis=1)


def _overlaps(cores: Any, weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """(groups, groups): what the cores share; their sizes on the diagonal."""
    import scipy.sparse

    return (cores @ scipy.sparse.diags(weight) @ cores.T).toarray()


def _cores(table: SegmentTable, seen: Any, group: NDArray[np.int64]) -> Any:
    """Sparse (groups, Gaussians): 1 for the Gaussians that a group holds most of.

    Args:
        table: The segments.
        seen: Sparse rows (Gaussians, views): what each view sees of each Gaussian.
        group: The group of each segment, -1 for none.
    """
    import scipy.sparse

    held = _held_most(table, group)
    member = group >= 0
    had = np.zeros((held.shape[0], len(table.views)))
    had[group[member], table.view[member]] = 1
    core = np.zeros(len(held.data), bool)
    for row, (start, stop) in enumerate(pairwise(held.indptr.tolist())):
        for first in range(start, stop, _ROWS):
            part = slice(first, min(first + _ROWS, stop))
            core[part] = held.data[part] >= _MIN_HELD * (seen[held.indices[part]] @ had[row])
    ends = np.append(0, np.cumsum(core))[held.indptr]
    return scipy.sparse.csr_matrix(
        (np.ones(int(ends[-1])), held.indices[core], ends), shape=held.shape
    )


def _joined_cores(
    table: SegmentTable, seen: Any, cores: Any, group: NDArray[np.int64], same: NDArray[np.int64]
) -> Any:
    """The cores after groups were joined: only those of groups of several are found anew.

    Args:
        table: The segments.
        seen: Sparse rows (Gaussians, views): what each view sees of each Gaussian.
        cores: Those of before.
        group: The group of each segment now, -1 for none.
        same: What became of each group.
    """
    import scipy.sparse

    count = int(same.max()) + 1
    several = np.bincount(same, minlength=count) > 1
    index = np.append(np.cumsum(several) - 1, -1)
    anew = _cores(table, seen, np.where(np.append(several, False)[group], index[group], -1))
    last = np.zeros(count, np.int64)
    last[same] = np.arange(len(same))
    rows = np.where(several, len(same) + index[:-1], last)
    found: Any = scipy.sparse.vstack((cores, anew), format="csr")
    return found[rows]


def _held_most(table: SegmentTable, group: NDArray[np.int64]) -> Any:
    """Sparse (groups, Gaussians): mass where a group holds most of what its own segments touch.

    Views whose segments do not touch the Gaussian are to be counted yet; this leaves out most of
    what is no core without looking at them.
    """
    import scipy.sparse

    mass = table.masses(group)
    touched = replace(table, mass=table.seen).masses(group)
    # A view with several segments of a group touches a Gaussian at most so many times.
    pairs = np.stack((group[group >= 0], table.view[group >= 0]))
    (names, _), times = np.unique(pairs, axis=1, return_counts=True)
    repeats = np.ones(mass.shape[0])
    np.maximum.at(repeats, names, times)
    # The same segments give both, so that both have the same entries in the same order.
    factor = np.repeat(repeats, np.diff(mass.indptr))
    most = mass.data * factor >= 0.99 * _MIN_HELD * touched.data
    ends = np.append(0, np.cumsum(most))[mass.indptr]
    return scipy.sparse.csr_matrix((mass.data[most], mass.indices[most], ends), shape=mass.shape)


def _forbidden(nested: Nesting, group: NDArray[np.int64], count: int) -> NDArray[np.bool_]:
    """(groups, groups): whether the model gave segments of both different levels in one view."""
    pairs = nested.forbidden.tocoo()
    one, other = group[pairs.row], group[pairs.col]
    known = (one >= 0) & (other >= 0)
    found = np.zeros((count, count), bool)
    found[one[known], other[known]] = True
    return found


def _same_nodes(
    both: NDArray[np.float64], forbidden: NDArray[np.bool_]
) -> NDArray[np.int64] | None:
    """Where each group goes: to the earlier of two with the same core; None if none do."""
    if not len(both):
        return None
    size = both.diagonal()
    ratio = both / np.maximum(size[:, None] + size[None, :] - both, 1e-12)
    ratio[forbidden] = 0
    np.fill_diagonal(ratio, 0)
    best = ratio.argmax(axis=1)
    row = np.arange(len(size))
    mutual = (best[best] == row) & (ratio[row, best] > _SAME) & (best < row)
    if not mutual.any():
        return None
    return np.unique(np.where(mutual, best, row), return_inverse=True)[1]


def _parents(
    table: SegmentTable, nested: Nesting, group: NDArray[np.int64], both: NDArray[np.float64]
) -> NDArray[np.int64]:
    import scipy.sparse

    size = both.diagonal()
    count = len(size)
    pairs = nested.inside.tocoo()
    inner, outer = group[pairs.row], group[pairs.col]
    known = (inner >= 0) & (outer >= 0) & (inner != outer)
    inside: Any = scipy.sparse.csr_matrix(
        (np.ones(int(known.sum())), (inner[known], outer[known])), shape=(count, count)
    ).toarray()
    there = np.zeros((count, len(table.views)))
    there[group[group >= 0], table.view[group >= 0]] = 1
    together = there @ there.T
    # A node seen beside another no more than once cannot be told from it by views.
    agrees = (together < 2) | (inside >= _MIN_NESTED * together)
    # The model's level goes before size: a whole of which little is seen is still the whole.
    rank = np.empty(count, np.int64)
    level = _median_level(table, group, count)
    rank[np.lexsort((-np.arange(count), size, level))] = np.arange(count)
    larger = rank[None, :] > rank[:, None]
    fits = agrees & larger & (both >= _MIN_OVERLAP * size[:, None]) & (size > 0)[:, None]
    smallest = np.where(fits, rank[None, :], count)
    best = smallest.argmin(axis=1) if count else np.zeros(0, np.int64)
    return np.where(fits.any(axis=1), best, -1).astype(np.int64)


def _median_level(table: SegmentTable, group: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """The level that the segments of each group have, of an even number the finer middle one."""
    member = np.flatnonzero(group >= 0)
    order = member[np.lexsort((table.level[member], group[member]))]
    size = np.bincount(group[member], minlength=count)
    first = np.cumsum(size) - size
    return table.level[order[first + (size - 1) // 2]]
