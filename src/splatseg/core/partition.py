r"""Space in overlapping blocks, and what each block counts at a point.

With :math:`\delta_b(x)` the distance of a point from the core of block b, such as a piece of a
drive or a cell of a plan, and o the overlap, blocks count

.. math:: w_b(x) = \frac{g_b(x)}{\sum_c g_c(x)}, \qquad
          g_b(x) = \operatorname{clip}\left(\frac12 + \frac{\min_{c \ne b} \delta_c(x)
                   - \delta_b(x)}{o},\; 0,\; 1\right)

Across the border of two cores that goes linearly from 1 to 0 over the overlap. It is a function of
the point alone and continuous everywhere.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError

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


# Cells of a plan.


_SLACK = 0.1
"""Share of the views by which halves may differ from their part, for a cut between rooms."""

_OVERLAP = 0.2
"""Overlap of neighbours, in sides of a square cell of the usual size: as VastGaussian's."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cells:
    """Cells of a plan. They tile space; neighbours overlap.

    Raises:
        ShapeError: If an array has another shape.
        InputError: If there is no cell.
    """

    axes: Float[Tensor, "2 3"]
    """Orthonormal axes of the plan in the world, float64."""

    low: Float[Tensor, "b 2"]
    """Lowest corners of the cells along the axes, scene units; minus infinity where one has no
    end."""

    high: Float[Tensor, "b 2"]
    """Highest corners, not part of them."""

    overlap: float
    """Width of the overlap across a border, half of it on either side, scene units."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_shape("axes", self.axes, (2, 3))
        check_shape("low", self.low, (None, 2))
        check_shape("high", self.high, (len(self.low), 2))
        if not len(self.low):
            raise InputError("low, high: expected at least one cell, got none.")

    def __len__(self) -> int:
        return len(self.low)

    @boundary
    def shares(self, points: Float[Tensor, "p 3"]) -> tuple[BlockShare, ...]:
        """What blocks count at points, see `core.partition`: anything within half an overlap.

        Args:
            points: World, scene units.

        Raises:
            ShapeError: If the points are not (p, 3).
            RangeError: If one is not finite.
        """
        check_shape("points", points, (None, 3))
        check_finite("points", points)
        return block_shares(
            self._plan(points),
            self._distances,
            low=self.low,
            high=self.high,
            overlap=self.overlap,
        )

    @boundary
    def cell_of(self, points: Float[Tensor, "p 3"]) -> Int[Tensor, "p"]:
        """The number of the cell that each point is in, int64; world, scene units."""
        return owners(self.shares(points), len(points))

    @boundary
    def regions(self, points: Float[Tensor, "p 3"]) -> Bool[Tensor, "b p"]:
        """Which points are in the region of each block; world, scene units."""
        inside = torch.zeros(len(self), len(points), dtype=torch.bool)
        for share in self.shares(points):
            inside[share.block, share.rows] = True
        return inside

    def record(self) -> dict[str, Any]:
        """Values that JSON holds; None is infinite."""

        def rows(corners: Tensor) -> list[list[float | None]]:
            return [[v if math.isfinite(v) else None for v in row] for row in corners.tolist()]

        return {
            "axes": self.axes.tolist(),
            "low": rows(self.low),
            "high": rows(self.high),
            "overlap": self.overlap,
        }

    def _distances(self, places: Float[Tensor, "p 2"], block: int) -> Float[Tensor, "p"]:
        outside = torch.maximum(self.low[block] - places, places - self.high[block])
        return torch.linalg.vector_norm(outside.clamp_min(0), dim=1)

    def _plan(self, points: Float[Tensor, "p 3"]) -> Float[Tensor, "p 2"]:
        return points.detach().cpu().double() @ self.axes.T


@boundary
def plan_axes(
    centres: Float[Tensor, "n 3"], up: Sequence[float] | None = None
) -> Float[Tensor, "2 3"]:
    """Axes of the plan: level, along the sides of the smallest rectangle around the cameras.

    Args:
        centres: Centres of cameras, world.
        up: Away from the ground; None takes the direction in which cameras are spread least.

    Returns:
        Orthonormal, float64.
    """
    places = centres.double()
    if up is None:
        offset = places - places.mean(dim=0)
        normal = torch.linalg.eigh(offset.T @ offset).eigenvectors[:, 0]
    else:
        normal = torch.nn.functional.normalize(torch.tensor(up, dtype=torch.float64), dim=0)
    first = torch.zeros(3, dtype=torch.float64)
    first[int(normal.abs().argmin())] = 1.0
    first = torch.nn.functional.normalize(first - (first @ normal) * normal, dim=0)
    second = torch.linalg.cross(normal, first)
    best, area = torch.stack((first, second)), math.inf
    for degrees in range(90):
        c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        axes = torch.stack((c * first + s * second, c * second - s * first))
        plan = places @ axes.T
        sides = plan.amax(dim=0) - plan.amin(dim=0)
        # By more than rounding, so that a plan that lies along the world's axes keeps them.
        if float(sides.prod()) < area * (1 - 1e-9):
            best, area = axes, float(sides.prod())
    return best


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Gap:
    """Where a cell is cut: anywhere between two cameras that stand beside each other."""

    direction: Float[Tensor, "3"]
    """Axis that the cell is cut across, world, float64."""

    first: float
    """Along it the last camera before the cut."""

    last: float
    """The first one behind it."""

    before: Int[Tensor, "n"]
    """Numbers of the cell's cameras before it."""

    behind: Int[Tensor, "m"]


@boundary
def cut_plan(
    centres: Float[Tensor, "n 3"],
    count: int,
    *,
    up: Sequence[float] | None = None,
    border: Callable[[Gap], float] | None = None,
) -> Cells:
    """Cells with equally many cameras, cut where these stand farthest apart.

    The plan is halved again and again across its longer side, within a tenth of the cameras of
    equal parts. The outermost cells have no end. The overlap is a fifth of the side of a square
    cell of the usual size (VastGaussian, Lin et al. 2024, section 4.1).

    Args:
        centres: Of cameras, world, scene units.
        count: Number of cells.
        up: Away from the ground; None takes the direction in which cameras are spread least.
        border: Where in a gap the border is; None is its middle.

    Raises:
        InputError: If there are fewer cameras at different places than cells.

    Example:
        >>> line = torch.tensor([[0.0, 0, 0], [1, 0, 0], [5, 0, 0], [6, 0, 0]])
        >>> cells = cut_plan(line, 2, up=(0, 0, 1))
        >>> cells.cell_of(line).tolist()
        [0, 0, 1, 1]
    """
    check_shape("centres", centres, (None, 3))
    check_finite("centres", centres)
    if not 1 <= count <= len(centres):
        raise InputError(f"blocks: expected 1 to {len(centres)}, as many as cameras, got {count}.")
    places = centres.detach().cpu().double()
    axes = plan_axes(places, up)
    plan = places @ axes.T
    ends = torch.tensor([[-math.inf] * 2, [math.inf] * 2]).double()
    whole = _Cell(rows=torch.arange(len(plan)), low=ends[0], high=ends[1])
    cells = [(c.low, c.high) for c in _halved(whole, plan, axes, count, border)]
    low, high = (torch.stack(corners) for corners in zip(*cells, strict=True))
    # A camera wide where they stand on a line, or in one place.
    sides = (plan.amax(dim=0) - plan.amin(dim=0)).sort(descending=True).values.tolist()
    side = math.sqrt(sides[0] / count * max(sides[1], sides[0] / count)) or 1.0
    return Cells(axes=axes, low=low, high=high, overlap=_OVERLAP * side)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Cell:
    rows: Int[Tensor, "n"]
    low: Float[Tensor, "2"]
    high: Float[Tensor, "2"]


def _halved(
    cell: _Cell,
    plan: Float[Tensor, "n 2"],
    axes: Float[Tensor, "2 3"],
    count: int,
    border: Callable[[Gap], float] | None,
) -> Iterator[_Cell]:
    """Cut a cell into some, where their cameras are farthest apart among nearly equal halves."""
    if count == 1:
        yield cell
        return
    own, first = plan[cell.rows], count // 2
    for axis in (own.amax(dim=0) - own.amin(dim=0)).argsort(descending=True).tolist():
        ordered = own[:, axis].sort().values
        gaps = ordered[1:] - ordered[:-1]
        left = torch.arange(1, len(ordered))
        # Each side needs a camera a cell.
        possible = (gaps > 0) & (left >= first) & (len(ordered) - left >= count - first)
        if not bool(possible.any()):
            continue
        off = (left - len(ordered) * first / count).abs()
        near = possible & (off <= max(_SLACK * len(ordered), float(off[possible].min())))
        at = int(torch.where(near, gaps, -1.0).argmax())
        below = own[:, axis] <= ordered[at]
        gap = Gap(
            direction=axes[axis],
            first=float(ordered[at]),
            last=float(ordered[at + 1]),
            before=cell.rows[below],
            behind=cell.rows[~below],
        )
        end = (gap.first + gap.last) / 2 if border is None else border(gap)
        lower_high, upper_low = cell.high.clone(), cell.low.clone()
        lower_high[axis] = upper_low[axis] = end
        lower = _Cell(rows=gap.before, low=cell.low, high=lower_high)
        upper = _Cell(rows=gap.behind, low=upper_low, high=cell.high)
        yield from _halved(lower, plan, axes, first, border)
        yield from _halved(upper, plan, axes, count - first, border)
        return
    raise InputError(
        f"blocks: expected at most as many as cameras at different places of the plan, got more: "
        f"{len(own)} in one place cannot be parted into {count}."
    )
