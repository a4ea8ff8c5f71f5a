"""Levels of a tree of instances."""

from typing import Literal, get_args

TreeLevel = Literal["group", "object", "part"]
"""Levels from the root down. A table with what stands on it is a group, a lamp on it an object,
the shade of the lamp a part."""

TREE_LEVELS: tuple[TreeLevel, ...] = get_args(TreeLevel)
