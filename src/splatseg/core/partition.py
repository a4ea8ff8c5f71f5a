r"""Space in overlapping blocks, and what each block counts at a point.

With :math:`\delta_b(x)` the distance of a point from the core of block b, such as a piece of a drive
or a cell of a plan, and o the overlap, blocks count

.. math:: w_b(x) = \frac{g_b(x)}{\sum_c g_c(x)}, \qquad
          g_b(x) = \operatorname{clip}\left(\frac12 + \frac{\min_{c \ne b} \delta_c(x)
                   - \delta_b(x)}{o},\; 0,\; 1\right)

Across the border of two cores that goes linearly from 1 to 0 over the overlap. It is a function of
the point alone and continuous everywhere.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

_POINTS = 16384


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BlockShare:
    """What a block counts at some points."""

    block: int

    rows: Int[Tensor, "n"]
    """Which points, int64, ascending."""

    weights: Float[Tensor, "n"]
    """In (0, 1], float64; those of all blocks at a point add up to 1."""


Distances = Callable[[Float[Tensor, "n d"], int], Float[Tensor, "n"]]
"""Distances of points from the core of a block by its number, 0 inside of it."""


def block_shares(
    points: Float[Tensor, "n d"],
    distances: Distances,
    *,
    low: Float[Tensor, "b d"],
    high: Float[Tensor, "b d"],
    overlap: float,
) -> tuple[BlockShare, ...]:
    """What blocks count at points, of those blocks that count at any, in their order.

    Args:
        points: Finite, float64.
        distances: Of points from a core.
        low: Lowest corners of boxes around the cores, which may be infinite.
        high: Their highest corners.
        overlap: Positive, in units of the distances.
    """
    found: dict[int, list[tuple[Tensor, Tensor]]] = {}
    for first in range(0, len(points), _POINTS):
        part = points[first : first + _POINTS]
        for block, weights in _weights(part, distances, low, high, overlap):
            rows = torch.nonzero(weights > 0).squeeze(1)
            if len(rows):
                found.setdefault(block, []).append((rows + first, weights[rows]))
    return tuple(
        BlockShare(
            block=block,
            rows=torch.cat([rows for rows, _ in parts]),
            weights=torch.cat([weights for _, weights in parts]),
        )
        for block, parts in sorted(found.items())
    )


def owners(shares: Sequence[BlockShare], count: int) -> Int[Tensor, "n"]:
    """The block that counts most at each point, int64; of equal ones the first.

    Args:
        shares: `block_shares` of the points.
        count: Number of points.
    """
    best, owner = torch.zeros(count, dtype=torch.float64), torch.zeros(count, dtype=torch.int64)
    for share in shares:
        more = share.weights > best[share.rows]
        best[share.rows[more]] = share.weights[more]
        owner[share.rows[more]] = share.block
    return owner


def _weights(
    points: Float[Tensor, "n d"],
    distances: Distances,
    low: Float[Tensor, "b d"],
    high: Float[Tensor, "b d"],
    overlap: float,
) -> Iterator[tuple[int, Float[Tensor, "n"]]]:
    """Blocks that may count at some points, with their weights there."""
    gaps = torch.maximum(low - points.amax(dim=0), points.amin(dim=0) - high)
    gaps = torch.linalg.vector_norm(gaps.clamp_min(0), dim=1)
    nearest = points.new_full((len(points),), math.inf)
    found: dict[int, Tensor] = {}
    for block in torch.argsort(gaps, stable=True).tolist():
        # A block that is half an overlap farther than another from all points counts nothing.
        if float(gaps[block]) > float(nearest.max()) + overlap / 2:
            break
        found[block] = distances(points, block)
        nearest = torch.minimum(nearest, found[block])
    # In the order of blocks, so that sums do not depend on which points are asked together.
    order = sorted(found)
    table = torch.stack([found[block] for block in order])
    two = table.topk(min(2, len(order)), dim=0, largest=False).values
    second = two[1] if len(order) > 1 else torch.full_like(nearest, math.inf)
    others = torch.where(table == nearest, second, nearest)
    counts = (0.5 + (others - table) / overlap).clamp(0, 1)
    total = counts[0].clone()
    for row in counts[1:]:
        total += row
    for block, row in zip(order, counts, strict=True):
        yield block, row / total
