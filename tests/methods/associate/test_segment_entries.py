"""Masses of segments of many views, against sorting all of them."""

import numpy as np
import pytest

from splatseg.methods.associate import _table as module
from splatseg.methods.associate._table import SegmentEntries

GAUSSIANS = 60


def made(rng, views: int):
    """Views of a few segments each; what they see of a Gaussian is often the same."""
    for _ in range(views):
        segments = int(rng.integers(0, 6))
        inside = rng.random((segments, GAUSSIANS)) < 0.4
        counts = inside.sum(axis=1)
        gaussian = np.nonzero(inside)[1].astype(np.int32)
        mass = rng.random(len(gaussian)).astype(np.float32)
        seen = rng.integers(1, 6, GAUSSIANS).astype(np.float32)
        yield counts, gaussian, mass, seen


def best(views, max_views: int):
    """Entries of each Gaussian's views with most of it, the earlier among equals."""
    rows, start = [], 0
    for index, (counts, gaussian, mass, seen) in enumerate(views):
        segment = np.repeat(np.arange(start, start + len(counts)), counts)
        start += len(counts)
        rows += [(g, s, m, seen[g], index) for g, s, m in zip(gaussian, segment, mass, strict=True)]
    chosen = {}
    for g in range(GAUSSIANS):
        visibility_of_masks = {(-row[3], row[4]) for row in rows if row[0] == g}
        chosen[g] = {index for _, index in sorted(visibility_of_masks)[:max_views]}
    return [row[:4] for row in rows if row[4] in chosen[row[0]]]


@pytest.mark.parametrize("few", [1, 300, 1 << 22])
@pytest.mark.parametrize("max_views", [1, 3, 12, 100])
def test_views_that_see_most_are_kept(rng, monkeypatch, few, max_views) -> None:
    """Whether they are chosen once, or again and again while views come in."""
    monkeypatch.setattr(module, "_FEW", few)
    monkeypatch.setattr(module, "_CELLS", 200)
    views = list(made(rng, 20))
    kept = SegmentEntries(GAUSSIANS, max_views)
    for view in views:
        kept.add(*view)
    found = [tuple(row) for row in zip(*kept.result(), strict=True)]
    assert found == best(views, max_views)


def test_entries_are_dropped_while_views_come_in(rng, monkeypatch) -> None:
    """What is held at any time is twice what counts, whatever the number of masks a pixel."""
    monkeypatch.setattr(module, "_FEW", 1)
    views = list(made(rng, 200))
    largest = max(len(view[1]) for view in views)
    kept = SegmentEntries(GAUSSIANS, 2)
    most = 0
    for view in views:
        kept.add(*view)
        most = max(most, len(kept))
    assert most <= 2 * 2 * GAUSSIANS * 5 + largest
    assert sum(len(view[1]) for view in views) > 3 * most


def test_nothing_is_nothing() -> None:
    kept = SegmentEntries(4, 3)
    kept.add(np.zeros(0, np.int64), *(np.zeros(n, t) for n, t in ((0, "i4"), (0, "f4"), (4, "f4"))))
    assert [len(column) for column in kept.result()] == [0, 0, 0, 0]
