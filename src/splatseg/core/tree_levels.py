"""Levels of a tree of instances."""

import math
from typing import Literal, get_args

from splatseg.core.boundary import boundary
from splatseg.errors import InputError

TreeLevel = Literal["group", "object", "part"]
"""Levels from the root down. A table with what stands on it is a group, a lamp on it an object,
the shade of the lamp a part."""

TREE_LEVELS: tuple[TreeLevel, ...] = get_args(TreeLevel)


@boundary
def tree_level(text: str) -> TreeLevel | float:
    """A level by name, or a granularity, as people write them.

    Raises:
        InputError: If it is neither.

    Example:
        >>> tree_level("part"), tree_level("0.25")
        ('part', 0.25)
    """
    if text in TREE_LEVELS:
        return text
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value <= 1:
        raise InputError(
            f"level: expected {', '.join(TREE_LEVELS)} or a number from 0 to 1, got {text!r}."
        )
    return value
