r"""The similarity that an editor moved a scene, or a part of it, by.

Opacity, mean colour and the ratios of the three scales do not change under a similarity. Edited
rows are paired with the source rows that are nearest in these; the log of the ratio of their
sizes is the log of the similarity's scale, which most right pairs share and wrong ones do not.
Of the pairs that are left, three make a similarity (Umeyama 1991); the one with most inliers is
refined on them (RANSAC).
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import Similarity
from splatseg.lift.attachment.rows import Floats, Indices, Rows, extent_of
from splatseg.neighbours import NeighbourIndex

_SAMPLE = 6000
_TRIPLES = 60_000
_MAX_FITS = 300
_SCALE_WINDOW = 0.12
"""Width in which logs of scale count as one."""
_SCALE_ERROR = 0.04
_INLIER_SHARE = 0.02
"""Share of the source's extent within which a pair agrees with a similarity, at first."""
_QUANTISATION = np.array([0.01, 0.01, 0.01, 0.01, 0.06, 0.06])
"""What opacity, colour and log ratios of scales differ by after quantisation."""
_MIN_PAIRS = 6
_CLEAR_SHARE = 0.5
"""Share of the pairs whose agreement leaves no question whether the scene was mirrored."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Hypothesis:
    """A move that pairs agree with."""

    edited_from_source: Similarity
    mirrored: bool
    pairs: int
    """Number of inliers."""


def find_move(edited: Rows, source: Rows, rng: np.random.Generator) -> Hypothesis | None:
    """The similarity that lays most of some source rows onto edited ones; None if there is none.

    Where no rotation does, a mirrored one is looked for.
    """
    if min(len(edited), len(source)) < 3:
        return None
    edited_index, source_index = _pairs(edited, source, rng)
    if len(edited_index) < 3:
        return None
    target = edited.means[edited_index]
    scale = float(
        np.exp((edited.logs[edited_index] - source.logs[source_index]).mean(axis=1)).mean()
    )
    tolerance = _INLIER_SHARE * scale * extent_of(source)
    best: Hypothesis | None = None
    for mirrored in (False, True):
        origin = source.means[source_index] * (np.array([-1.0, 1.0, 1.0]) if mirrored else 1.0)
        found = _consensus(origin, target, scale, tolerance, rng)
        if found is None:
            continue
        move, pairs = found
        if best is None or pairs > 1.5 * best.pairs:
            best = Hypothesis(edited_from_source=move, mirrored=mirrored, pairs=pairs)
        if pairs >= _CLEAR_SHARE * len(edited_index):
            break
    return best


def fit_similarity(origin: Floats, target: Floats) -> Similarity | None:
    """The least-squares similarity target_from_origin (Umeyama 1991); None of one point."""
    origin_centre, target_centre = origin.mean(axis=0), target.mean(axis=0)
    a, b = origin - origin_centre, target - target_centre
    u, values, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt)) or 1.0])
    rotation = (u * sign) @ vt
    spread = float((a**2).sum())
    scale = float((values * sign).sum()) / spread if spread > 0 else 0.0
    if not 0 < scale < np.inf:
        return None
    return Similarity(
        rotation=torch.from_numpy(rotation),
        translation=torch.from_numpy(target_centre - scale * rotation @ origin_centre),
        scale=scale,
    )


def _pairs(edited: Rows, source: Rows, rng: np.random.Generator) -> tuple[Indices, Indices]:
    """Edited rows and the source rows like them, of the one change of size that most have."""
    rows = np.arange(len(edited))
    if len(rows) > _SAMPLE:
        rows = np.sort(rng.permutation(len(rows))[:_SAMPLE])
    index = NeighbourIndex(torch.from_numpy(_descriptors(source)))
    nearest = index.nearest(torch.from_numpy(_descriptors(edited[rows])), 1)
    found = nearest.indices[:, 0].numpy()
    logs = (edited.logs[rows] - source.logs[found]).mean(axis=1)
    order = np.sort(logs)
    count = np.searchsorted(order, order + _SCALE_WINDOW, side="right") - np.arange(len(order))
    start = order[int(count.argmax())]
    keep = (logs >= start) & (logs <= start + _SCALE_WINDOW)
    return rows[keep], found[keep]


def _descriptors(rows: Rows) -> Floats:
    ratios = np.diff(rows.logs, axis=1)
    return np.concatenate((rows.opacities[:, None], rows.colours, ratios), axis=1) / _QUANTISATION


def _consensus(
    origin: Floats, target: Floats, scale: float, tolerance: float, rng: np.random.Generator
) -> tuple[Similarity, int] | None:
    """The similarity of three pairs with which most pairs agree, refined on those."""
    triples = rng.integers(0, len(origin), (_TRIPLES, 3))
    origin_sides = _side_lengths(origin, triples) * scale
    target_sides = _side_lengths(target, triples)
    longest = origin_sides.max(axis=1)
    error = np.abs(origin_sides - target_sides).max(axis=1)
    well_spread = (origin_sides.min(axis=1) > 0) & (longest > tolerance)
    good = triples[well_spread & (error <= np.maximum(_SCALE_ERROR * longest, tolerance / 4))]
    best: Similarity | None = None
    max_inliers = 0
    for triple in good[:_MAX_FITS]:
        move = fit_similarity(origin[triple], target[triple])
        if move is None:
            continue
        inliers = int((_residuals(move, origin, target) <= tolerance).sum())
        if inliers > max_inliers:
            best, max_inliers = move, inliers
    if best is None or max_inliers < min(_MIN_PAIRS, len(origin)):
        return None
    return _refined(best, origin, target, tolerance)


def _refined(
    move: Similarity, origin: Floats, target: Floats, tolerance: float
) -> tuple[Similarity, int] | None:
    inliers = _residuals(move, origin, target) <= tolerance
    for _ in range(8):
        if inliers.sum() < 3:
            return None
        better = fit_similarity(origin[inliers], target[inliers])
        if better is None:
            return None
        move = better
        distances = _residuals(move, origin, target)
        tolerance = min(tolerance, max(4 * float(np.median(distances[inliers])), 1e-9))
        inliers = distances <= tolerance
    return move, int(inliers.sum())


def _side_lengths(points: Floats, triples: NDArray[np.int64]) -> Floats:
    corners = points[triples]
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)


def _residuals(move: Similarity, origin: Floats, target: Floats) -> Floats:
    moved = move.scale * origin @ move.rotation.numpy().T + move.translation.numpy()
    return np.linalg.norm(moved - target, axis=1)
