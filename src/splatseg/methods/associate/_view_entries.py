"""The segments of one view in order, and how much of each Gaussian each of them holds."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from splatseg.core import (
    UNLABELLED,
    Gaussians,
    LabelMap,
    MaskSet,
    SegmentSource,
    View,
    camera_of_map,
)
from splatseg.lift.segments import reduced_segments
from splatseg.lift.voting.segment_masses import view_masses

MIN_MASS = 1e-3
"""Masses below it are nothing, pixels."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Collecting:
    """What segments of all views are collected with."""

    gaussians: Gaussians
    source: SegmentSource
    longest_side: int
    backend: str


class ViewEntries(NamedTuple):
    """One view's segments in order, and what `SegmentEntries.add` takes of them."""

    rows: list[tuple[int, int, float, int, float]]
    """Name, category, score, granularity and objectness of each."""

    counts: NDArray[np.int64]
    gaussian: NDArray[np.int32]
    mass: NDArray[np.float32]
    seen: NDArray[np.float32]
    covered: NDArray[Any]
    """What of each Gaussian lies in some segment, in pixels of the segments as they came."""

    visible: NDArray[Any]
    """The same of what the view sees."""


def view_entries(collecting: Collecting, view: View) -> Iterator[ViewEntries]:
    """The segments of a view, and their masses.

    Pixels in no segment tell something where they are outside all masks; those without a label do
    not.
    """
    segments = collecting.source.segments_of(view.name)
    names, scores = _in_order(segments)
    categories = collecting.source.categories_of(view.name)
    camera_of_map(view, segments.height, segments.width)  # refuses other proportions
    if isinstance(segments, LabelMap):
        segments = LabelMap(ids=segments.ids)
    # Pixels of the segments as they came in one pixel of the masses.
    worth = segments.height * segments.width
    segments = reduced_segments(segments, collecting.longest_side)
    worth /= segments.height * segments.width
    camera = camera_of_map(view, segments.height, segments.width)
    found = view_masses(collecting.gaussians, camera, segments, backend=collecting.backend)
    segment, gaussian = found.segment.numpy(), found.gaussian.numpy()
    kept = found.weight.numpy() > MIN_MASS
    segment, gaussian = segment[kept], gaussian[kept].astype(np.int32)
    mass = (worth * found.weight.numpy()[kept]).astype(np.float32)
    covered, visible = worth * found.covered.numpy(), worth * found.visible.numpy()
    outside = isinstance(segments, MaskSet)
    seen = visible if outside else np.bincount(gaussian, mass, len(visible))
    bounds = np.searchsorted(segment, names), np.searchsorted(segment, names, side="right")
    runs = [np.arange(first, last) for first, last in zip(*bounds, strict=True)]
    order = np.concatenate([np.zeros(0, np.int64), *runs])
    yield ViewEntries(
        rows=[
            (name, categories.get(name, UNLABELLED), score, *_kind_of(segments, name))
            for name, score in zip(names, scores, strict=True)
        ],
        counts=bounds[1] - bounds[0],
        gaussian=gaussian[order],
        mass=mass[order],
        seen=seen.astype(np.float32),
        covered=covered,
        visible=visible if outside else covered,
    )


def _in_order(segments: LabelMap | MaskSet) -> tuple[list[int], list[float]]:
    """Names of segments by their first pixel, of masks with the same one by area, and scores."""
    if isinstance(segments, MaskSet):
        starts = [
            (
                _first_pixel(segments, i),
                mask.area,
                mask.counts.tobytes(),
                int(segments.levels[i]),
                i,
            )
            for i, mask in enumerate(segments.masks)
        ]
        order = [i for _, area, _, _, i in sorted(starts) if area > 0]
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


def _kind_of(segments: LabelMap | MaskSet, name: int) -> tuple[int, float]:
    """The granularity and the objectness of a mask; segments of label maps have none."""
    if not isinstance(segments, MaskSet):
        return 0, np.nan
    known = segments.objectness
    return int(segments.levels[name]), np.nan if known is None else float(known[name])


def _first_pixel(segments: MaskSet, index: int) -> int:
    """The first pixel of a mask down the columns; behind all others where it is empty."""
    counts = segments.masks[index].counts
    return int(counts[0]) if len(counts) > 1 else segments.height * segments.width
