"""What lies outside all masks, though masks touch it: it belongs to nothing.

Masks of a few things leave most of a scene in none. A wall behind a cup has votes for the cup
wherever a mask spills over its rim, and no others; by votes alone the whole wall is cup. What views
see of a Gaussian outside all masks speaks against every thing. Views miss things, too, so that it
is held against how often the thing itself has a mask: with a share :math:`c_i` of what is seen of
Gaussian i in masks, and the support :math:`s_k` of its object, it belongs to nothing where

.. math:: c_i < s_k / 2.
"""

from dataclasses import replace

import numpy as np
import torch

from splatseg.core import UNLABELLED
from splatseg.lift.segments.table import SegmentTable
from splatseg.lift.segments.tree import SegmentTree
from splatseg.lift.segments.tree_labels import TreeVotes

_LEAST = 0.5
"""Share of its object's support that a Gaussian's own cover may not fall below."""


def without_outside(
    votes: TreeVotes, table: SegmentTable, tree: SegmentTree, *, min_support: float
) -> TreeVotes:
    """Votes without the Gaussians that belong to nothing.

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
    nothing = table.covered < _LEAST * support[np.where(ids == UNLABELLED, len(support), ids) - 1]
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
