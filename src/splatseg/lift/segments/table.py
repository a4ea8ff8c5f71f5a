"""Segments of all views, and how much of each Gaussian each of them holds.

Views are taken in the order of their names and segments in that of their first pixels, so that
neither the order in which views come nor what their segments are called has any influence.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import (
    UNLABELLED,
    Gaussians,
    LabelMap,
    MaskSet,
    Rle,
    SegmentSource,
    View,
    camera_of_map,
)
from splatseg.errors import InputError
from splatseg.lift.mass.segment_masses import view_masses
from splatseg.lift.segments.clustering import Agreement
from splatseg.render import RenderOptions

_LEAST_WEIGHT = 0.05
"""A view that sees less of a Gaussian than so many pixels says nothing about it."""

_LEAST_SHARE = 0.1
"""A segment that holds less than this share of what a view sees of a Gaussian only touches it."""

_LEAST_MASS = 1e-3


_PAIRS = 4e9
"""Products of pairs of entries at most: about a minute. A sample of Gaussians does beyond it."""

_LEAST_ALIKE = 0.05
"""Least cosine of two segments' masses: of two sets one a 400th of the other's size reaches it."""

_BLOCK = 512
"""Segments that are compared with all others at a time."""


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

    def votes(self, group: NDArray[np.int64], weight: NDArray[np.float64]) -> Any:
        """Sparse (Gaussians, groups): mass by group; segments of group -1 have no vote."""
        import scipy.sparse

        of = group[self.segment]
        there = of >= 0
        values = self.mass[there] * weight[self.segment[there]]
        shape = (self.gaussians, int(group.max(initial=-1)) + 1)
        return scipy.sparse.csr_matrix((values, (self.gaussian[there], of[there])), shape=shape)

    def sights(self) -> Any:
        """Sparse (Gaussians, views): the square root of what each view sees of each Gaussian."""
        import scipy.sparse

        told = self.seen > _LEAST_WEIGHT
        # Segments of one view repeat what that view sees of a Gaussian; it is wanted once.
        place = self.view[self.segment[told]] * self.gaussians + self.gaussian[told]
        places, first = np.unique(place, return_index=True)
        return scipy.sparse.csc_matrix(
            (
                np.sqrt(self.seen[told][first]),
                (places % self.gaussians, places // self.gaussians),
            ),
            shape=(self.gaussians, len(self.views)),
        )

    def agreement(self) -> Agreement:
        """What the segments share on the Gaussians that their views both see.

        A Gaussian counts with the geometric mean of what the two views see of it. Where many
        segments share many Gaussians, a sample of them speaks for all (`_sample`). Pairs that
        share next to nothing are left out.
        """
        import scipy.sparse

        told = self.seen > _LEAST_WEIGHT
        share = self.mass / np.maximum(self.seen, _LEAST_MASS)
        root = np.sqrt(self.seen, dtype=np.float32)
        holds = told & (share > _LEAST_SHARE)
        worth = self._sample(np.bincount(self.gaussian[holds], minlength=self.gaussians))
        root *= np.sqrt(worth, dtype=np.float32)[self.gaussian]
        holds &= worth[self.gaussian] > 0
        count = len(self.view)
        masses: Any = scipy.sparse.csr_matrix(
            ((root * share)[holds], (self.gaussian[holds], self.segment[holds])),
            shape=(self.gaussians, count),
        )
        sights = scipy.sparse.diags(np.sqrt(worth)) @ self.sights()
        seen = (masses.T @ sights).tocsr()
        return Agreement(shared=_shared(masses), seen=seen, view=self.view)

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
        size = np.bincount(self.gaussian, self.seen, minlength=self.gaussians)
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


def _shared(masses: Any) -> Any:
    """Products of the columns with each other, without those of nearly nothing, sparse."""
    import scipy.sparse

    turned = masses.T.tocsr()
    length = np.sqrt(np.asarray(turned.multiply(turned).sum(axis=1)).ravel())
    blocks: list[Any] = []
    for start in range(0, turned.shape[0], _BLOCK):
        block = (turned[start : start + _BLOCK] @ masses).tocoo()
        kept = block.data > _LEAST_ALIKE * length[start + block.row] * length[block.col]
        blocks.append(
            scipy.sparse.csr_matrix(
                (block.data[kept], (block.row[kept], block.col[kept])), shape=block.shape
            )
        )
    return scipy.sparse.vstack(blocks).tocsr()


def segment_table(
    gaussians: Gaussians,
    views: Sequence[View],
    source: SegmentSource,
    *,
    most_views: int,
    longest_side: int | None = None,
    render_options: RenderOptions | None = None,
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> SegmentTable:
    """Collect the segments of views.

    Args:
        gaussians: The Gaussians of the scene.
        views: Those whose segments count.
        source: Their segments.
        most_views: Views kept of each Gaussian, those that see most of it: this bounds memory.
        longest_side: Larger segments are read at so many pixels along their longest side; None
            reads all pixels. Masses stay in pixels of the segments as they came.
        render_options: Switches of the blending model.
        backend: Name of the rendering backend.
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
    entries = _Entries(len(gaussians), most_views)
    rows: list[tuple[int, int, int, float]] = []
    for place, view in enumerate(ordered):
        segments = source.segments_of(view.name)
        names, scores = _in_order(segments)
        categories = source.categories_of(view.name)
        camera_of_map(view, segments.height, segments.width)  # refuses other proportions
        if isinstance(segments, LabelMap):
            segments = LabelMap(ids=segments.ids)
        worth = segments.height * segments.width
        if longest_side is not None:
            segments = reduced_segments(segments, longest_side)
        worth /= segments.height * segments.width
        camera = camera_of_map(view, segments.height, segments.width)
        found = view_masses(gaussians, camera, segments, options=render_options, backend=backend)
        row_of = {name: len(rows) + i for i, name in enumerate(names)}
        rows += [
            (place, name, categories.get(name, UNLABELLED), score)
            for name, score in zip(names, scores, strict=True)
        ]
        kept = found.weight > _LEAST_MASS
        used, compact = torch.unique(found.segment[kept], return_inverse=True)
        segment = torch.tensor([row_of[int(i)] for i in used.tolist()])
        gaussian, mass = found.gaussian[kept].numpy(), worth * found.weight[kept].numpy()
        if isinstance(segments, LabelMap):
            # Pixels without a label tell nothing; pixels outside all masks do.
            sight = np.bincount(gaussian, mass, minlength=len(gaussians))
        else:
            sight = worth * found.visible.numpy()
        number = segment[compact].numpy() if len(segment) else np.zeros(0, np.int64)
        entries.add(gaussian, number, mass, sight[gaussian], place)
        if progress is not None:
            progress(place + 1, len(ordered))
    if not rows:
        raise InputError(f"evidence: expected a segment in {len(views)} views, found none.")
    view_of, name_of, category, score = (np.array(column) for column in zip(*rows, strict=True))
    gaussian, segment, mass, seen = entries.result()
    return SegmentTable(
        gaussians=len(gaussians),
        gaussian=gaussian,
        segment=segment,
        mass=mass,
        seen=seen,
        views=tuple(view.name for view in ordered),
        view=view_of.astype(np.int64),
        name=name_of.astype(np.int64),
        size=np.bincount(segment, mass, minlength=len(rows)).astype(np.float64),
        category=category.astype(np.int64),
        score=score.astype(np.float64),
    )


def reduced_segments(segments: LabelMap | MaskSet, longest: int) -> LabelMap | MaskSet:
    """Segments on a coarser grid: each pixel takes what is at its middle."""
    height, width = segments.height, segments.width
    share = longest / max(height, width)
    if share >= 1:
        return segments
    h, w = max(1, round(share * height)), max(1, round(share * width))
    down = ((torch.arange(h) + 0.5) * height / h).long()
    across = ((torch.arange(w) + 0.5) * width / w).long()

    def taken(picture: Tensor) -> Tensor:
        return picture[down.unsqueeze(1), across]

    if isinstance(segments, LabelMap):
        return LabelMap(ids=taken(segments.ids.cpu()))
    masks = tuple(Rle.encode(taken(mask.decode())) for mask in segments.masks)
    return replace(segments, height=h, width=w, masks=masks)


class _Entries:
    """Masses so far: of each Gaussian those in the views that see most of it."""

    def __init__(self, gaussians: int, most_views: int) -> None:
        self._most = most_views
        self._limit = max(2 * most_views * gaussians, 1 << 22)
        self._parts: list[tuple[NDArray[Any], ...]] = []
        self._count = 0

    def add(
        self,
        gaussian: NDArray[Any],
        segment: NDArray[Any],
        mass: NDArray[Any],
        seen: NDArray[Any],
        view: int,
    ) -> None:
        self._parts.append(
            (
                gaussian.astype(np.int32),
                segment.astype(np.int32),
                mass.astype(np.float32),
                seen.astype(np.float32),
                np.full(len(gaussian), view, np.int32),
            )
        )
        self._count += len(gaussian)
        if self._count > self._limit:
            self._parts = [self._best()]
            self._count = len(self._parts[0][0])
            # Where segments overlap, the views kept may hold more than was thought.
            self._limit = max(self._limit, 2 * self._count)

    def result(self) -> tuple[NDArray[Any], ...]:
        return self._best()[:4]

    def _best(self) -> tuple[NDArray[Any], ...]:
        """Entries of each Gaussian's `most_views` views with most of it, by segment."""
        columns = tuple(np.concatenate(column) for column in zip(*self._parts, strict=True))
        gaussian, segment, _, seen, view = columns
        order = np.lexsort((segment, view, -seen, gaussian))
        sorted_gaussian, sorted_view = gaussian[order], view[order]
        new = np.ones(len(order), bool)
        new[1:] = (np.diff(sorted_gaussian) != 0) | (np.diff(sorted_view) != 0)
        run = np.cumsum(new)
        starts = np.flatnonzero(np.diff(sorted_gaussian, prepend=-1))
        first = np.repeat(run[starts], np.diff(np.append(starts, len(order))))
        kept = np.sort(order[run - first < self._most])
        return tuple(column[kept] for column in columns)


def _in_order(segments: LabelMap | MaskSet) -> tuple[list[int], list[float]]:
    """Names of segments by their first pixel, of masks with the same one by area, and scores."""
    if isinstance(segments, MaskSet):
        starts = [
            (_first_pixel(segments, i), mask.area, mask.counts.tobytes(), i)
            for i, mask in enumerate(segments.masks)
        ]
        order = [i for _, area, _, i in sorted(starts) if area > 0]
        return order, [float(segments.scores[i]) for i in order]
    ids = segments.ids.reshape(-1).numpy()
    names, first = np.unique(ids, return_index=True)
    pairs = sorted(
        (int(at), int(name)) for name, at in zip(names, first, strict=True) if name != UNLABELLED
    )
    if segments.confidence is None:
        return [name for _, name in pairs], [1.0] * len(pairs)
    sure = segments.confidence.reshape(-1)
    return [name for _, name in pairs], [float(sure[at]) for at, _ in pairs]


def _first_pixel(segments: MaskSet, index: int) -> int:
    """The first pixel of a mask down the columns; behind all others where it is empty."""
    counts = segments.masks[index].counts
    return int(counts[0]) if len(counts) > 1 else segments.height * segments.width
