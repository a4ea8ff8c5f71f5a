r"""Which nodes of a tree of segments are objects, which are their parts, which are groups.

Masks do not say it. What tells is that objects have parts and parts have none: a node whose
children have children is a group, one whose children are leaves is an object, and a leaf beside
objects is an object of one piece. As no tree is free of faults, the levels are those with the
fewest exceptions, each weighed by the support s of the node it is about:

- a part that has parts, :math:`s` for each node below it;
- an object in a group that has no parts, :math:`s / 2`: small things often show none, whereas parts
  are hardly ever divided;
- a group, 2: a level more must explain more than two exceptions.

Every path from a root to a leaf has one object or, below the groups, none; its levels go from
groups through the object to parts. The minimum over all such levels is found from the leaves up
in one pass, since what is below a node depends on the node's level alone.
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from splatseg.lift.segments.tree import SegmentTree

Level = Literal["group", "object", "part"]
PART, OBJECT, GROUP = 0, 1, 2

_GROUP_COST = 2.0
_LONE_COST = 0.5


def node_levels(tree: SegmentTree) -> NDArray[np.int64]:
    """The level of each node: 0 for parts, 1 for objects, 2 for groups.

    Args:
        tree: The nodes.
    """
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
