"""Outlines and masks of annotations as run lengths, each worked on in its own box of pixels.

Coordinates are pixels with the corner of the picture at (0, 0), x right and y down; a pixel belongs
to an outline that holds its centre (even-odd).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatseg.core import Rle
from splatseg.core.json_values import MAX_NUMBER
from splatseg.errors import quoted
from splatseg.io.foreign import expect, malformed
from splatseg.io.limits import check_unpacked

_BYTES_OF_CROSSING = 48
"""What an edge takes in a row of pixels that it crosses: its number, the row, and where."""

_BYTES_OF_PIXEL = 12
"""Of the box of an outline: how often its edges were crossed, and whether that is odd."""

Bool2 = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class Region:
    """One annotated area of a picture."""

    mask: Rle
    category: int = 0
    """Id of its class, 0 where it has none."""

    score: float = 1.0
    """Confidence of what drew it, in [0, 1]."""

    order: float = 0.0
    """What lies over what: higher over lower, of equals the later over the earlier."""

    isthing: bool = True

    group: object = None
    """Areas of one picture that have the same, other than None, are one object."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Canvas:
    """The picture that areas lie in."""

    height: int
    width: int
    where: str
    """The file and the picture; starts messages."""

    packed: int
    """Bytes of the file, against which is held what its areas take."""

    def __post_init__(self) -> None:
        self._check(self.height * self.width, f"a picture of {self.width}x{self.height} pixels")

    def outlined(self, outlines: Iterable[NDArray[np.float64]]) -> Rle:
        """The pixels whose centres lie in any of several outlines (corners, 2).

        Raises:
            FileFormatError: If they cross more rows of pixels than a file of this size may.
        """
        canvas, box = np.zeros((0, 0), bool), (0, 0)
        parts = [part for part in (self._filled(one) for one in outlines) if part is not None]
        if len(parts) == 1:
            canvas, box = parts[0]
        elif parts:
            left, top = min(p[1][0] for p in parts), min(p[1][1] for p in parts)
            right = max(x + part.shape[1] for part, (x, _) in parts)
            bottom = max(y + part.shape[0] for part, (_, y) in parts)
            canvas, box = np.zeros((bottom - top, right - left), bool), (left, top)
            for part, (x, y) in parts:
                height, width = part.shape
                canvas[y - top : y - top + height, x - left : x - left + width] |= part
        return self.boxed(canvas, *box)

    def boxed(self, inside: Bool2, left: int, top: int) -> Rle:
        """Run lengths of a mask that is False outside a box of pixels.

        Args:
            inside: The mask in the box (rows, columns).
            left: First column of the box.
            top: Its first row.

        Raises:
            FileFormatError: If the box does not lie in the picture.
        """
        rows, columns = inside.shape
        inside_it = min(left, top) >= 0
        inside_it = inside_it and left + columns <= self.width and top + rows <= self.height
        got = f"one of {columns}x{rows} at ({quoted(left)}, {quoted(top)})"
        expect(inside_it, self.where, f"masks within {self.width}x{self.height} pixels, got {got}")
        padded = np.zeros((columns, rows + 2), np.int8)
        padded[:, 1:-1] = inside.T
        steps = np.diff(padded, axis=1)
        firsts, lasts = (
            (column + left) * self.height + row + top
            for column, row in (np.nonzero(steps == step) for step in (1, -1))
        )
        # A run that ends at the bottom row goes on where the next one begins at the top.
        joined = firsts[1:] == lasts[:-1]
        begins = firsts[np.append(True, ~joined)[: len(firsts)]]
        edges = np.stack((begins, lasts[np.append(~joined, True)[: len(lasts)]]), 1)
        counts = np.diff(np.concatenate(([0], edges.ravel(), [self.height * self.width])))
        counts = counts[:-1] if len(counts) > 1 and counts[-1] == 0 else counts
        return Rle(height=self.height, width=self.width, counts=counts.astype(np.uint32))

    def _filled(self, corners: NDArray[np.float64]) -> tuple[Bool2, tuple[int, int]] | None:
        """The inside of one outline in its box, and the box's first column and row."""
        x0, y0 = corners.T
        x1, y1 = np.roll(corners, -1, axis=0).T
        # The rows whose centres lie in [lower end, upper end) of each edge.
        first, last = (
            np.clip(np.ceil(end(y0, y1) - 0.5), 0, self.height).astype(np.int64)
            for end in (np.minimum, np.maximum)
        )
        crossed = last - first
        total = int(crossed.sum())
        self._check(
            total * _BYTES_OF_CROSSING // _BYTES_OF_PIXEL, f"outlines that cross {total} rows"
        )
        if not total:
            return None
        edge = np.repeat(np.arange(len(crossed)), crossed)
        row = np.arange(total) - np.repeat(np.cumsum(crossed) - crossed, crossed) + first[edge]
        slope = (x1[edge] - x0[edge]) / (y1[edge] - y0[edge])
        at = x0[edge] + (row + 0.5 - y0[edge]) * slope
        column = np.clip(np.ceil(at - 0.5), 0, self.width).astype(np.int64)
        left, right, top, bottom = column.min(), column.max(), row.min(), row.max() + 1
        if left == right:
            return None
        wide = int(right - left) + 1
        cells = (row - top) * wide + column - left
        crossings = np.bincount(cells, minlength=int(bottom - top) * wide) & 1
        odd = np.bitwise_xor.accumulate(crossings.astype(np.uint8).reshape(-1, wide), axis=1)
        return odd[:, :-1].astype(bool), (int(left), int(top))

    def _check(self, pixels: int, what: str) -> None:
        check_unpacked(self.where, pixels * _BYTES_OF_PIXEL, packed=self.packed, what=what)


def corners_of(
    numbers: Sequence[float] | NDArray[np.float64] | None, *, where: str
) -> NDArray[np.float64]:
    """Corners (n, 2) of an outline: x, y, x, y, ...; None is no numbers.

    Raises:
        FileFormatError: If there are fewer than three corners, or one is not finite.
    """
    what = "an outline of at least three corners, two finite numbers each, got "
    if numbers is None:
        raise malformed(where, f"{what}other words")
    few = len(numbers) < 6 or len(numbers) % 2
    expect(not few, where, f"{what}{len(numbers)} numbers")
    corners = np.array(numbers, np.float64).reshape(-1, 2)
    expect((np.abs(corners) <= MAX_NUMBER).all(), where, f"{what}others")
    return corners


def merged(regions: Iterable[Region]) -> list[Region]:
    """Regions in the order of their layers, those of one group made one where the first was."""
    found: list[Region] = []
    places: dict[object, int] = {}
    for region in regions:
        place = places.setdefault(region.group, len(found)) if region.group is not None else None
        if place is None or place == len(found):
            found.append(region)
            continue
        first = found[place]
        both = first.mask.decode() | region.mask.decode()
        found[place] = Region(
            mask=Rle.encode(both), category=first.category, score=max(first.score, region.score),
            order=max(first.order, region.order), isthing=first.isthing, group=first.group,
        )  # fmt: skip
    return sorted(found, key=lambda region: region.order)
