r"""A drive cut into overlapping blocks, and what each block counts at a point.

The line of the drive is cut into consecutive pieces of equal length. With :math:`\delta_b(x)` the
distance of a point from the piece of block b, and o the overlap, blocks count

.. math:: w_b(x) = \frac{g_b(x)}{\sum_c g_c(x)}, \qquad
          g_b(x) = \operatorname{clip}\left(\frac12 + \frac{\min_{c \ne b} \delta_c(x)
                   - \delta_b(x)}{o},\; 0,\; 1\right)

On the line of the drive that goes linearly from 1 to 0 over the overlap around the end of a piece.
It is a function of the point alone and continuous everywhere, inside of bends and where a drive
crosses itself as well: there the blocks of all passes count.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, RangeError
from splatseg.street.blocks.line import between, distances, lengths, simplified, thinned

_POINTS = 16384
_STEPS_AN_OVERLAP = 8
_TOLERANCE = 0.005
"""By how much of the overlap the line may be straightened: weights change by no more."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveBlockOptions:
    """How drives are cut. Lengths are metres."""

    length: float = 80.0
    """Of a block along the drive, its overlaps included, at most."""

    overlap: float = 20.0
    """What two blocks that follow each other share, less than the length."""

    reach: float = 60.0
    """How far from its part of the drive a block has points. A drive of one block has all."""

    def __post_init__(self) -> None:
        convert_fields(self)
        for name in ("length", "overlap", "reach"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise RangeError(f"{name}: expected a positive number of metres, got {value}.")
        if self.overlap >= self.length:
            raise RangeError(
                f"overlap: expected less than the length of {self.length:g} m, got "
                f"{self.overlap:g} m."
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DriveBlock:
    """One block of a drive.

    Raises:
        ShapeError: If a line is not (n, 3).
        InputError: If a line has no place.
        RangeError: If a place is not finite, or the piece ends before it begins.
    """

    index: int
    """From 0 along the drive."""

    start: float
    """Where its piece begins, scene units along the drive."""

    end: float
    """Where its piece ends."""

    piece: Float[Tensor, "n 3"]
    """The line of its piece, world, float64; pieces of a drive do not overlap."""

    span: Float[Tensor, "m 3"]
    """The line of the piece with half an overlap on either side, where the drive goes on."""

    def __post_init__(self) -> None:
        convert_fields(self)
        for name in ("piece", "span"):
            line: Tensor = getattr(self, name)
            check_shape(name, line, (None, 3))
            check_finite(name, line)
            if not len(line):
                raise InputError(f"{name}: expected at least one place, got none.")
            object.__setattr__(self, name, line.detach().cpu().double())
        if not -math.inf < self.start <= self.end < math.inf:
            raise RangeError(f"start, end: expected a piece, got {self.start:g} to {self.end:g}.")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BlockShare:
    """What a block counts at some points."""

    block: int

    rows: Int[Tensor, "n"]
    """Which points, int64, ascending."""

    weights: Float[Tensor, "n"]
    """In (0, 1], float64; those of all blocks at a point add up to 1."""


def _no_places() -> Float[Tensor, "0 3"]:
    return torch.zeros(0, 3, dtype=torch.float64)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drive:
    """A drive in blocks: `cut_drive`.

    Raises:
        InputError: If there are no blocks, or they do not count from 0.
        RangeError: If a length is not positive.
    """

    blocks: tuple[DriveBlock, ...]

    overlap: float
    """Scene units."""

    reach: float
    """Scene units."""

    _low: Float[Tensor, "b 3"] = field(init=False, repr=False, default_factory=_no_places)
    """Lowest corners of the boxes around pieces, and highest."""

    _high: Float[Tensor, "b 3"] = field(init=False, repr=False, default_factory=_no_places)

    def __post_init__(self) -> None:
        convert_fields(self)
        if not self.blocks or [b.index for b in self.blocks] != list(range(len(self.blocks))):
            raise InputError(
                f"blocks: expected blocks that count from 0, got {[b.index for b in self.blocks]}."
            )
        for name in ("overlap", "reach"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise RangeError(f"{name}: expected a positive length, got {value}.")
        low = torch.stack([block.piece.amin(dim=0) for block in self.blocks])
        high = torch.stack([block.piece.amax(dim=0) for block in self.blocks])
        object.__setattr__(self, "_low", low)
        object.__setattr__(self, "_high", high)

    def __len__(self) -> int:
        return len(self.blocks)

    @boundary
    def shares(self, points: Float[Tensor, "p 3"]) -> tuple[BlockShare, ...]:
        """What blocks count at points, of those blocks that count at any, in their order.

        Args:
            points: World, scene units.

        Raises:
            ShapeError: If the points are not (p, 3).
            RangeError: If one is not finite.
        """
        check_shape("points", points, (None, 3))
        check_finite("points", points)
        at = points.detach().cpu().double()
        found: dict[int, list[tuple[Tensor, Tensor]]] = {}
        for first in range(0, len(at), _POINTS):
            for block, weights in self._weights(at[first : first + _POINTS]):
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

    @boundary
    def block_of(self, place: Float[Tensor, "3"]) -> int:
        """The block that counts most at a place, such as a camera's; of equal ones the first."""
        check_shape("place", place, (3,))
        shares = self.shares(place.unsqueeze(0))
        return max(shares, key=lambda share: (float(share.weights[0]), -share.block)).block

    @boundary
    def counts(self, block: DriveBlock, points: Float[Tensor, "p 3"]) -> Bool[Tensor, "p"]:
        """At which points a block counts anything; they may be spread over all of the drive."""
        check_shape("points", points, (None, 3))
        check_finite("points", points)
        at = points.detach().cpu().double()
        rows = torch.arange(len(at))
        # What a block's neighbours are nearer to by half an overlap is none of its points; few
        # are left to be asked about with all blocks.
        for index in (block.index - 1, block.index + 1):
            if 0 <= index < len(self):
                own = distances(at[rows], block.piece)
                other = distances(at[rows], self.blocks[index].piece)
                rows = rows[own < other + self.overlap / 2]
        out = torch.zeros(len(at), dtype=torch.bool)
        for share in self.shares(at[rows]):
            if share.block == block.index:
                out[rows[share.rows]] = True
        return out

    @boundary
    def near(self, block: DriveBlock, points: Float[Tensor, "p 3"]) -> Bool[Tensor, "p"]:
        """Which points a block has: those in reach of its part of the drive."""
        check_shape("points", points, (None, 3))
        check_finite("points", points)
        if len(self) == 1:
            return torch.ones(len(points), dtype=torch.bool)
        return distances(points.detach().cpu().double(), block.span) <= self.reach

    def _weights(self, points: Float[Tensor, "n 3"]) -> Iterator[tuple[int, Float[Tensor, "n"]]]:
        """Blocks that may count at some points, with their weights there."""
        gaps = torch.maximum(self._low - points.amax(dim=0), points.amin(dim=0) - self._high)
        gaps = torch.linalg.vector_norm(gaps.clamp_min(0), dim=1)
        nearest = points.new_full((len(points),), math.inf)
        found: dict[int, Tensor] = {}
        for block in torch.argsort(gaps, stable=True).tolist():
            # A block that is half an overlap farther than another from all points counts nothing.
            if float(gaps[block]) > float(nearest.max()) + self.overlap / 2:
                break
            found[block] = distances(points, self.blocks[block].piece)
            nearest = torch.minimum(nearest, found[block])
        # In the order of blocks, so that sums do not depend on which points are asked together.
        order = sorted(found)
        table = torch.stack([found[block] for block in order])
        two = table.topk(min(2, len(order)), dim=0, largest=False).values
        second = two[1] if len(order) > 1 else torch.full_like(nearest, math.inf)
        others = torch.where(table == nearest, second, nearest)
        counts = (0.5 + (others - table) / self.overlap).clamp(0, 1)
        total = counts[0].clone()
        for row in counts[1:]:
            total += row
        for block, row in zip(order, counts, strict=True):
            yield block, row / total


@boundary
def cut_drive(
    centres: Float[Tensor, "n 3"],
    *,
    options: DriveBlockOptions | None = None,
    metres_per_unit: float = 1.0,
) -> Drive:
    """Cut a drive into the fewest equal blocks that are not longer than asked for.

    What stands still makes no way: places nearer than an eighth of the overlap to the last one
    are left out, and the line is straightened by at most a two-hundredth of the overlap. Places
    farther apart than a block is long are not connected: there one drive ends and another begins.

    Args:
        centres: Places along the drive in its order, world, scene units: `frame_centres`.
        options: How long blocks are.
        metres_per_unit: Length of a scene unit.

    Raises:
        InputError: If there are no places.
        ShapeError: If they are not (n, 3).
        RangeError: If one is not finite, or the unit is no length.

    Example:
        >>> road = torch.stack((torch.arange(201.0), torch.zeros(201), torch.zeros(201)), dim=1)
        >>> drive = cut_drive(road)
        >>> [(block.start, block.end) for block in drive.blocks]
        [(0.0, 50.0), (50.0, 100.0), (100.0, 150.0), (150.0, 200.0)]
        >>> [(s.block, s.weights.tolist()) for s in drive.shares(torch.tensor([[55.0, 0, 0]]))]
        [(0, [0.25]), (1, [0.75])]
    """
    check_shape("centres", centres, (None, 3))
    check_finite("centres", centres)
    if not len(centres):
        raise InputError("centres: expected places along a drive, got none.")
    if not (math.isfinite(metres_per_unit) and metres_per_unit > 0):
        raise RangeError(f"metres_per_unit: expected a length, got {metres_per_unit}.")
    options = options or DriveBlockOptions()
    overlap, length = options.overlap / metres_per_unit, options.length / metres_per_unit
    places = centres.detach().cpu().double()
    gaps = torch.linalg.vector_norm(places[1:] - places[:-1], dim=1) > length
    starts = [0, *(torch.nonzero(gaps).squeeze(1) + 1).tolist(), len(places)]
    blocks: list[DriveBlock] = []
    for first, last in pairwise(starts):
        blocks += _blocks(places[first:last], length, overlap, before=blocks)
    return Drive(blocks=tuple(blocks), overlap=overlap, reach=options.reach / metres_per_unit)


def _blocks(
    places: Float[Tensor, "n 3"], length: float, overlap: float, *, before: Sequence[DriveBlock]
) -> list[DriveBlock]:
    """Blocks of a drive without gaps, which go on counting after those before it."""
    line = thinned(places, overlap / _STEPS_AN_OVERLAP)
    along = lengths(line)
    total = float(along[-1])
    count = 1 if total <= length else math.ceil(total / (length - overlap))
    ends = [total * i / count for i in range(count + 1)]
    driven = before[-1].end if before else 0.0

    def part(start: float, end: float) -> Tensor:
        return simplified(between(line, along, start, end), _TOLERANCE * overlap)

    return [
        DriveBlock(
            index=len(before) + i,
            start=driven + ends[i],
            end=driven + ends[i + 1],
            piece=part(ends[i], ends[i + 1]),
            span=part(ends[i] - overlap / 2, ends[i + 1] + overlap / 2),
        )
        for i in range(count)
    ]
