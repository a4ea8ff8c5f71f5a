"""Votes for the parts of parts, by hand.

0 object
  1 part          2 part
    3 part          4 part
      5 part
"""

import importlib

import numpy as np
import pytest
import torch

from splatseg.methods.associate._levels import OBJECT, PART
from splatseg.methods.associate._table import SegmentTable
from splatseg.methods.associate._tree import SegmentTree

module = importlib.import_module("splatseg.methods.associate._votes")
PARENTS = np.array([-1, 0, 0, 1, 2, 3])


def table_of(masses: np.ndarray) -> SegmentTable:
    """One view with one segment a node, from masses (Gaussians, nodes)."""
    segment, gaussian = np.nonzero(masses.T)
    mass = masses.T[segment, gaussian].astype(np.float32)
    count = masses.shape[1]
    return SegmentTable(
        gaussians=len(masses),
        gaussian=gaussian.astype(np.int32),
        segment=segment.astype(np.int32),
        mass=mass,
        seen=np.full(len(mass), masses.sum(axis=1).max(), np.float32),
        views=("v",),
        view=np.zeros(count, np.int64),
        name=np.arange(count),
        size=masses.sum(axis=0),
        category=np.full(count, -1),
        score=np.ones(count),
        level=np.zeros(count, np.int64),
        objectness=np.full(count, np.nan),
        covered=np.ones(len(masses), np.float32),
    )


@pytest.mark.parametrize(
    ("start", "masses", "expected"),
    [
        # Most of its votes go to 4, which lies in another part than its own.
        (1, {1: 10, 3: 2, 4: 5}, 3),
        (2, {2: 10, 3: 9}, 2),
        # From 0.15 of the votes for the whole on: 1.5 of 10.
        (1, {1: 10, 3: 1.5}, 3),
        (1, {1: 10, 3: 1.4}, 1),
        # What lies in a part counts for it, and is gone down into by the same rule.
        (1, {1: 10, 3: 1, 5: 1}, 5),
        (1, {1: 10, 3: 4, 5: 0.5}, 3),
        # Objects are left where they are, and so is what has no node.
        (0, {0: 1, 1: 9, 3: 9}, 0),
        (-1, {1: 9, 3: 9}, -1),
    ],
)
def test_parts_of_parts_lie_in_their_own_part(start, masses, expected) -> None:
    votes = np.zeros((3, len(PARENTS)))
    votes[0, list(masses)] = list(masses.values())
    votes[1, 1] = votes[2, 2] = 10  # So that the children of both parts can be chosen.
    voter = module._TreeVoter(
        table=table_of(votes),
        tree=SegmentTree(
            node=np.arange(len(PARENTS)),
            parent=PARENTS,
            size=np.ones(len(PARENTS)),
            support=np.ones(len(PARENTS)),
            views=np.ones(len(PARENTS), np.int64),
            alone=np.zeros(len(PARENTS), bool),
        ),
        level=np.array([OBJECT, *[PART] * 5]),
        confusion=None,
        views=torch.ones(3),
    )
    assert module._deeper(voter, np.array([start, 1, 2])).tolist() == [expected, 1, 2]
