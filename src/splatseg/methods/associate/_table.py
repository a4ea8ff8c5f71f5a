"""Segments of all views, and how much of each Gaussian each of them holds.

Views are taken in the order of their names and segments in that of their first pixels, so that
neither the order in which views come nor what their segments are called has any influence. Masses
are kept for the views that see most of each Gaussian.

Entries are 8 bytes each while they come in and are never sorted: which views count for a Gaussian
depends on what each view sees of it alone, and that is one number a Gaussian and view however many
masks lie over its pixels.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from splatseg.core import LOCAL, Executor, Gaussians, SegmentSource, View
from splatseg.errors import InputError
from splatseg.lift.voting.segment_masses import entries_of, sparse_product
from splatseg.methods.associate._clustering import Agreement, shared_masses
from splatseg.methods.associate._view_entries import MIN_MASS, Collecting, view_entries

MAX_VIEWS = 50
"""Views of each Gaussian that are compared, those that see most of it; bounds memory and time."""

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
        self._gaussian.length = self._mass.length = end

    def _find_cuts(self) -> None:
        """Of each Gaussian with too many views: what counts at least, last view that shows it."""
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


class _View(NamedTuple):
    """What is kept of one view."""

    counts: NDArray[Any]
    """Entries of each segment."""

    gaussian: NDArray[np.int32]
    """Gaussians with an entry, ascending."""

    seen: NDArray[np.float32]
    """What the view sees of each of them."""


class _Column:
    """An array that grows where it is, which for large ones the system does without a copy."""

    def __init__(self, dtype: Any) -> None:
        self.values: NDArray[Any] = np.zeros(0, dtype)
        self.length = 0

    def __len__(self) -> int:
        return self.length

    def append(self, values: NDArray[Any]) -> None:
        end = self.length + len(values)
        if end > len(self.values):
            self.values.resize(end + end // 8, refcheck=False)
        self.values[self.length : end] = values
        self.length = end

    def take(self) -> NDArray[Any]:
        """The values, which are then the caller's."""
        self.values.resize(self.length, refcheck=False)
        return self.values


_MIN_WEIGHT = 0.05
"""A view that sees less of a Gaussian than so many pixels says nothing about it."""

_MIN_SHARE = 0.1
"""A segment that holds less than this share of what a view sees of a Gaussian only touches it."""

_PAIRS = 4e9
"""Products of pairs of entries at most: about a minute. A sample of Gaussians does beyond it."""

_ENTRIES = 1 << 22
"""Entries of the table that are looked at at a time."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SegmentTable:
    """Nonzero masses of all segments, sorted by view, segment and Gaussian."""

    gaussians: int
    gaussian: NDArray[np.int32]
    """(entries,): row of the Gaussian."""

    segment: NDArray[np.int32]
    """(entries,): row of the segment."""

    mass: NDArray[np.float32]
    """(entries,): blending weight of the Gaussian over the segment's pixels."""

    seen: NDArray[np.float32]
    """(entries,): blending weight of the Gaussian over all of the view's pixels that tell."""

    views: tuple[str, ...]
    """Names, sorted."""

    view: NDArray[np.int64]
    """(segments,): place of the view of each segment."""

    name: NDArray[np.int64]
    """(segments,): id in its label map, or place in its set of masks."""

    size: NDArray[np.float64]
    """(segments,): mass of each segment over all Gaussians."""

    category: NDArray[np.int64]
    """(segments,): category, -1 where it is not known."""

    score: NDArray[np.float64]
    """(segments,): how sure the model was, in [0, 1]."""

    level: NDArray[np.int64]
    """(segments,): granularity that the model gave, 0 the finest; all 0 where it gives none."""

    objectness: NDArray[np.float64]
    """(segments,): `MaskSet.objectness`; NaN where the model gave none."""

    covered: NDArray[np.float32]
    """(Gaussians,): share of what all views see of each Gaussian that lies in some segment; 1
    where pixels in no segment tell nothing, and for what no view sees."""

    def votes(self, group: NDArray[np.int64]) -> Any:
        """Sparse (Gaussians, groups): mass by group; segments of group -1 have no vote."""
        return self.masses(group).T.tocsr()

    def masses(self, group: NDArray[np.int64]) -> Any:
        """Sparse (groups, Gaussians): what `votes` says, by group."""
        import scipy.sparse

        there = np.flatnonzero(group >= 0)
        join: Any = scipy.sparse.csr_matrix(
            (np.ones(len(there)), (group[there], there)),
            shape=(int(group.max(initial=-1)) + 1, len(group)),
        )
        rows = self._starts(), self.gaussian, self.mass
        return sparse_product(join, rows, self.gaussians)

    def visibility(self) -> Any:
        """Sparse (Gaussians, views): the square root of what each view sees of each Gaussian."""
        import scipy.sparse

        bounds = self._starts()[np.searchsorted(self.view, np.arange(len(self.views) + 1))]
        seen = np.zeros(self.gaussians, np.float32)
        found: list[tuple[NDArray[np.int32], NDArray[np.float32]]] = []
        for start, stop in pairwise(bounds.tolist()):
            # Segments of one view repeat what that view sees of a Gaussian; it is wanted once.
            seen[:] = 0
            seen[self.gaussian[start:stop]] = self.seen[start:stop]
            known = np.flatnonzero(seen > _MIN_WEIGHT).astype(np.int32)
            found.append((known, np.sqrt(seen[known])))
        return scipy.sparse.csc_matrix(
            (
                np.concatenate([np.zeros(0, np.float32), *(values for _, values in found)]),
                np.concatenate([np.zeros(0, np.int32), *(known for known, _ in found)]),
                np.cumsum([0, *(len(known) for known, _ in found)]),
            ),
            shape=(self.gaussians, len(self.views)),
        )

    def agreement(self) -> Agreement:
        """What the segments share on the Gaussians that their views both see.

        A Gaussian counts with the geometric mean of what the two views see of it. Where many
        segments share many Gaussians, a sample of them speaks for all (`_sample`). Pairs that
        share next to nothing are left out.
        """
        held = np.zeros(self.gaussians, np.int64)
        for entries in self.slices():
            holds, _ = self._shares(entries)
            held += np.bincount(self.gaussian[entries][holds], minlength=self.gaussians)
        worth = self._sample(held)
        masses = self._weighted_masses(held, worth)
        seen = sparse_product(masses, entries_of(self._weighted_visibility(worth)), len(self.views))
        return Agreement(shared=shared_masses(masses), seen=seen, view=self.view)

    def _weighted_visibility(self, worth: NDArray[np.float64]) -> Any:
        """Sparse (Gaussians, views): visibility times the root of worth, where there is any."""
        visibility = self.visibility().tocsr()
        kept = np.repeat(worth > 0, np.diff(visibility.indptr))
        ends = np.append(0, np.cumsum(np.where(worth > 0, np.diff(visibility.indptr), 0)))
        root = np.repeat(np.sqrt(worth), np.diff(ends))
        return type(visibility)(
            (root * visibility.data[kept], visibility.indices[kept], ends), visibility.shape
        )

    def _weighted_masses(self, held: NDArray[np.int64], worth: NDArray[np.float64]) -> Any:
        """Sparse (segments, Gaussians): shares times the root of what the view sees and of worth.

        Args:
            held: Segments that hold each Gaussian.
            worth: What each Gaussian counts; those of 0 are left out.
        """
        import scipy.sparse

        size = int(held[worth > 0].sum())
        values, columns = np.empty(size, np.float32), np.empty(size, np.int32)
        counts = np.zeros(len(self.view), np.int64)
        root_worth = np.sqrt(worth, dtype=np.float32)
        end = 0
        for entries in self.slices():
            holds, share = self._shares(entries)
            gaussian = self.gaussian[entries]
            chosen = np.flatnonzero(holds & (worth[gaussian] > 0))
            gaussian = gaussian[chosen]
            root = np.sqrt(self.seen[entries][chosen], dtype=np.float32) * root_worth[gaussian]
            values[end : end + len(chosen)] = root * share[chosen]
            columns[end : end + len(chosen)] = gaussian
            counts += np.bincount(self.segment[entries][chosen], minlength=len(counts))
            end += len(chosen)
        shape = (len(counts), self.gaussians)
        return scipy.sparse.csr_matrix((values, columns, np.append(0, np.cumsum(counts))), shape)

    def _shares(self, entries: slice) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
        """Which entries are more than a touch, and each one's share of what its view sees."""
        seen = self.seen[entries]
        least = np.maximum(seen, MIN_MASS)
        share: NDArray[np.float32] = np.divide(self.mass[entries], least, dtype=np.float32)
        return (seen > _MIN_WEIGHT) & (share > _MIN_SHARE), share

    def slices(self) -> Iterator[slice]:
        """All entries, a few at a time."""
        for start in range(0, len(self.gaussian), _ENTRIES):
            yield slice(start, start + _ENTRIES)

    def _starts(self) -> NDArray[np.int64]:
        """Where the entries of each segment begin, and where those of the last one end."""
        # Of the entries' own type: of another one numpy would convert all entries first.
        segments = np.arange(len(self.view) + 1, dtype=self.segment.dtype)
        return np.searchsorted(self.segment, segments).astype(np.int64)

    def _sample(self, entries: NDArray[np.int64]) -> NDArray[np.float64]:
        """What each Gaussian counts, 0 for those left out, so that the pairs are affordable.

        All count 1 as long as there are few pairs. Beyond that Gaussians are taken with a
        probability that goes with what is seen of them, in even steps through their order, and
        count for what they stand for (Horvitz and Thompson 1952): sums stay what they were in
        expectation, and nothing is random.
        """
        pairs = entries.astype(np.float64) ** 2
        worth = np.ones(self.gaussians)
        if pairs.sum() <= _PAIRS:
            return worth
        size = np.zeros(self.gaussians)
        for part in self.slices():
            size += np.bincount(self.gaussian[part], self.seen[part], minlength=self.gaussians)
        low, high = 0.0, float(1 / max(size[size > 0].min(), 1e-9))
        for _ in range(60):
            middle = (low + high) / 2
            if (np.minimum(1, middle * size) * pairs).sum() > _PAIRS:
                high = middle
            else:
                low = middle
        chance = np.minimum(1, low * size)
        steps = np.floor(np.cumsum(chance) + 0.5)
        taken = np.diff(steps, prepend=0.0) > 0
        return np.where(taken, 1 / np.maximum(chance, 1e-12), 0.0)


def segment_table(
    gaussians: Gaussians,
    views: Sequence[View],
    source: SegmentSource,
    *,
    longest_side: int,
    backend: str = "auto",
    executor: Executor = LOCAL,
    progress: Callable[[int, int], None] | None = None,
) -> SegmentTable:
    """Collect the segments of views.

    Args:
        gaussians: The Gaussians of the scene.
        views: Those whose segments count.
        source: Their segments.
        longest_side: Larger segments are read at so many pixels along their longest side. Masses
            stay in pixels of the segments as they came.
        backend: Name of the rendering backend.
        executor: Where the views are worked on; the table does not depend on it.
        progress: Called with the views done and their number.

    Raises:
        InputError: If there are no views, if one has no segments, or none has any.
        ShapeError: If segments do not have their photograph's proportions.
    """
    known = set(source.view_names)
    for view in views:
        if view.name not in known:
            raise InputError(f"evidence: there are no segments of view {view.name!r}.")
    ordered = sorted(views, key=lambda view: view.name)
    entries = SegmentEntries(len(gaussians), MAX_VIEWS)
    rows: list[tuple[int, int, int, float, int, float]] = []
    covered, visible = np.zeros((2, len(gaussians)))
    collecting = Collecting(
        gaussians=gaussians, source=source, longest_side=longest_side, backend=backend
    )
    with closing(executor.map(view_entries, ordered, shared=collecting)) as found:
        for place, view in enumerate(found):
            rows += [(place, *row) for row in view.rows]
            entries.add(view.counts, view.gaussian, view.mass, view.seen)
            covered += view.covered
            visible += view.visible
            if progress is not None:
                progress(place + 1, len(ordered))
    if not rows:
        raise InputError(f"evidence: expected a segment in {len(views)} views, found none.")
    view_of, name_of, category, score, level, objectness = (
        np.array(column) for column in zip(*rows, strict=True)
    )
    gaussian, segment, mass, seen = entries.result()
    starts = np.searchsorted(segment, np.arange(len(rows) + 1)).tolist()
    size = [float(mass[a:b].sum(dtype=np.float64)) for a, b in pairwise(starts)]
    return SegmentTable(
        gaussians=len(gaussians),
        gaussian=gaussian,
        segment=segment,
        mass=mass,
        seen=seen,
        views=tuple(view.name for view in ordered),
        view=view_of.astype(np.int64),
        name=name_of.astype(np.int64),
        size=np.array(size),
        category=category.astype(np.int64),
        score=score.astype(np.float64),
        level=level.astype(np.int64),
        objectness=objectness.astype(np.float64),
        covered=_shares_of(covered, visible),
    )


def _shares_of(covered: NDArray[np.float64], visible: NDArray[np.float64]) -> NDArray[np.float32]:
    """Shares of what is visible; 1 where next to nothing is."""
    shares = np.where(visible > _MIN_WEIGHT, covered / np.maximum(visible, _MIN_WEIGHT), 1.0)
    return shares.clip(0, 1).astype(np.float32)
