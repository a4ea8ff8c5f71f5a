"""Switches of association."""

import math
from dataclasses import dataclass
from typing import Literal, get_args

from splatseg._check import check_range
from splatseg.core import tree_level
from splatseg.errors import InputError, RangeError

Overlapping = Literal["tree", "flat"]
"""What overlapping masks become: a tree of levels, or one label a Gaussian."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AssociateOptions:
    """How segments of views become instances."""

    agreement: float = 0.2
    """Least overlap, in (0, 1], at which two groups of segments are one instance: intersection
    over union on the Gaussians that the views of both see, averaged over all pairs of segments
    of the two groups. Lower joins more."""

    small_things: float = 0.0
    """Exponent with which small instances outweigh large ones where views contradict each other;
    0 treats all alike. 0.25 does most of what correcting confusion does, without it."""

    min_views: int = 2
    """An instance needs segments in so many views, or in all there are if they are fewer."""

    overlapping: Overlapping = "tree"
    """What masks that may overlap become. tree: groups, objects and parts, each in its parent.
    flat: objects alone, whatever level most of the masks have."""

    level: str = "tree"
    """Of a tree, what is given: tree is all of it; group, object or part, or a granularity from 0
    (groups) over 0.5 (objects) to 1 (the finest parts), are one cut of it as labels."""

    min_support: float = 0.3
    """Of a tree: a group of segments is a node if this share, in [0, 1], of the views that could
    have seen it has a segment of it. Higher leaves out what few masks speak for."""

    overlap: float = 0.7
    """Of overlapping masks: a node lies in another if more than this share of it does, in
    [0, 1]; with flat, a group is left out if more than this share of it is covered by groups
    that were taken before."""

    max_views: int = 50
    """Views of each Gaussian that are compared, those that see most of it; bounds memory and
    time."""

    longest_side: int = 640
    """Segments of larger photographs are read at this many pixels along their longest side;
    bounds time. What is thinner than a pixel there may be missed."""

    def __post_init__(self) -> None:
        check_range("agreement", self.agreement, 0.0, 1.0)
        if not (math.isfinite(self.small_things) and self.small_things >= 0):
            raise RangeError(f"small_things: expected 0 or more, got {self.small_things}.")
        check_range("overlap", self.overlap, 0.0, 1.0)
        check_range("min_support", self.min_support, 0.0, 1.0)
        if self.overlapping not in get_args(Overlapping):
            raise InputError(f"overlapping: expected tree or flat, got {self.overlapping!r}.")
        if self.level != "tree":
            tree_level(self.level)
        for name in ("min_views", "max_views", "longest_side"):
            if getattr(self, name) < 1:
                raise RangeError(f"{name}: expected at least 1, got {getattr(self, name)}.")
