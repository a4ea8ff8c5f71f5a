"""Masses of the segments of many views, kept for the views that see most of each Gaussian.

Entries are 8 bytes each while they come in and are never sorted: which views count for a Gaussian
depends on what each view sees of it alone, and that is one number a Gaussian and view however many
masks lie over its pixels.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

_FEW = 1 << 22
"""Entries that are kept without a thought."""

_CELLS = 1 << 22
"""Gaussians x views that are compared at a time."""


class SegmentEntries:
    """Entries in the order of views, segments and Gaussians.

    Args:
        gaussians: Number of Gaussians.
        max_views: Views kept of each Gaussian, those that see most of it; the earlier among equals.
    """

    def __init__(self, gaussians: int, max_views: int) -> None:
        self._max_views = max_views
        self._gaussian, self._mass = _Column(np.int32), _Column(np.float32)
        self._views: list[_View] = []
        self._limit = _FEW
        self._cut = np.zeros(gaussians, np.float32)
        self._last = np.full(gaussians, -1, np.int32)

    def __len__(self) -> int:
        return len(self._mass)

    def add(
        self,
        counts: NDArray[np.int64],
        gaussian: NDArray[np.int32],
        mass: NDArray[np.float32],
        seen: NDArray[np.float32],
    ) -> None:
        """Add the next view.

        Args:
            counts: Entries of each of its segments.
            gaussian: Their Gaussians, segment by segment.
            mass: Their masses.
            seen: What the view sees of every Gaussian, (gaussians,), above 0 for those given.
        """
        is_seen = np.zeros(len(seen), bool)
        is_seen[gaussian] = True
        known = np.flatnonzero(is_seen).astype(np.int32)
        self._gaussian.append(gaussian)
        self._mass.append(mass)
        self._views.append(_View(counts, known, seen[known]))
        if len(self._mass) > self._limit:
            self._trim()
            self._limit = max(_FEW, 2 * len(self._mass))

    def result(self) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
        """Gaussian, segment (counted through all views), mass, and what its view sees."""
        self._trim()
        counts = np.concatenate([np.zeros(0, np.int64), *(view.counts for view in self._views)])
        gaussian = self._gaussian.take()
        seen = np.empty(len(gaussian), np.float32)
        of_view = np.zeros(len(self._cut), np.float32)
        for view, entries in self._slices():
            of_view[view.gaussian] = view.seen
            seen[entries] = of_view[gaussian[entries]]
        segment = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
        return gaussian, segment, self._mass.take(), seen

    def _slices(self) -> Iterator[tuple["_View", slice]]:
        start = 0
        for view in self._views:
            stop = start + int(view.counts.sum())
            yield view, slice(start, stop)
            start = stop

    def _trim(self) -> None:
        """Drop what is beyond the views that count, in place, one view after the other."""
        if len(self._views) <= self._max_views:
            return
        self._find_cuts()
        kept = np.zeros(len(self._cut), bool)
        end = 0
        for index, (view, entries) in enumerate(list(self._slices())):
            cut = self._cut[view.gaussian]
            stays = view.seen > cut
            stays |= (view.seen == cut) & (index <= self._last[view.gaussian])
            kept[view.gaussian] = stays
            # A copy: what is written may overlap with it.
            chosen = np.flatnonzero(kept[self._gaussian.values[entries]])
            counts = np.diff(np.searchsorted(chosen, np.cumsum(np.append(0, view.counts))))
            for column in (self._gaussian, self._mass):
                column.values[end : end + len(chosen)] = column.values[entries][chosen]
            end += len(chosen)
            self._views[index] = _View(counts, view.gaussian[stays], view.seen[stays])
        self._gaussian.shorten(end)
        self._mass.shorten(end)

    def _find_cuts(self) -> None:
        """Of each Gaussian with too many views: least sight that counts, last view that has it."""
        views, most = len(self._views), self._max_views
        block = max(1, _CELLS // views)
        for start in range(0, len(self._cut), block):
            stop = min(start + block, len(self._cut))
            seen = np.zeros((stop - start, views), np.float32)
            for index, view in enumerate(self._views):
                first, last = np.searchsorted(view.gaussian, (start, stop))
                seen[view.gaussian[first:last] - start, index] = view.seen[first:last]
            many = np.flatnonzero(np.count_nonzero(seen, axis=1) > most)
            seen = seen[many]
            cut = np.partition(seen, views - most, axis=1)[:, views - most]
            left = most - np.count_nonzero(seen > cut[:, None], axis=1)
            ties = np.cumsum(seen == cut[:, None], axis=1, dtype=np.int32)
            self._cut[start + many] = cut
            self._last[start + many] = np.argmax(ties >= left[:, None], axis=1)


class _View:
    """What is kept of one view."""

    __slots__ = ("counts", "gaussian", "seen")

    def __init__(
        self, counts: NDArray[Any], gaussian: NDArray[np.int32], seen: NDArray[np.float32]
    ) -> None:
        self.counts = counts
        """Entries of each segment."""
        self.gaussian = gaussian
        """Gaussians with an entry, ascending."""
        self.seen = seen
        """What the view sees of each of them."""


class _Column:
    """An array that grows where it is, which for large ones the system does without a copy."""

    def __init__(self, dtype: Any) -> None:
        self.values: NDArray[Any] = np.zeros(0, dtype)
        self._length = 0

    def __len__(self) -> int:
        return self._length

    def append(self, values: NDArray[Any]) -> None:
        end = self._length + len(values)
        if end > len(self.values):
            self.values.resize(end + end // 8, refcheck=False)
        self.values[self._length : end] = values
        self._length = end

    def shorten(self, length: int) -> None:
        self._length = length

    def take(self) -> NDArray[Any]:
        """The values, which are then the caller's."""
        self.values.resize(self._length, refcheck=False)
        return self.values
