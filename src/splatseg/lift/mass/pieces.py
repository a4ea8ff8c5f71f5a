"""The pixels of a view divided into pieces that lie in the same segments.

Masks that are nested or overlap share most of their pixels. What is summed over pixels is summed
over every piece once, and a segment is the sum of its pieces: the pixels are read once, however
many segments they lie in.

Where many large masks lie over each other, pieces go with the square of the masks until each pixel
is one, and each lies in many masks: what is saved is lost again. Masks are taken in runs that cover
the image some times over, each with pieces of its own, so that the work goes with the masks.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg.core import UNLABELLED, LabelMap, MaskSet

_LAYERS = 12
"""Masks that lie over a pixel of the image, on average, from which on a run of masks ends. Of 64 to
128 discs of a fifth of an image each the pieces cost least a mask."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pieces:
    """A partition of the pixels, and which segments each piece lies in."""

    segment_ids: NDArray[np.int64]
    """(segments,): id of a label map, or index of a mask in its set."""

    piece: NDArray[np.int32]
    """(pixels,): the piece of each pixel, row by row; pixels in no segment have one too."""

    weight: NDArray[np.float32] | None
    """(pixels,): what each pixel counts, or None where all count 1."""

    segments: Any
    """Sparse (segments, pieces): 1 where a piece lies in a segment."""

    @property
    def covered(self) -> NDArray[np.bool_]:
        """(pieces,): whether a piece lies in some segment."""
        return np.bincount(self.segments.indices, minlength=self.segments.shape[1]) > 0


def pieces_of(segments: LabelMap | MaskSet) -> tuple[Pieces, ...]:
    """The pieces of a label map, which are its segments, or of each run of masks."""
    import scipy.sparse

    if isinstance(segments, MaskSet):
        return tuple(_mask_pieces(segments, run) for run in _runs(segments))
    ids = segments.ids.cpu().reshape(-1).numpy()
    ids_found, piece = np.unique(ids, return_inverse=True)
    confidence = segments.confidence
    identity: Any = scipy.sparse.identity(len(ids_found), "f4", format="csr")
    known = np.flatnonzero(ids_found != UNLABELLED)
    pieces = Pieces(
        segment_ids=ids_found[known].astype(np.int64),
        piece=piece.reshape(-1).astype(np.int32),
        weight=None if confidence is None else confidence.cpu().float().reshape(-1).numpy(),
        segments=identity[known],
    )
    return (pieces,)


def covered_pieces(runs: Sequence[Pieces]) -> Pieces:
    """What lies in no segment of some runs, piece 0, and what lies in any, piece 1."""
    import scipy.sparse

    inside = np.zeros(len(runs[0].piece), bool)
    for pieces in runs:
        inside |= pieces.covered[pieces.piece]
    union: Any = scipy.sparse.csr_matrix(np.array([[0, 1]], np.float32))
    return Pieces(
        segment_ids=np.zeros(1, np.int64),
        piece=inside.astype(np.int32),
        weight=runs[0].weight,
        segments=union,
    )


def _runs(masks: MaskSet) -> list[range]:
    """Indices of masks that cover the image `_LAYERS` times together; one run at least."""
    areas = np.cumsum([0, *(mask.area for mask in masks.masks)])
    layer = areas[:-1] // (_LAYERS * max(1, masks.height * masks.width))
    starts = np.flatnonzero(np.diff(layer, prepend=-1)).tolist() or [0]
    return [range(a, b) for a, b in pairwise([*starts, len(masks)])]


def _mask_pieces(masks: MaskSet, run: range) -> Pieces:
    import scipy.sparse

    pixels = [_pixels_of(masks, i) for i in run]
    piece = refined(pixels, masks.height * masks.width)
    count = int(piece.max(initial=-1)) + 1
    # Any one pixel of a piece shows which masks all of it lies in.
    first = np.zeros(count, np.int64)
    first[piece[::-1]] = np.arange(len(piece))[::-1]
    is_first = np.zeros(len(piece), bool)
    is_first[first] = True
    within = [piece[part[is_first[part]]] for part in pixels]
    indptr = np.cumsum([0, *map(len, within)])
    columns = np.concatenate([np.zeros(0, np.int32), *within])
    membership: Any = scipy.sparse.csr_matrix(
        (np.ones(len(columns), np.float32), columns, indptr), shape=(len(run), count)
    )
    return Pieces(
        segment_ids=np.array(run, np.int64), piece=piece, weight=None, segments=membership
    )


def refined(sets: Sequence[NDArray[np.int64]], count: int) -> NDArray[np.int32]:
    """Numbers of the coarsest partition of `count` items that no set of items divides.

    One set after the other, what it holds of a part becomes a part of its own: each item is
    touched once for each set that it is in.

    Args:
        sets: The items of each set, each once.
        count: Number of items.
    """
    part = np.zeros(count, np.int32)
    used = 1
    number_of = np.zeros(max(1024, count), np.int32)
    hit = np.zeros(len(number_of), bool)
    for items in sets:
        before = part[items]
        hit[before] = True
        parts = np.flatnonzero(hit[:used])
        hit[parts] = False
        number_of[parts] = np.arange(used, used + len(parts), dtype=np.int32)
        part[items] = number_of[before]
        used += len(parts)
        if used > len(number_of) // 2:
            part, used = _renumbered(part, used)
            if used > len(number_of) // 4:
                number_of = np.zeros(4 * used, np.int32)
                hit = np.zeros(4 * used, bool)
    return _renumbered(part, used)[0]


def _renumbered(part: NDArray[np.int32], used: int) -> tuple[NDArray[np.int32], int]:
    """Parts numbered without gaps in the order of their numbers, and how many there are."""
    used_numbers = np.zeros(used, bool)
    used_numbers[part] = True
    rank = np.cumsum(used_numbers, dtype=np.int32) - 1
    return rank[part], int(used_numbers.sum())


def _pixels_of(segments: MaskSet, index: int) -> NDArray[np.int64]:
    """The pixels of a mask counted along the rows; run lengths go down the columns."""
    height, width = segments.height, segments.width
    counts = segments.masks[index].counts
    lengths = counts[1::2].astype(np.int64)
    starts = np.cumsum(counts, dtype=np.int64)[1::2] - lengths
    before = np.cumsum(lengths) - lengths
    down = np.arange(int(lengths.sum())) + np.repeat(starts - before, lengths)
    return down % height * width + down // height
