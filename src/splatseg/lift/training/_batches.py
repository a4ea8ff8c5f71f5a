"""How drawn pixels of views are cut into batches."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchGroup:
    """Views whose drawn pixels are cut into batches together."""

    views: Sequence[int]
    """Indices of the views, ascending."""

    offsets: Sequence[int]
    """By view, which batch gets the first of what does not divide."""

    count: int
    """How many batches."""

    def span(self, pixels: int, offset: int, index: int) -> tuple[int, int]:
        """Which of a view's drawn pixels a batch takes.

        They are in random order, and each batch takes an equal part. What does not divide goes
        to other batches in each view, by the view's offset.
        """
        turned = (index + offset) % self.count
        return pixels * turned // self.count, pixels * (turned + 1) // self.count


def batch_groups(
    sizes: Sequence[int], batch: int, views_per_batch: int | None, rng: np.random.Generator
) -> list[BatchGroup]:
    """Groups of views that are cut into batches together: all, or some drawn by chance."""
    if views_per_batch is None:
        return [_group(sizes, range(len(sizes)), batch, rng)]
    order = rng.permutation([view for view, size in enumerate(sizes) if size])
    # As even as can be: what does not divide makes several groups smaller by one.
    parts = np.array_split(order, math.ceil(len(order) / views_per_batch))
    return [_group(sizes, sorted(part.tolist()), batch, rng) for part in parts]


def _group(
    sizes: Sequence[int], views: Sequence[int], batch: int, rng: np.random.Generator
) -> BatchGroup:
    total = sum(sizes[view] for view in views)
    count = max(1, min(total, math.ceil(total / batch)))
    # A view with fewer pixels than there are batches is in some of them only.
    offsets = rng.integers(count, size=len(views)).tolist()
    return BatchGroup(views=tuple(views), offsets=tuple(offsets), count=count)
