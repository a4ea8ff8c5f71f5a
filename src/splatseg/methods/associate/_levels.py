"""What the nodes of a tree are, groups, objects or parts; nodes that are two things are divided."""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from splatseg.methods.associate._clustering import MIN_KNOWN_SIZE, Nesting
from splatseg.methods.associate._tree import SegmentTree

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
    - a part that masks of its whole leave out (`separated_levels`), :math:`s`;
    - an object in a group that has no parts, :math:`s / 2`: small things often show none, whereas
      parts are hardly ever divided;
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
        if any(tree.alone[i] for i in inner):  # the others are what masks of the whole leave out
            as_object[row] += sum(tree.support[i] for i in inner if not tree.alone[i])
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


_THING = 0.75
"""Mean objectness from which on masks are of a thing: above it one node at most is that thing."""

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
    not divided. Nor is a node whose larger masks are of a thing to the model: what lies on a floor
    makes no group of it, and masks that take in some of it are of the floor too.

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
    if objectness is not None and not np.isnan(objectness).any():
        found = [one for one in found if not _is_thing(tree, one, objectness)]
    level = node_levels(_divided(tree, found), objectness)
    known, last = level[: len(tree.parent)], level[len(tree.parent) :]
    children = tree.children
    kept = [
        known[division.row] == GROUP or len(division.left_out) == len(children[division.row])
        for division in found
    ]
    stays = [division for division, keep in zip(found, kept, strict=True) if keep]
    return _divided(tree, stays), np.append(known, last[np.array(kept, bool)])


def _is_thing(tree: SegmentTree, division: "_Division", objectness: NDArray[np.float64]) -> bool:
    """Whether the larger of the two is a thing to the model, and so no group: then both are it."""
    outer = np.setdiff1d(np.flatnonzero(tree.node == division.row), division.masks)
    return float(objectness[outer].mean()) >= _THING


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
