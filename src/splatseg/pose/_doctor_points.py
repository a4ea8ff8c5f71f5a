"""Start points and the up axis: how well they agree with cameras, and in which frame they would."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import Camera, Capture, PointCloud, Similarity, View
from splatseg.core.rigid import similarity_between
from splatseg.io.images import load_image
from splatseg.neighbours import NeighbourIndex
from splatseg.pose._doctor_cameras import PointCorrection, axis_rotations
from splatseg.pose._doctor_faults import (
    CERTAIN,
    WRONG,
    Fault,
    Findings,
    axis_name,
    degrees_between,
    describe_move,
    nearest_axis,
    photographs_up,
    point_fault,
)

Array = NDArray[np.float64]

_SAME_COLOUR = 0.08
"""Mean difference of the three channels up to which a pixel has a point's colour."""

_NEAR = 0.02
"""Distance to the nearest start point, as a share of the depth, that counts as the same place."""


_PLACES = 2000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointAgreement:
    """What the photographs say of start points under some cameras."""

    colour: float | None
    """Agreement beyond chance (kappa): 0 is chance, 1 is all. None without colours."""

    position: float | None
    """Share of triangulated matches that have a start point next to them. None without matches."""

    seen: float
    """Share of the points that lie in front of and inside at least two views."""

    @property
    def value(self) -> float:
        """One number: colours where seen, and places, averaged over what is known."""
        parts = [p for p in (self.colour, self.position) if p is not None]
        known = sum(parts) / len(parts) if parts else 0.0
        return known * min(1.0, 2.0 * self.seen)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReducedPhotographs:
    """Reduced photographs of some views, kept in memory."""

    views: tuple[int, ...]
    images: tuple[Tensor, ...]
    """(3, h, w) float32 in [0, 1]."""


def load_photographs(
    views: Sequence[View], chosen: Sequence[int], *, longest: int
) -> ReducedPhotographs:
    """The photographs of chosen views, reduced (area-weighted)."""
    images = tuple(
        load_image(views[i], longest=longest).permute(2, 0, 1).float() / 255 for i in chosen
    )
    return ReducedPhotographs(views=tuple(chosen), images=images)


def sample_points(cloud: PointCloud, max_points: int, *, seed: int = 0) -> PointCloud:
    """At most `max_points` points, drawn at random."""
    if len(cloud) <= max_points:
        return cloud
    rng = np.random.default_rng(seed)
    index = torch.from_numpy(np.sort(rng.permutation(len(cloud))[:max_points]))
    colours = None if cloud.colours is None else cloud.colours[index]
    return PointCloud(points=cloud.points[index], colours=colours)


def colour_score(
    photographs: ReducedPhotographs, cameras: Sequence[Camera], cloud: PointCloud, *, seed: int = 0
) -> tuple[float | None, float]:
    """Agreement of colours beyond chance, and the share of points that two views or more see.

    Args:
        photographs: Some views of the capture.
        cameras: Cameras of all views of the capture.
        cloud: Points to look at, in the world of the cameras.
        seed: Of how colours are dealt out to tell what chance gives.
    """
    points = cloud.points.double()
    colours = None if cloud.colours is None else cloud.colours.float() / 255
    rng = np.random.default_rng(seed)
    shuffled = torch.from_numpy(rng.permutation(len(points)))
    count = torch.zeros(len(points))
    agreed = torch.zeros(2)
    pairs = 0
    for view, image in zip(photographs.views, photographs.images, strict=True):
        camera = cameras[view]
        pixels, depth = camera.project(points)
        inside = (depth > 1e-9) & (pixels >= 0).all(dim=1)
        inside &= (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
        index = inside.nonzero()[:, 0]
        count[index] += 1
        if colours is None or not len(index):
            continue
        size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
        grid = (2 * pixels[index] / size - 1).float()
        seen = torch.nn.functional.grid_sample(
            image[None], grid[None, None], align_corners=False, padding_mode="border"
        )[0, :, 0].T
        pairs += len(index)
        for k, order in enumerate((index, shuffled[index])):
            difference = (seen - colours[order]).abs().mean(dim=1)
            agreed[k] += (difference < _SAME_COLOUR).sum()
    share = float((count >= 2).double().mean()) if len(points) else 0.0
    if colours is None:
        return None, share
    if pairs == 0:
        return 0.0, share
    right, chance = (agreed / pairs).tolist()
    return (right - chance) / max(1 - chance, 1e-6), share


def position_score(triangulated: Array, depth: Array, points: Array) -> float | None:
    """Share of triangulated places with a start point nearer than 2 % of their depth."""
    if len(triangulated) < 50 or len(points) == 0:
        return None
    if len(triangulated) > _PLACES:
        index = np.random.default_rng(0).permutation(len(triangulated))[:_PLACES]
        triangulated, depth = triangulated[index], depth[index]
    found = NeighbourIndex(torch.from_numpy(points)).nearest(
        torch.from_numpy(triangulated), 1, max_distance=_NEAR * float(depth.max())
    )
    return float((found.distances[:, 0].numpy() < _NEAR * depth).mean())


# In which frame start points are, when they do not fit the cameras.


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

    photographs: ReducedPhotographs
    cameras: tuple[Camera, ...]
    """Of all views, corrected."""

    triangulated: Array
    """(n, 3) places of matches, world of the cameras."""

    depth: Array
    """(n,) their depths."""

    def score(self, cloud: PointCloud, correction: PointCorrection) -> PointAgreement:
        """How well points agree after a correction."""
        moved = correction.apply(cloud)
        colour, seen = colour_score(self.photographs, self.cameras, sample_points(moved, 3000))
        position = position_score(self.triangulated, self.depth, moved.points.double().numpy())
        return PointAgreement(colour=colour, position=position, seen=seen)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScoredPoints:
    """A correction of points and what it gives."""

    correction: PointCorrection
    score: PointAgreement


def unmoved() -> PointCorrection:
    """The correction that leaves points where they are."""
    return PointCorrection(matrix=np.eye(3))


def search_points(
    evidence: PointEvidence,
    cloud: PointCloud,
    *,
    fits: Callable[[PointAgreement], bool],
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
            value = PointAgreement(colour=colour, position=None, seen=seen).value
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
                free = _similarity(source, target, start)
            else:
                turned = source @ start.matrix.T
                scale = float((turned * target).sum() / max(float((source**2).sum()), 1e-18))
                plain = replace(plain, scale=scale if scale > 0 else start.scale)
    return plain, free


def _similarity(source: Array, target: Array, like: PointCorrection) -> PointCorrection:
    """The similarity from source to target, of the same handedness as `like`."""
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(like.matrix))])
    found = similarity_between(torch.from_numpy(source @ flip), torch.from_numpy(target))
    if found is None:
        return like
    x, y, z = found.translation.tolist()
    return replace(like, matrix=found.rotation.numpy() @ flip, scale=found.scale, offset=(x, y, z))


# Start points and the up axis: is the world of the cameras the one they are meant for?


_UPRIGHT = 30.0
_ENOUGH = 300
# With fewer, most points of a healthy capture are not in view of two.
_PHOTOGRAPHS = 4


def judge_points(
    capture: Capture,
    evidence: PointEvidence,
    findings: Findings,
    *,
    declared: Sequence[PointCorrection],
    fits: Callable[[PointAgreement], bool],
) -> Capture:
    """Whether start points fit the cameras; if not, the capture with those moved that are wrong."""
    cloud = capture.points
    lacking = None
    if cloud is None or not len(cloud):
        lacking = "the capture has no points"
    elif len(evidence.photographs.images) < _PHOTOGRAPHS:
        lacking = "there are too few photographs"
    if cloud is None or lacking is not None:
        findings.unchecked.append(f"start points against cameras: {lacking}")
        return capture
    given = evidence.score(cloud, unmoved())
    findings.figures["points"] = _point_figures(given)
    if fits(given):
        return capture
    best = search_points(evidence, cloud, fits=fits, declared=declared)
    if not fits(best.score) or best.correction.changes_nothing:
        return _unexplained(capture, evidence, given, findings)
    findings.figures["points_corrected"] = _point_figures(best.score)
    if _poses_are_odd(capture, best.correction):
        return _moved_poses(capture, best.correction, given, findings)
    findings.faults.append(point_fault(best.correction, given.seen))
    return replace(capture, points=best.correction.apply(cloud))


def judge_up(capture: Capture, findings: Findings) -> Capture:
    """Whether the up axis stated is how photographs were held; if not, the capture with theirs."""
    up, length = photographs_up([view.camera for view in capture.views])
    findings.figures["up"] = {
        "stated": None if capture.up is None else list(capture.up),
        "photographs": [round(float(v), 3) for v in up],
        "certainty": round(length, 3),
    }
    name, axis = nearest_axis(up)
    if length < CERTAIN:
        findings.unchecked.append("the up axis: the photographs were held in all directions")
        return capture
    away = degrees_between(up, np.array(axis if capture.up is None else capture.up))
    if capture.up is None:
        findings.unchecked.append(
            "the up axis: the capture does not state it; in the photographs up is "
            f"{away:.0f} degrees from {name}"
        )
        return capture
    if away < WRONG:
        return capture
    findings.faults.append(
        Fault(
            name="up-axis",
            sentence=f"The up axis is wrong: {axis_name(capture.up)} is stated, but in the "
            f"photographs up is {away:.0f} degrees away from it.",
            remedy=f"The up axis is set to {name}.",
        )
    )
    return replace(capture, up=axis)


def _poses_are_odd(capture: Capture, move: PointCorrection) -> bool:
    """Whether it is the cameras that left the world: points are upright in it, cameras not."""
    if capture.up is None or np.linalg.det(move.matrix) < 0:
        return False
    stated = np.array(capture.up)
    up, length = photographs_up([view.camera for view in capture.views])
    return (
        length >= CERTAIN
        and degrees_between(up, stated) > WRONG
        and degrees_between(move.matrix.T @ up, stated) < _UPRIGHT
    )


def _moved_poses(
    capture: Capture, move: PointCorrection, given: PointAgreement, findings: Findings
) -> Capture:
    points_from_cameras = Similarity(
        rotation=torch.from_numpy(move.matrix),
        translation=torch.tensor(move.offset, dtype=torch.float64),
        scale=move.scale,
    ).inverse()
    x, y, z = points_from_cameras.translation.tolist()
    what = describe_move(
        PointCorrection(
            matrix=points_from_cameras.rotation.numpy(),
            scale=points_from_cameras.scale,
            offset=(x, y, z) if any(move.offset) else (0.0, 0.0, 0.0),
        )
    )
    findings.faults.append(
        Fault(
            name="pose-frame",
            sentence="The poses are in another world than the start points: "
            f"{100 * given.seen:.0f} % of the points lie in view of two photographs or more, and "
            f"the photographs are not upright in the world that is stated; {what} corrects both.",
            remedy=f"The poses are moved: {what}.",
        )
    )
    views = (replace(view, camera=view.camera.moved(points_from_cameras)) for view in capture.views)
    return replace(capture, views=tuple(views))


def _unexplained(
    capture: Capture, evidence: PointEvidence, given: PointAgreement, findings: Findings
) -> Capture:
    positions = evidence.triangulated
    enough = len(positions) >= _ENOUGH
    findings.faults.append(
        Fault(
            name="unexplained-points",
            sentence="The start points do not fit the cameras, and no change of axes or scale "
            f"makes them ({100 * given.seen:.0f} % lie in view of two photographs or more).",
            remedy=f"They are replaced by {len(positions)} matches that the cameras triangulate."
            if enough
            else "",
        )
    )
    if not enough:
        return capture
    return replace(capture, points=PointCloud(points=torch.from_numpy(positions).float()))


def _point_figures(score: PointAgreement) -> dict[str, Any]:
    return {
        "colours": None if score.colour is None else round(score.colour, 4),
        "places": None if score.position is None else round(score.position, 4),
        "in_view": round(score.seen, 4),
        "value": round(score.value, 4),
    }
