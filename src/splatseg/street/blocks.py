"""A drive cut into overlapping blocks.

The line of the drive is cut into consecutive pieces of equal length, which are the cores of its
blocks. What each counts at a point is in `core.partition`: on the line of the drive it goes
linearly from 1 to 0 over the overlap around the end of a piece; inside of bends and where a drive
crosses itself the blocks of all passes count.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core import View
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.options import Positive, options
from splatseg.core.partition import BlockShare, block_shares, owners
from splatseg.core.scene import frame_number
from splatseg.errors import InputError, RangeError

_POINTS = 16384
_STEPS_AN_OVERLAP = 8
_TOLERANCE = 0.005
"""By how much of the overlap the line may be straightened: weights change by no more."""


@options
class DriveBlockOptions:
    """How drives are cut into blocks. Lengths are metres."""

    length: Positive = 80.0
    """Maximum length of a block along the drive, including its overlaps, metres."""

    overlap: Positive = 20.0
    """Overlap of two consecutive blocks, metres, less than the length."""

    reach: Positive = 60.0
    """Maximum distance of a block's points from its part of the drive, metres. A drive of one
    block has all points."""

    def __post_init__(self) -> None:
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


def _no_places() -> Float[Tensor, "0 3"]:
    return torch.zeros(0, 3, dtype=torch.float64)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DriveBlocks:
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
        return block_shares(
            points.detach().cpu().double(),
            lambda places, block: distances(places, self.blocks[block].piece),
            low=self._low,
            high=self._high,
            overlap=self.overlap,
        )

    @boundary
    def block_of(self, place: Float[Tensor, "3"]) -> int:
        """The block that counts most at a place, such as a camera's; of equal ones the first."""
        check_shape("place", place, (3,))
        return int(owners(self.shares(place.unsqueeze(0)), 1))

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


@boundary
def cut_drive(
    centres: Float[Tensor, "n 3"],
    *,
    options: DriveBlockOptions | None = None,
    metres_per_unit: float = 1.0,
) -> DriveBlocks:
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
    return DriveBlocks(blocks=tuple(blocks), overlap=overlap, reach=options.reach / metres_per_unit)


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


# Lines through places in order: lengths, pieces, and distances of points from them.


def thinned(places: Float[Tensor, "n 3"], step: float) -> Float[Tensor, "m 3"]:
    """The first place, each that is a step from the last one kept, and the last."""
    kept = [places[0]]
    for place in places[1:]:
        if float(torch.linalg.vector_norm(place - kept[-1])) >= step:
            kept.append(place)
    if not torch.equal(kept[-1], places[-1]):
        kept.append(places[-1])
    return torch.stack(kept)


def simplified(line: Float[Tensor, "n 3"], tolerance: float) -> Float[Tensor, "m 3"]:
    """Fewest corners that the method of Douglas and Peucker finds within a tolerance of all.

    What lies between two kept corners is no farther from their connection than the tolerance.
    """
    kept = {0, len(line) - 1}
    open_pieces = [(0, len(line) - 1)]
    while open_pieces:
        first, last = open_pieces.pop()
        if last - first < 2:
            continue
        off = distances(line[first + 1 : last], line[[first, last]])
        middle = first + 1 + int(off.argmax())
        if float(off.max()) > tolerance:
            kept.add(middle)
            open_pieces += [(first, middle), (middle, last)]
    return line[sorted(kept)]


def lengths(line: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """How far along a line its corners are."""
    steps = torch.linalg.vector_norm(line[1:] - line[:-1], dim=1)
    return torch.cat((steps.new_zeros(1), steps.cumsum(0)))


def between(
    line: Float[Tensor, "n 3"], along: Float[Tensor, "n"], start: float, end: float
) -> Float[Tensor, "m 3"]:
    """The piece of a line from one length to another, cut where the line begins and ends."""
    inside = (along > start) & (along < end)
    ends = (_place(line, along, start), _place(line, along, end))
    return torch.cat((ends[0][None], line[inside], ends[1][None]))


def _place(
    line: Float[Tensor, "n 3"], along: Float[Tensor, "n"], length: float
) -> Float[Tensor, "3"]:
    at = min(max(length, 0.0), float(along[-1]))
    i = int(torch.searchsorted(along, at, right=True)) - 1
    if i >= len(line) - 1:
        return line[-1]
    share = (at - float(along[i])) / float(along[i + 1] - along[i])
    return line[i] + share * (line[i + 1] - line[i])


def distances(points: Float[Tensor, "n 3"], line: Float[Tensor, "m 3"]) -> Float[Tensor, "n"]:
    """Distance of each point from the nearest place of a line.

    Nothing but operations on single numbers, so that a point has the same bits in any company.
    """
    parts = [_distances(part, line) for part in points.split(_POINTS)]
    return torch.cat(parts) if parts else points.new_zeros(0)


def _distances(points: Float[Tensor, "n 3"], line: Float[Tensor, "m 3"]) -> Float[Tensor, "n"]:
    start = line[:1] if len(line) == 1 else line[:-1]
    way = torch.zeros_like(start) if len(line) == 1 else line[1:] - line[:-1]
    squared = _sum(way * way)
    offset = [points[:, k : k + 1] - start[:, k] for k in range(3)]
    dot = offset[0] * way[:, 0] + offset[1] * way[:, 1] + offset[2] * way[:, 2]
    share = torch.where(squared > 0, dot / torch.where(squared > 0, squared, 1.0), 0.0).clamp(0, 1)
    rest = [offset[k] - share * way[:, k] for k in range(3)]
    return (rest[0] ** 2 + rest[1] ** 2 + rest[2] ** 2).amin(dim=1).sqrt()


def _sum(values: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    return values[:, 0] + values[:, 1] + values[:, 2]


# Where a drive went: the places of its views in the order in which they were taken.


RIG = 5.0
"""Metres that cameras of one vehicle may stand apart."""


@boundary
def frame_centres(views: Sequence[View], *, metres_per_unit: float = 1.0) -> Float[Tensor, "n 3"]:
    """Places along a drive, one for all cameras of a vehicle at one time.

    The last number in a view's name counts the frames: ``train_0003_L`` and
    ``image_01/0000000003`` are of frame 3. Views of one number are one place, their mean, as long
    as no two of them stand more than 5 m apart; otherwise the names are of several drives, which
    follow each other by the rest of their names. Without numbers views are in the order of names.

    Args:
        views: Views of a drive, in any order; the training views, as others may be beside it.
        metres_per_unit: Length of a scene unit.

    Returns:
        World, scene units, float64.

    Raises:
        InputError: If there are no views.

    Example:
        >>> from splatseg.core import Camera
        >>> def at(name, x):
        ...     pose = torch.eye(4)
        ...     pose[0, 3] = -x
        ...     camera = Camera(width=4, height=4, fx=4, fy=4, cx=2, cy=2, cam_from_world=pose)
        ...     return View(name=name, camera=camera)
        >>> frame_centres([at("a_2_L", 9.0), at("a_2_R", 11.0), at("a_1_L", 0.0)])[:, 0].tolist()
        [0.0, 10.0]
    """
    if not views:
        raise InputError("views: expected views along a drive, got none.")
    named = sorted(views, key=lambda view: view.name)
    numbers = [frame_number(view.name) for view in named]
    drives: dict[tuple[str, int], list[Tensor]] = {}
    frames: dict[int, list[Tensor]] = {}
    for view, number in zip(named, numbers, strict=True):
        if number is None:
            return torch.stack([view.camera.centre for view in named]).double()
        drives.setdefault(number, []).append(view.camera.centre.double())
        frames.setdefault(number[1], []).append(view.camera.centre.double())
    one_rig = all(_extent(places) * metres_per_unit <= RIG for places in frames.values())
    return _means(frames if one_rig else drives)


def _extent(places: Sequence[Tensor]) -> float:
    """Length of the diagonal of the box of some places."""
    stacked = torch.stack(list(places))
    return float(torch.linalg.vector_norm(stacked.amax(dim=0) - stacked.amin(dim=0)))


def _means(frames: Mapping[int, list[Tensor]] | Mapping[tuple[str, int], list[Tensor]]) -> Tensor:
    rows = sorted(frames.items())
    return torch.stack([torch.stack(places).mean(dim=0) for _, places in rows])
