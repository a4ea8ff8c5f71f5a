"""Masks of several views joined to things by what they share."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

SAME = 0.2
"""IoU from which on masks of two views are of one thing."""


def linked(
    views: Sequence[int], iou: Float[Tensor, "m m"], scores: Sequence[float]
) -> list[list[int]]:
    """Masks joined to objects: those of two views that are of one thing, of each view one.

    Args:
        views: The view of each mask.
        iou: Of all pairs.
        scores: How sure each is; objects come in the order of their surest mask.
    """
    free = set(range(len(views)))
    objects: list[list[int]] = []
    for seed in sorted(range(len(views)), key=lambda one: (-scores[one], one)):
        if seed not in free:
            continue
        free.discard(seed)
        members = [seed]
        for view in sorted(set(views) - {views[seed]}):
            rivals = [one for one in sorted(free) if views[one] == view]
            best = max(rivals, key=lambda one: (float(iou[seed, one]), -one), default=None)
            if best is not None and float(iou[seed, best]) >= SAME:
                members.append(best)
                free.discard(best)
        objects.append(sorted(members, key=lambda one: views[one]))
    return objects
