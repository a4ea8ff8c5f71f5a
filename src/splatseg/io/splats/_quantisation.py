"""Quaternions in 32 bits: the largest component is left out, as it follows from the others.

The top two bits say which component it is (of w, x, y, z in that order), the others follow
in order with ten bits each, first in the highest bits. All are at most 1 / sqrt 2 in
magnitude, as two larger ones cannot be.
"""

import numpy as np
from numpy.typing import NDArray

from splatseg.io.splats._rows import Array

_HALF_ROOT = 0.5**0.5

_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""The components kept, by the index of the one left out."""


def assemble(largest: NDArray[np.integer], others: NDArray[np.floating]) -> NDArray[np.float64]:
    """Quaternions from the index of the largest component and the other three, in order.

    The largest is positive and makes the length 1; where the others are already longer than
    that (in no file written well) it is 0.
    """
    result = np.empty((len(others), 4))
    rest = np.maximum(0.0, 1.0 - np.square(others).sum(axis=1))
    np.put_along_axis(result, largest[:, None].astype(np.intp), np.sqrt(rest)[:, None], axis=1)
    np.put_along_axis(result, _OTHERS[largest], others, axis=1)
    return result


def split(rotations: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """The inverse of `assemble` for unit quaternions; the sign is chosen so that it holds."""
    largest = np.abs(rotations).argmax(axis=1)
    sign = np.sign(np.take_along_axis(rotations, largest[:, None], axis=1))
    others = np.take_along_axis(rotations, _OTHERS[largest], axis=1).astype(np.float64)
    return largest, others * sign


def unpack_smallest_three(packed: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Quaternions (n, 4) from SuperSplat's words: offset binary, 1023 steps."""
    steps = (packed[:, None] >> np.array([20, 10, 0], np.uint32)) & np.uint32(1023)
    return assemble(packed >> np.uint32(30), (steps / 1023 - 0.5) * 2**0.5)


def pack_smallest_three(rotations: NDArray[np.float32]) -> NDArray[np.uint32]:
    """SuperSplat's words (n,) of unit quaternions."""
    largest, others = split(rotations)
    steps = np.floor((others * _HALF_ROOT + 0.5) * 1023 + 0.5)
    words = np.clip(steps, 0, 1023).astype(np.uint32) << np.array([20, 10, 0], np.uint32)
    return words.sum(axis=1, dtype=np.uint32) | (largest.astype(np.uint32) << np.uint32(30))


_XYZW = np.array([1, 2, 3, 0])


def unpack_signed_three(packed: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Quaternions (n, 4) wxyz from SPZ's words: order x, y, z, w; a sign bit and 511 steps."""
    fields = (packed[:, None] >> np.array([20, 10, 0], np.uint32)) & np.uint32(1023)
    size = (fields & np.uint32(511)) * (_HALF_ROOT / 511)
    xyzw = assemble(packed >> np.uint32(30), np.where(fields >> np.uint32(9), -size, size))
    return xyzw[:, [3, 0, 1, 2]]


def pack_signed_three(rotations: NDArray[np.float32]) -> NDArray[np.uint32]:
    """SPZ's words (n,) of unit quaternions wxyz."""
    largest, others = split(rotations[:, _XYZW])
    size = np.minimum(np.floor(np.abs(others) * (511 / _HALF_ROOT) + 0.5), 511).astype(np.uint32)
    fields = size | (others < 0).astype(np.uint32) << np.uint32(9)
    words = fields << np.array([20, 10, 0], np.uint32)
    return words.sum(axis=1, dtype=np.uint32) | (largest.astype(np.uint32) << np.uint32(30))


# Few numbers, and few vectors, that stand for many: scalar and vector quantisation.
#
# Both are Lloyd's iteration (k-means) from a start that is not random, so that the same values
# give the same book.


_ENTRIES = 256
_BINS = 256
_SMOOTHED = 5
"""Bins of the histogram that the start goes by, and how many are averaged: fewer values a bin
than some tens would be noise."""

_SCALAR_ROUNDS = 20
_VECTOR_ROUNDS = 6
_LEAF_ENTRIES = 128
"""About so many entries of a palette are sought at once; more are better and slower."""


def scalar_codebook(values: Array) -> tuple[Array, NDArray[np.uint8]]:
    """256 numbers, ascending, and which of them is nearest to each value.

    Up to 256 different values are kept as they are. Otherwise Lloyd's iteration starts where
    the density of entries goes by the cube root of that of the values, which is the best for
    many entries (Panter and Dite, 1951).

    Args:
        values: Numbers of any shape, finite.

    Returns:
        (256,) float32; indices in the shape of `values`.
    """
    ordered = np.sort(values, axis=None).astype(np.float64)
    different = np.unique(ordered)
    if len(different) <= _ENTRIES:
        book = np.pad(different, (0, _ENTRIES - len(different)), mode="edge")
    else:
        book = _lloyd(ordered, _companded(ordered))
    book = book.astype(np.float32)
    middles = (book[1:].astype(np.float64) + book[:-1]) / 2
    return book, np.searchsorted(middles, values, side="left").astype(np.uint8)


def _companded(ordered: NDArray[np.float64]) -> NDArray[np.float64]:
    """Entries whose density is the cube root of that of the values."""
    counts, edges = np.histogram(ordered, bins=_BINS)
    padded = np.pad(counts.astype(np.float64), _SMOOTHED // 2, mode="edge")
    density = np.convolve(padded, np.full(_SMOOTHED, 1 / _SMOOTHED), mode="valid")
    share = np.cumsum(np.cbrt(density))
    targets = (np.arange(_ENTRIES) + 0.5) / _ENTRIES * share[-1]
    return np.interp(targets, np.concatenate(([0.0], share)), edges)


def _lloyd(ordered: NDArray[np.float64], book: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lloyd's iteration over sorted values: each entry to the mean of those nearest to it."""
    sums = np.concatenate(([0.0], np.cumsum(ordered)))
    for _ in range(_SCALAR_ROUNDS):
        ends = np.searchsorted(ordered, (book[1:] + book[:-1]) / 2)
        ends = np.concatenate(([0], ends, [len(ordered)]))
        counts = np.diff(ends)
        means = np.diff(sums[ends]) / np.maximum(counts, 1)
        book = np.where(counts > 0, means, book)
    return np.sort(book)


def vector_palette(vectors: Array, size: int) -> tuple[Array, NDArray[np.int64]]:
    """At most `size` vectors, and which of them stands for each of many.

    Up to `size` different vectors are kept as they are. Otherwise vectors are halved at the
    median of their widest axis until a part is small, and Lloyd's iteration finds the
    entries of each part.

    Args:
        vectors: (n, d), finite.
        size: Most entries, at least 1.

    Returns:
        (m, d) float32 and (n,) indices into it.
    """
    different, index = np.unique(vectors, axis=0, return_inverse=True)
    index = index.reshape(-1).astype(np.int64)
    if len(different) <= size:
        return different, index
    counts = np.bincount(index).astype(np.float64)
    parts = [np.arange(len(different))]
    while len(parts) * _LEAF_ENTRIES < size:
        parts = [half for part in parts for half in _halves(different, part)]
    # Each part gets entries by its share of the rows, and one at least.
    ends = np.cumsum([counts[part].sum() for part in parts]) / counts.sum()
    steps = np.diff(np.concatenate(([0], np.floor(ends * (size - len(parts)) + 0.5)))).astype(int)
    books: list[Array] = []
    entry_of = np.empty(len(different), np.int64)
    start = 0
    for part, more in zip(parts, steps, strict=True):
        book, nearest = _clustered(different[part], counts[part], min(1 + int(more), len(part)))
        entry_of[part] = start + nearest
        start += len(book)
        books.append(book)
    return np.concatenate(books), entry_of[index]


def _halves(vectors: Array, part: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Rows below and above the median of the axis along which they spread most."""
    if len(part) < 2:
        return [part]
    rows = vectors[part]
    widest = int(rows.var(axis=0, dtype=np.float64).argmax())
    order = np.argsort(rows[:, widest], kind="stable")
    middle = len(part) // 2
    return [part[order[:middle]], part[order[middle:]]]


def _clustered(
    vectors: Array, counts: NDArray[np.float64], size: int
) -> tuple[Array, NDArray[np.int64]]:
    """K-means of different vectors, each of which counts several times."""
    book = vectors[np.linspace(0, len(vectors) - 1, size).astype(np.int64)]
    nearest = np.arange(len(vectors))
    if size == len(vectors):
        return vectors, nearest
    for _ in range(_VECTOR_ROUNDS):
        # The least |v - b|^2 is the largest v b - |b|^2 / 2.
        scores = vectors @ book.T - np.square(book).sum(axis=1) / 2
        nearest = scores.argmax(axis=1)
        weights = np.bincount(nearest, counts, minlength=size)
        order = np.argsort(nearest, kind="stable")
        used = np.flatnonzero(weights > 0)
        starts = np.searchsorted(nearest[order], used)
        sums = np.add.reduceat(vectors[order] * counts[order, None], starts, axis=0)
        book = book.copy()
        book[used] = (sums / weights[used, None]).astype(np.float32)
    return book, nearest
