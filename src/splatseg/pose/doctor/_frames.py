"""In which frame start points are, when they do not fit the cameras."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import Camera, PointCloud
from splatseg.neighbours import NeighbourIndex
from splatseg.pose.doctor._corrections import PointCorrection, axis_rotations
from splatseg.pose.doctor._points import (
    Photographs,
    PointScore,
    colour_score,
    position_score,
    sample_points,
)

Array = NDArray[np.float64]

_SCALES = (1.0, 0.001, 0.01, 0.1, 10.0, 100.0, 1000.0, 0.5, 2.0, 0.3048, 1 / 0.3048)
_AROUND = np.exp(np.linspace(-1.0, 1.0, 41))
_COARSE = 0.05
_FEW = 400
_KEEP = 6
_MIN_MATCHES = 30
_MATCHES = 50
_FITTED_TO = 800
_AS_GOOD = 0.97
_ROUNDS = 12


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointEvidence:
    """All that start points are held against."""

    photographs: Photographs
    cameras: tuple[Camera, ...]
    """Of all views, corrected."""

    triangulated: Array
    """(n, 3) places of matches, world of the cameras."""

    depth: Array
    """(n,) their depths."""

    def score(self, cloud: PointCloud, correction: PointCorrection) -> PointScore:
        """How well points agree after a correction."""
        moved = correction.apply(cloud)
        colour, seen = colour_score(self.photographs, self.cameras, sample_points(moved, 3000))
        position = position_score(self.triangulated, self.depth, moved.points.double().numpy())
        return PointScore(colour=colour, position=position, seen=seen)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScoredPoints:
    """A correction of points and what it gives."""

    correction: PointCorrection
    score: PointScore


def unmoved() -> PointCorrection:
    """The correction that leaves points where they are."""
    return PointCorrection(matrix=np.eye(3))


def search_points(
    evidence: PointEvidence,
    cloud: PointCloud,
    *,
    fits: Callable[[PointScore], bool],
    declared: Sequence[PointCorrection] = (),
) -> ScoredPoints:
    """The correction under which start points agree best with cameras and photographs.

    Tried are what the capture itself declares, and every choice of axes (24 rotations, then
    their mirror images) with usual scales, with scales around what the extent of the points
    suggests, and with the middles put on each other; the best are fitted to the triangulated
    matches (iterated closest points). Where matches lack, colours decide alone, without fitting.
    """
    best = _best(evidence, cloud, [unmoved(), *declared])
    for mirrored in (False, True):
        if len(evidence.triangulated) >= _MATCHES:
            coarse = _by_position(evidence, cloud, mirrored=mirrored)
            fitted = [_fitted(evidence, cloud, c) for c in coarse]
            # The plain ones first: without an offset, with axes as they are.
            tried = [*coarse, *(plain for plain, _ in fitted), *(free for _, free in fitted)]
        else:
            tried = _by_colour(evidence, cloud, mirrored=mirrored)
        found = _best(evidence, cloud, tried)
        if found.score.value * _AS_GOOD > best.score.value:
            best = found
        if fits(best.score):
            break
    return best if best.correction.scale in _SCALES else _polished(evidence, cloud, best)


def _best(
    evidence: PointEvidence, cloud: PointCloud, tried: Sequence[PointCorrection]
) -> ScoredPoints:
    """The first of those that are about as good as the best."""
    scored = [ScoredPoints(correction=c, score=evidence.score(cloud, c)) for c in tried]
    best = max(s.score.value for s in scored)
    return next(s for s in scored if s.score.value >= min(best, _AS_GOOD * best))


def _polished(evidence: PointEvidence, cloud: PointCloud, start: ScoredPoints) -> ScoredPoints:
    """The same with the scale that colours and places like best.

    Closest points slide along surfaces, and so let a scale be a few percent off.
    """
    best = start
    for step in (0.02, 0.01, 0.004, 0.001):
        for k in (-3, -2, -1, 1, 2, 3):
            c = replace(start.correction, scale=best.correction.scale * (1 + k * step))
            score = evidence.score(cloud, c)
            if score.value > best.score.value:
                best = ScoredPoints(correction=c, score=score)
    return best


def _by_position(
    evidence: PointEvidence, cloud: PointCloud, *, mirrored: bool
) -> list[PointCorrection]:
    rng = np.random.default_rng(0)
    chosen = rng.permutation(len(evidence.triangulated))[:_FEW]
    positions, near = evidence.triangulated[chosen], _COARSE * evidence.depth[chosen]
    points = sample_points(cloud, 20000).points.double().numpy()
    index = NeighbourIndex(torch.from_numpy(points))
    median_position, median_point = np.median(positions, axis=0), np.median(points, axis=0)
    ratio = _extent(positions, median_position) / max(_extent(points, median_point), 1e-12)
    scales = (*_SCALES, *(float(ratio * a) for a in _AROUND))
    tried: list[tuple[float, int, PointCorrection]] = []
    for matrix in axis_rotations(mirrored=mirrored):
        for scale in scales:
            for centred in (False, True):
                offset = median_position - scale * matrix @ median_point if centred else np.zeros(3)
                moved = (positions - offset) @ matrix / scale
                reach = float(near.max()) / scale
                found = index.nearest(torch.from_numpy(moved), 1, max_distance=reach)
                distance = found.distances[:, 0].numpy()
                share = float((distance * scale < near).mean())
                correction = PointCorrection(
                    matrix=matrix,
                    scale=scale,
                    offset=(float(offset[0]), float(offset[1]), float(offset[2])),
                )
                tried.append((-share, len(tried), correction))
    return [correction for _, _, correction in sorted(tried)[:_KEEP]]


def _by_colour(
    evidence: PointEvidence, cloud: PointCloud, *, mirrored: bool
) -> list[PointCorrection]:
    few = sample_points(cloud, 600)
    tried: list[tuple[float, int, PointCorrection]] = []
    for matrix in axis_rotations(mirrored=mirrored):
        for scale in _SCALES:
            correction = PointCorrection(matrix=matrix, scale=scale)
            colour, seen = colour_score(
                evidence.photographs, evidence.cameras, correction.apply(few)
            )
            value = PointScore(colour=colour, position=None, seen=seen).value
            tried.append((-value, len(tried), correction))
    return [correction for _, _, correction in sorted(tried)[:_KEEP]]


def _extent(points: Array, centre: Array) -> float:
    return float(np.median(np.linalg.norm(points - centre, axis=1)))


def _fitted(
    evidence: PointEvidence, cloud: PointCloud, start: PointCorrection
) -> tuple[PointCorrection, PointCorrection]:
    """Corrections fitted to the triangulated places: of scale alone, and any similarity."""
    points = sample_points(cloud, 20000).points.double().numpy()
    index = NeighbourIndex(torch.from_numpy(points))
    chosen = np.random.default_rng(0).permutation(len(evidence.triangulated))[:_FITTED_TO]
    positions, depth = evidence.triangulated[chosen], evidence.depth[chosen]
    plain, free = replace(start, offset=(0.0, 0.0, 0.0)), start
    for k in range(_ROUNDS):
        tolerance = _COARSE * max(0.3, 1 - k / 8)
        for fit_offset in (False, True):
            now = free if fit_offset else plain
            moved = (positions - np.array(now.offset)) @ now.matrix / now.scale
            reach = float(tolerance * depth.max() / now.scale)
            found = index.nearest(torch.from_numpy(moved), 1, max_distance=reach)
            good = found.distances[:, 0].numpy() * now.scale < tolerance * depth
            if good.sum() < _MIN_MATCHES:
                continue
            source, target = points[found.indices[:, 0].numpy()[good]], positions[good]
            if fit_offset:
                free = _umeyama(source, target, start)
            else:
                turned = source @ start.matrix.T
                scale = float((turned * target).sum() / max(float((source**2).sum()), 1e-18))
                plain = replace(plain, scale=scale if scale > 0 else start.scale)
    return plain, free


def _umeyama(source: Array, target: Array, like: PointCorrection) -> PointCorrection:
    """The similarity from source to target, of the same handedness as `like`.

    Umeyama 1991, eq. 40 to 42.
    """
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    a, b = source - mean_source, target - mean_target
    u, d, vt = np.linalg.svd(b.T @ a / len(a))
    handed = np.linalg.det(u) * np.linalg.det(vt) * np.linalg.det(like.matrix)
    s = np.array([1.0, 1.0, np.sign(handed)])
    matrix = u @ np.diag(s) @ vt
    scale = float((d * s).sum() / max(float((a * a).sum(axis=1).mean()), 1e-18))
    if scale <= 0:
        return like
    x, y, z = (mean_target - scale * matrix @ mean_source).tolist()
    return replace(like, matrix=matrix, scale=scale, offset=(x, y, z))
