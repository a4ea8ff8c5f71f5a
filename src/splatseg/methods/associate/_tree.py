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
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from splatseg.methods.associate._clustering import MIN_KNOWN_SIZE, Agreement, Nesting
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


Level = Literal["group", "object", "part"]
PART, OBJECT, GROUP = 0, 1, 2

_GROUP_COST = 2.0
_LONE_COST = 0.5


def node_levels(
    tree: SegmentTree, objectness: NDArray[np.float64] | None = None
) -> NDArray[np.int64]:
    r"""The level of each node: 0 for parts, 1 for objects, 2 for groups.

    Where the model tells how far each mask is an object of its own (`MaskSet.objectness`), objects
    are the nodes with the largest sum of :math:`s \, \bar o^{3/2}`, with the support s of a node
    and the mean objectness of its masks, of which none lies in another: above a half an IoU there
    is one node for a thing, so what its parts and the group it is in add to the sum is small. With
    an exponent of 1 parts win too often (3 points less), 1.25 to 2 are the same.

    Masks of other models do not say it. What tells is that objects have parts and parts have none:
    a node whose children have children is a group, one whose children are leaves is an object, and
    a leaf beside objects is an object of one piece. As no tree is free of faults, the levels are
    those with the fewest exceptions, each weighed by the support s of the node it is about:

    - a part that has parts, :math:`s` for each node below it;
    - an object in a group that has no parts, :math:`s / 2`: small things often show none, whereas
    parts
      are hardly ever divided;
    - a group, 2: a level more must explain more than two exceptions.

    Every path from a root to a leaf has one object or, below the groups, none; its levels go from
    groups through the object to parts. The minimum over all such levels is found from the leaves up
    in one pass, since what is below a node depends on the node's level alone.

    Args:
        tree: The nodes.
        objectness: (segments,), NaN where a model does not tell; None where none does.
    """
    if objectness is not None and not np.isnan(objectness).any():
        return _levels_by_objectness(tree, objectness)
    count = len(tree.parent)
    children, order = tree.children, tree.top_down()
    below, as_object, as_group = np.zeros(count), np.zeros(count), np.full(count, np.inf)
    for row in reversed(order):
        inner = children[row]
        if not inner:
            continue
        # An object without some of its parts is not a part: what it holds are parts.
        parts = [j for i in inner for j in (children[i] if tree.alone[i] else [i])]
        as_object[row] = below[parts].sum()
        lone = np.array([0.0 if children[i] else _LONE_COST * tree.support[i] for i in inner])
        best = np.minimum(as_object[inner] + lone, as_group[inner])
        if len(inner) > 1:
            as_group[row] = _GROUP_COST + best.sum()
        below[row] = below[inner].sum() + tree.support[inner].sum()
    level = np.full(count, PART, np.int64)
    for row in order:
        above = tree.parent[row]
        if above < 0 or level[above] == GROUP:
            level[row] = GROUP if as_group[row] < as_object[row] else OBJECT
    return level


_OBJECTNESS_POWER = 1.5


def _levels_by_objectness(tree: SegmentTree, objectness: NDArray[np.float64]) -> NDArray[np.int64]:
    count, member = len(tree.parent), tree.node >= 0
    sums = np.bincount(tree.node[member], objectness[member], minlength=count)
    mean = sums / np.maximum(np.bincount(tree.node[member], minlength=count), 1)
    worth = tree.support * mean**_OBJECTNESS_POWER
    children, order = tree.children, tree.top_down()
    best = worth.copy()
    for row in reversed(order):
        best[row] = max(worth[row], best[children[row]].sum())
    level = np.full(count, PART, np.int64)
    for row in order:
        above = tree.parent[row]
        if above < 0 or level[above] == GROUP:
            level[row] = GROUP if best[row] > worth[row] else OBJECT
    return level


_MIN_INSIDE = 0.75
"""h from which on a child lies inside all masks of its parent: half way between the half that
one of two masks gives and all."""


def separated_levels(
    tree: SegmentTree,
    nested: Nesting,
    objectness: NDArray[np.float64] | None = None,
    *,
    min_support: float,
    min_views: int,
) -> tuple[SegmentTree, NDArray[np.int64]]:
    r"""Divide the nodes that are two things, and say which level each node has.

    Where little stands on a thing, the masks of the thing with what stands on it and those of the
    thing alone hold nearly the same, and become one node. What gives them away are the children: a
    part lies inside every mask of its whole, in every view, whereas a book lies inside one of the
    two masks of the shelf that a view has and outside the other. With the masks of child c and of
    its parent p that are in one view,

    .. math:: h_c = \frac{|\{(a, b): a \in c,\ b \in p,\ v_a = v_b,\ a \subset b\}|}
                         {|\{(a, b): a \in c,\ b \in p,\ v_a = v_b\}|}

    is 1 for the one and 1/2 for the other. The masks of a node that leave such children out become
    a node of their own inside it, beside these children; what lies in all masks is inside the new
    node. The levels say what that is (`node_levels`): a group of an object and its contents, or an
    object of its largest part and the others. An object without one of its parts is neither, and is
    not divided.

    Args:
        tree: The nodes.
        nested: What lies inside what within each view.
        objectness: (segments,), NaN where a model does not tell; None where none does.
        min_support: Each of the two needs masks in this share of the views that could have seen
            the node,
        min_views: ... and in at least so many.

    Returns:
        The tree, new nodes last, and the level of each node as `node_levels` gives it.
    """
    found = _divisions(tree, nested, min_support=min_support, min_views=min_views)
    level = node_levels(_divided(tree, found), objectness)
    known, last = level[: len(tree.parent)], level[len(tree.parent) :]
    children = tree.children
    kept = [
        known[division.row] == GROUP or len(division.left_out) == len(children[division.row])
        for division in found
    ]
    stays = [division for division, keep in zip(found, kept, strict=True) if keep]
    return _divided(tree, stays), np.append(known, last[np.array(kept, bool)])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Division:
    """A node that is two things."""

    row: int
    """The node."""

    masks: NDArray[np.int64]
    """Masks of the smaller thing."""

    left_out: list[int]
    """The children that are not in it."""

    lifted: list[int]
    """What lies in a child that is in it, and not in it all the same."""

    views: NDArray[np.int64]
    """(2,): views with a mask of the larger thing and of the smaller."""

    support: NDArray[np.float64]
    """(2,): share of the views that could have seen them which did."""


def _divisions(
    tree: SegmentTree, nested: Nesting, *, min_support: float, min_views: int
) -> list[_Division]:
    """All nodes that are two things, each of which has what any node needs, deepest first."""
    view = nested.agreement.view
    pairs, children = _SegmentPairs(tree, nested), tree.children
    found: list[_Division] = []
    for row in reversed(tree.top_down()):
        excluded = [child for child in children[row] if pairs.held(child, row) < _MIN_INSIDE]
        if not excluded:
            continue
        inner, undecided = pairs.that_leave_out(row, excluded)
        left_out = [child for child in children[row] if not pairs.inside(child, inner)]
        below = [child for child in children[row] if child not in left_out]
        lifted: list[int] = []
        for node in below:  # grows while it is gone through
            for child in children[node]:
                (lifted if pairs.outside(child, inner) else below).append(child)
        # Where nothing that is left out is in the picture, the smaller thing is all there is.
        inner = np.union1d(inner, undecided)
        outer = np.setdiff1d(np.flatnonzero(tree.node == row), inner)
        views = np.array([len(np.unique(view[masks])) for masks in (outer, inner)])
        support = np.minimum(tree.support[row] * views / max(int(tree.views[row]), 1), 1.0)
        if views.min() >= min_views and support.min() >= min_support:
            found.append(
                _Division(
                    row=row,
                    masks=inner,
                    left_out=left_out,
                    lifted=lifted,
                    views=views,
                    support=support,
                )
            )
    return found


class _SegmentPairs:
    """Which masks of nodes lie inside which of the same view."""

    def __init__(self, tree: SegmentTree, nested: Nesting) -> None:
        self._view = nested.agreement.view
        self._inside: Any = nested.inside.tocsr()
        self._own = np.asarray(nested.agreement.shared.diagonal(), dtype=np.float64)
        order = np.argsort(tree.node, kind="stable")
        bounds = np.searchsorted(tree.node[order], np.arange(len(tree.parent) + 1))
        self._members = [order[a:b] for a, b in pairwise(bounds.tolist())]

    def _pairs(
        self, child: int, masks: NDArray[np.int64]
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """(masks of the child, other masks): whether of one view, whether inside.

        Of masks that are much smaller than another it is not known what the two share.
        """
        own = self._members[child]
        together = self._view[own][:, None] == self._view[masks]
        together &= self._own[own][:, None] > MIN_KNOWN_SIZE * self._own[masks]
        return together, self._inside[own][:, masks].toarray().astype(bool) & together

    def held(self, child: int, parent: int) -> float:
        """Share h of a child; 1 if no view has masks of both."""
        together, inside = self._pairs(child, self._members[parent])
        return float(inside.sum() / together.sum()) if together.any() else 1.0

    def inside(self, child: int, masks: NDArray[np.int64]) -> bool:
        """Whether most masks of a child lie inside those of their view."""
        together, inside = self._pairs(child, masks)
        return bool(together.any() and 2 * inside.sum() >= together.sum())

    def outside(self, child: int, masks: NDArray[np.int64]) -> bool:
        """Whether fewer than half of them do; not if no view has both."""
        together, inside = self._pairs(child, masks)
        return bool(2 * inside.sum() < together.sum())

    def that_leave_out(
        self, parent: int, children: list[int]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Masks of a node that hold less than half of the masks of some children in their view.

        The others are those in whose view there are none of these.
        """
        masks = self._members[parent]
        pairs = [self._pairs(child, masks) for child in children]
        together = np.sum([here.sum(axis=0) for here, _ in pairs], axis=0)
        inside = np.sum([within.sum(axis=0) for _, within in pairs], axis=0)
        return masks[2 * inside < together], masks[together == 0]


def _divided(tree: SegmentTree, divisions: list[_Division]) -> SegmentTree:
    """The tree with a last node for each division, inside its node, above what it holds."""
    count = len(tree.parent)
    node, size = tree.node.copy(), tree.size.tolist()
    parent = np.append(tree.parent, np.zeros(len(divisions), np.int64))
    support, views = (
        np.append(all, np.zeros(len(divisions), all.dtype)) for all in (tree.support, tree.views)
    )
    for new, division in enumerate(divisions, start=count):
        row = division.row
        node[division.masks] = new
        moved = parent[:count] == row
        moved[division.left_out] = False
        parent[:count][moved] = new
        parent[new] = parent[division.lifted] = row
        support[[row, new]], views[[row, new]] = division.support, division.views
        size.append(
            max(size[row] - sum(size[child] for child in division.left_out + division.lifted), 0.0)
        )
    return replace(
        tree,
        node=node,
        parent=parent,
        size=np.array(size),
        support=support,
        views=views,
        alone=np.append(tree.alone, np.ones(len(divisions), bool)),
    )
