"""Votes of groups of segments, and of a tree of them, become labels."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import UNLABELLED, ClassTable, InstanceTree, Labels, TreeLevel, TreeNode
from splatseg.lift.share_tables import ranked_entries
from splatseg.lift.voting.confusion import ConfusionOptions, correct_confusion
from splatseg.methods.associate._levels import GROUP, OBJECT, PART
from splatseg.methods.associate._table import SegmentTable
from splatseg.methods.associate._tree import SegmentTree

CANDIDATES = 8
"""Ids of a Gaussian that are kept, those with most votes."""


def sorted_by_mass(group: NDArray[np.int64], votes: Any) -> tuple[NDArray[np.int64], Any]:
    """Groups numbered anew by the votes they have, most first; groups without any go."""
    total = np.asarray(votes.sum(axis=0)).ravel()
    order = np.lexsort((np.arange(len(total)), -total))
    order = order[total[order] > 0]
    rank = np.full(len(total) + 1, -1)
    rank[order] = np.arange(len(order))
    return rank[group], votes.tocsc()[:, order].tocsr()


def view_counts(table: SegmentTable) -> Tensor:
    """(Gaussians,): how many of the views that were compared see each."""
    seen = np.bincount(table.visibility().indices, minlength=table.gaussians)
    return torch.from_numpy(seen.astype(np.float32))


def majority(votes: Any, effective_views: Tensor | None = None) -> Labels:
    """The strongest ids of each Gaussian (the smaller among equals), their shares, all votes.

    Args:
        votes: Sparse (Gaussians, groups); group 0 gets the id 1.
        effective_views: How many views see each Gaussian, where that is known.
    """
    count = votes.shape[0]
    rows, order, rank = ranked_entries(votes)
    kept = rank < CANDIDATES
    total = np.asarray(votes.sum(axis=1)).ravel()
    ids = np.full((count, CANDIDATES), UNLABELLED, np.int32)
    shares = np.zeros((count, CANDIDATES), np.float32)
    index = rows[kept], rank[kept]
    ids[index] = votes.indices[order][kept] + 1
    shares[index] = (votes.data[order][kept] / total[index[0]]).clip(0, 1)
    return Labels(
        ids=torch.from_numpy(ids[:, 0].copy()),
        confidence=torch.from_numpy(shares[:, 0].copy()),
        candidates=torch.from_numpy(ids),
        shares=torch.from_numpy(shares),
        evidence=torch.from_numpy(total.astype(np.float32)),
        effective_views=effective_views,
    )


_MIN_PART_VOTES = 0.15
"""A Gaussian of an object is one of its parts if the masks of these have this share of the votes
that the masks of the whole have: the rest of the object has no part."""


_LEVELS: dict[int, TreeLevel] = {GROUP: "group", OBJECT: "object", PART: "part"}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TreeVotes:
    """What the segments of a tree say of the Gaussians."""

    objects: Labels
    """Of each Gaussian its object; ids count objects from 1, the one with most votes first."""

    node: NDArray[np.int64]
    """(Gaussians,): row of the deepest node, -1 for none."""

    object_rows: NDArray[np.int64]
    """Rows of the nodes that are objects and have a vote, in the order of their ids."""

    object_of_segment: NDArray[np.int64]
    """(segments,): place in `object_rows` of the object that each segment is or lies in, -1 for
    none."""

    own: Any
    """Sparse (Gaussians, objects): votes of each Gaussian for each object."""

    soft: tuple[NDArray[np.int64], NDArray[np.float32]] | None = None
    """Rows of nodes (Gaussians, k), -1 where there are fewer, and each Gaussian's membership in
    them; no two of a Gaussian are inside each other."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _TreeVoter:
    """A tree whose segments vote."""

    table: SegmentTable
    tree: SegmentTree
    level: NDArray[np.int64]
    confusion: ConfusionOptions | None
    views: Tensor
    """(Gaussians,): how many views see each."""

    def decided(self, group: NDArray[np.int64]) -> Labels:
        """The labels by the votes of groups of segments, with all candidates."""
        labels = majority(self.table.votes(group), self.views)
        return (
            labels if self.confusion is None else correct_confusion(labels, options=self.confusion)
        )

    def own(
        self, node_of_segment: NDArray[np.int64], node: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Votes that each Gaussian has for its own node."""
        table = self.table
        of_segment, of_gaussian = node_of_segment.astype(np.int32), node.astype(np.int32)
        gaussians, values = [np.zeros(0, np.int32)], [np.zeros(0)]
        for entries in table.slices():
            segment, gaussian = table.segment[entries], table.gaussian[entries]
            of = of_segment[segment]
            mine = np.flatnonzero((of == of_gaussian[gaussian]) & (of >= 0))
            gaussians.append(gaussian[mine])
            values.append(table.mass[entries][mine].astype(np.float64))
        votes = np.bincount(
            np.concatenate(gaussians), np.concatenate(values), minlength=table.gaussians
        )
        return votes.astype(np.float64, copy=False)


def tree_votes(
    table: SegmentTable,
    tree: SegmentTree,
    level: NDArray[np.int64],
    *,
    confusion: ConfusionOptions | None,
) -> TreeVotes:
    """Let the segments of a tree vote.

    All masks of an object and of its parts vote for the object: where a view has no mask of the
    whole, those of the parts speak for it. Parts are chosen within the object alone, so that
    children lie inside their parents whatever the single masks did.

    Args:
        table: The segments.
        tree: Their tree.
        level: The level of each node (`node_levels`).
        confusion: How segments err, see `correct_confusion`; None takes the majority.
    """
    voter = _TreeVoter(
        table=table, tree=tree, level=level, confusion=confusion, views=view_counts(table)
    )
    object_of, top_part = _above(tree, level)
    objects, group = _compact(object_of[tree.node])
    total = np.asarray(table.votes(group).sum(axis=0)).ravel()
    order = np.lexsort((np.arange(len(total)), -total))
    order = order[total[order] > 0]
    rank = np.full(len(objects) + 1, -1)
    rank[order] = np.arange(len(order))
    labels = voter.decided(rank[group])
    rows = objects[order]
    ids = labels.ids.numpy()
    # The last one is of Gaussians without an id.
    node = np.append(rows, -1)[np.maximum(ids, 0) - 1]
    node = _parts(voter, node, object_of, top_part[tree.node])
    return TreeVotes(
        objects=labels,
        node=_deeper(voter, node),
        object_rows=rows,
        object_of_segment=rank[group],
        own=table.votes(rank[group]),
    )


def _compact(row: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The rows in use, ascending, and for each segment its index among them, -1 for none."""
    used = np.unique(row[row >= 0])
    index = np.full(int(row.max(initial=-1)) + 2, -1)
    index[used] = np.arange(len(used))
    return used, index[row]


def _above(
    tree: SegmentTree, level: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The object that each node is or lies in, and the part next to it, -1 for none.

    A last entry is for segments without a node.
    """
    object_of = np.full(len(level) + 1, -1)
    top_part = np.full(len(level) + 1, -1)
    for row in tree.top_down():
        parent = tree.parent[row]
        if level[row] == OBJECT:
            object_of[row] = row
        elif level[row] == PART:
            object_of[row] = object_of[parent]
            top_part[row] = row if level[parent] == OBJECT else top_part[parent]
    return object_of, top_part


def _parts(
    voter: _TreeVoter,
    node: NDArray[np.int64],
    object_of: NDArray[np.int64],
    part: NDArray[np.int64],
) -> NDArray[np.int64]:
    """Of each Gaussian of an object the part next to it, or the object still.

    Args:
        voter: The segments.
        node: (Gaussians,): the object of each.
        object_of: (nodes + 1,): the object that each node is or lies in.
        part: (segments,): the part next to the object that each segment is of, -1 for none.
    """
    parts, group = _compact(part)
    if not len(parts):
        return node
    labels = voter.decided(group)
    if labels.candidates is None:
        return node
    ids = labels.candidates.numpy()
    chosen = np.where(ids == UNLABELLED, -1, np.append(parts, -1)[ids - 1])
    inside = (chosen >= 0) & (object_of[chosen] == node[:, None])
    first = chosen[np.arange(len(node)), inside.argmax(axis=1)]
    whole = voter.own(voter.tree.node, node)
    pieces = voter.own(np.where(part >= 0, object_of[part], -1), node)
    there = inside.any(axis=1) & (pieces >= _MIN_PART_VOTES * whole)
    return np.where(there, first, node)


def _deeper(voter: _TreeVoter, node: NDArray[np.int64]) -> NDArray[np.int64]:
    """Down from parts to the parts of parts, by majority."""
    tree, children = voter.tree, voter.tree.children
    while True:
        below = np.full(len(voter.level) + 1, -1)
        for row in np.unique(node[node >= 0]).tolist():
            for child in children[row] if voter.level[row] == PART else ():
                below[_subtree(children, child)] = child
        if not (below >= 0).any():
            return node
        votes = voter.table.votes(below[tree.node]).tocoo()
        fits = tree.parent[votes.col] == node[votes.row]
        row, child, value = votes.row[fits], votes.col[fits], votes.data[fits]
        order = np.lexsort((child, -value, row))
        row, child, value = row[order], child[order], value[order]
        first = np.ones(len(row), bool)
        first[1:] = row[1:] != row[:-1]
        moved = first & (value >= _MIN_PART_VOTES * voter.own(tree.node, node)[row])
        if not moved.any():
            return node
        node = node.copy()
        node[row[moved]] = child[moved]


def _subtree(children: list[list[int]], row: int) -> list[int]:
    found = [row]
    for inside in found:  # grows while it is gone through
        found.extend(children[inside])
    return found


def category_of(table: SegmentTable, segments: NDArray[np.int64]) -> int:
    """The category that most of some segments have, by their mass and score; 0 for none."""
    known = segments[table.category[segments] != UNLABELLED]
    if not len(known):
        return 0
    weight = table.size[known] * table.score[known]
    return int(np.bincount(table.category[known], weight).argmax())


def instance_tree(
    table: SegmentTable,
    tree: SegmentTree,
    level: NDArray[np.int64],
    votes: TreeVotes,
    classes: ClassTable | None,
) -> tuple[InstanceTree, NDArray[np.int64]]:
    """The tree as a layer: nodes that Gaussians belong to, and those above them.

    Objects have the ids from 1 on, then come groups, then parts, each the largest first.

    Returns:
        The layer, and the id of the node of each segment, -1 for none.
    """
    used = set(votes.node[votes.node >= 0].tolist())
    if votes.soft is not None:
        used |= set(np.unique(votes.soft[0][votes.soft[0] >= 0]).tolist())
    for row in reversed(tree.top_down()):
        if row in used and tree.parent[row] >= 0:
            used.add(int(tree.parent[row]))
    order = [row for row in votes.object_rows.tolist() if row in used]
    for wanted in (GROUP, PART):
        rows = [row for row in used if level[row] == wanted]
        order += sorted(rows, key=lambda row: (-tree.size[row], row))
    ids = np.full(len(level) + 1, UNLABELLED)
    ids[order] = np.arange(1, len(order) + 1)
    nodes = tuple(
        _node(table, tree, row, _LEVELS[int(level[row])], ids=ids, classes=classes) for row in order
    )
    labels = replace(
        votes.objects,
        ids=torch.from_numpy(ids[votes.node].astype(np.int32)),
        candidates=None if votes.soft is None else torch.from_numpy(ids[votes.soft[0]]),
        shares=None if votes.soft is None else torch.from_numpy(votes.soft[1]),
    )
    return InstanceTree(nodes=nodes, labels=labels), ids[tree.node]


def _node(
    table: SegmentTable,
    tree: SegmentTree,
    row: int,
    level: TreeLevel,
    *,
    ids: NDArray[np.int64],
    classes: ClassTable | None,
) -> TreeNode:
    members = np.flatnonzero(tree.node == row)
    category = category_of(table, members)
    word = classes.name_of(category) if category > 0 and classes is not None else level
    return TreeNode(
        id=int(ids[row]),
        parent=int(ids[tree.parent[row]]),
        level=level,
        name=f"{word} {ids[row]}",
        class_id=category,
        support=float(tree.support[row]),
        segments=len(members),
        views=int(tree.views[row]),
    )


_MIN_COVER = 0.5
"""Share of its object's support that a Gaussian's own cover may not fall below."""


def without_outside(
    votes: TreeVotes, table: SegmentTable, tree: SegmentTree, *, min_support: float
) -> TreeVotes:
    """Votes without the Gaussians that belong to nothing.

    Masks of a few things leave most of a scene in none. A wall behind a cup has votes for the cup
    wherever a mask spills over its rim, and no others; by votes alone the whole wall is cup. What
    views see of a Gaussian outside all masks speaks against every thing. Views miss things, too, so
    that it is held against how often the thing itself has a mask: with a share :math:`c_i` of what
    is seen of Gaussian i in masks, and the support :math:`s_k` of its object, it belongs to nothing
    where

    .. math:: c_i < s_k / 2.

    These have the id -1, and the share of them outside masks as confidence: completion leaves them
    so. Gaussians without a vote are held against `min_support`.

    Args:
        votes: What segments say.
        table: The segments.
        tree: Their tree.
        min_support: Least support of a node.
    """
    ids = votes.objects.ids.numpy()
    support = np.append(tree.support[votes.object_rows], min_support)
    nothing = (
        table.covered < _MIN_COVER * support[np.where(ids == UNLABELLED, len(support), ids) - 1]
    )
    if not nothing.any():
        return votes
    sure = torch.from_numpy(np.where(nothing, 1 - table.covered, 0).astype(np.float32))
    gone = torch.from_numpy(nothing)
    soft = votes.soft
    if soft is not None:
        rows = nothing[:, None]
        soft = np.where(rows, -1, soft[0]), np.where(rows, np.float32(0), soft[1])
    return replace(
        votes,
        objects=replace(
            votes.objects,
            ids=torch.where(gone, UNLABELLED, votes.objects.ids),
            confidence=torch.where(gone, sure, votes.objects.confidence),
            candidates=None,
            shares=None,
        ),
        node=np.where(nothing, -1, votes.node),
        soft=soft,
    )
