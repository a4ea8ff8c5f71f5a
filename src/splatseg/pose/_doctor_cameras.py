"""Corrections of cameras and points, and which of them makes matches agree: all are tried."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import Camera, PointCloud
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.pose._doctor_matches import Rays, Residuals, ViewMatches, rays_of, residuals

Array = NDArray[np.float64]

FLIP = np.diag([1.0, -1.0, -1.0])
"""OpenCV from OpenGL camera axes and back: half a turn about x."""

_SAME_FACTOR = 1e-6


@boundary
def axis_rotations(*, mirrored: bool = False) -> tuple[Array, ...]:
    """The 24 rotations that take axes to axes (or the 24 reflections), the simplest first."""
    found: list[Array] = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if (np.linalg.det(matrix) < 0) == mirrored:
                found.append(matrix)
    identity = np.eye(3)
    return tuple(sorted(found, key=lambda m: float(np.abs(m - identity).sum())))


def is_identity(matrix: Array) -> bool:
    """Whether a 3 x 3 matrix changes nothing."""
    return bool(np.allclose(matrix, np.eye(3)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraCorrection:
    """What is done to all cameras of a capture. The defaults change nothing.

    The pose becomes ``axes @ cam_from_world``, or ``axes @ world_from_cam @ world_axes`` where
    the matrices turn out to be inverted; the intrinsics are exchanged, scaled, centred and
    shifted in this order.
    """

    axes: Array
    """(3, 3) true camera axes from those given."""

    inverted: bool = False
    """World-to-camera matrices stand where camera-to-world ones should, or the other way."""

    world_axes: Array | None = None
    """(3, 3) factor on the right where poses are inverted; None is the identity."""

    swapped: bool = False
    """Width and height were exchanged: fx with fy, cx with cy."""

    centred: bool = False
    """The principal point is the middle of the photograph."""

    scale: float = 1.0
    """Factor of all intrinsics: they belong to an image of another size."""

    focal: float = 1.0
    """Further factor of the focal lengths alone."""

    shift: tuple[float, float] = (0.0, 0.0)
    """Added to the principal point, pixels of the photograph."""

    def intrinsics(self, camera: Camera) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy of the corrected camera."""
        fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
        if self.swapped:
            fx, fy, cx, cy = fy, fx, cy, cx
        if self.centred:
            cx, cy = camera.width / 2 / self.scale, camera.height / 2 / self.scale
        factor = self.scale * self.focal
        return (
            fx * factor,
            fy * factor,
            cx * self.scale + self.shift[0],
            cy * self.scale + self.shift[1],
        )

    def poses(self, poses: Array) -> Array:
        """cam_from_world (n, 4, 4) of the corrected cameras."""
        if not self.inverted:
            return _embedded(self.axes) @ poses
        world = np.eye(3) if self.world_axes is None else self.world_axes
        return _embedded(self.axes) @ np.linalg.inv(poses) @ _embedded(world)

    def apply(self, camera: Camera) -> Camera:
        """One corrected camera."""
        fx, fy, cx, cy = self.intrinsics(camera)
        pose = self.poses(camera.cam_from_world.detach().numpy()[None])[0]
        return replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, cam_from_world=torch.from_numpy(pose))

    @property
    def faults(self) -> int:
        """How many different things it changes; the shift does not count."""
        return (
            int(not is_identity(self.axes))
            + int(self.inverted)
            + int(self.swapped)
            + int(self.centred)
            + int(abs(math.log(self.scale)) > _SAME_FACTOR)
            + int(abs(math.log(self.focal)) > _SAME_FACTOR)
        )


def no_correction() -> CameraCorrection:
    """The correction that changes nothing."""
    return CameraCorrection(axes=np.eye(3))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointCorrection:
    """What is done to the start points: x -> scale * matrix @ x + offset."""

    matrix: Array
    """(3, 3), a rotation or a reflection."""

    scale: float = 1.0
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    source: str | None = None
    """Where it is written down, such as transforms.json's applied_transform."""

    def apply(self, cloud: PointCloud) -> PointCloud:
        """The corrected points."""
        moved = self.array(cloud.points.double().numpy())
        return PointCloud(points=torch.from_numpy(moved).float(), colours=cloud.colours)

    def array(self, points: Array) -> Array:
        """The corrected points of an array (n, 3)."""
        return self.scale * points @ self.matrix.T + np.array(self.offset)

    @property
    def changes_nothing(self) -> bool:
        """Whether it is the identity."""
        return is_identity(self.matrix) and self.scale == 1 and not any(self.offset)


def _embedded(rotation: Array) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    return matrix


# Which correction of the cameras makes matches agree with them: all are tried.


_TOLERANCE = 0.002
"""A match agrees if it lies this close to its epipolar line, as a share of the longest side."""

_SUBSET = 800
_SCALES = (0.125, 0.25, 0.5, 2.0, 4.0, 8.0)
_FOCALS = tuple(1.15**k for k in range(-12, 13) if k)
_STEPS = tuple(float(v) for v in np.exp(np.linspace(-0.08, 0.08, 17)))
_KEEP = 12
_CENTRED_AT = 0.05
"""A principal point this near the middle (share of the longest side) is not worth centring."""


def agreement(rays: Rays, poses: Array) -> float:
    """Share of matches on their epipolar lines and in front of both cameras."""
    return float(_agrees(rays, residuals(rays, poses)).mean())


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scored:
    """A correction and the share of matches that agree with it."""

    correction: CameraCorrection
    agreement: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatchEvidence:
    """Matches with the cameras as they were given, ready to try corrections on."""

    matches: ViewMatches
    cameras: tuple[Camera, ...]
    poses: Array
    """(views, 4, 4) cam_from_world."""

    longest: Array
    """(views,) longest side, pixels."""

    def rays(self, correction: CameraCorrection) -> Rays | None:
        """Rays under corrected intrinsics; None where the lens has no inverse with them."""
        try:
            planes = self._planes(correction)
        except InputError:
            return None
        focal = np.array([correction.intrinsics(camera)[0] for camera in self.cameras])
        return rays_of(self.matches, planes, focal, self.longest)

    def residuals(self, correction: CameraCorrection) -> Residuals | None:
        """Residuals of all matches under a correction."""
        rays = self.rays(correction)
        return None if rays is None else residuals(rays, correction.poses(self.poses))

    def agreement(self, correction: CameraCorrection) -> float:
        """Share of matches on their epipolar lines and in front of both cameras."""
        rays = self.rays(correction)
        return 0.0 if rays is None else agreement(rays, correction.poses(self.poses))

    def subset(self, max_matches: int) -> "MatchEvidence":
        """Fewer matches, drawn at random."""
        count = len(self.matches)
        if count <= max_matches:
            return self
        index = np.sort(np.random.default_rng(0).permutation(count)[:max_matches])
        matches = replace(
            self.matches, pair=self.matches.pair[index], pixels=self.matches.pixels[index]
        )
        return replace(self, matches=matches)

    def triangulated(self, correction: CameraCorrection) -> tuple[Array, Array]:
        """Places (n, 3) of the matches that agree, and their depths (n,)."""
        rays, poses = self.rays(correction), correction.poses(self.poses)
        if rays is None:
            return np.zeros((0, 3)), np.zeros(0)
        found = residuals(rays, poses)
        good = np.nonzero(_agrees(rays, found) & (found.angle > np.radians(1.0)))[0]
        first = self.matches.views[rays.pair[good], 0]
        world_from_cam = np.linalg.inv(poses[first])
        points_cam = rays.first[good] * found.depths[good, :1]
        points = np.einsum("nij,nj->ni", world_from_cam[:, :3, :3], points_cam)
        return points + world_from_cam[:, :3, 3], found.depths[good, 0]

    def _planes(self, correction: CameraCorrection) -> Array:
        planes = np.empty_like(self.matches.pixels)
        of_match = self.matches.views[self.matches.pair]
        groups: dict[tuple[object, ...], list[int]] = {}
        for i, camera in enumerate(self.cameras):
            key = (*correction.intrinsics(camera), camera.model, camera.distortion)
            groups.setdefault(key, []).append(i)
        for members in groups.values():
            rows = np.isin(of_match, members)
            if not rows.any():
                continue
            fx, fy, cx, cy = correction.intrinsics(self.cameras[members[0]])
            lens = replace(self.cameras[members[0]], fx=fx, fy=fy, cx=cx, cy=cy)
            straight = lens.undistort_pixels(torch.from_numpy(self.matches.pixels[rows])).numpy()
            planes[rows] = (straight - [cx, cy]) / [fx, fy]
        return planes


def match_evidence(matches: ViewMatches, cameras: Sequence[Camera]) -> MatchEvidence:
    """Matches and the cameras they are to be held against."""
    return MatchEvidence(
        matches=matches,
        cameras=tuple(cameras),
        poses=np.stack([camera.cam_from_world.detach().numpy() for camera in cameras]),
        longest=np.array([float(max(c.width, c.height)) for c in cameras]),
    )


def _agrees(rays: Rays, found: Residuals) -> NDArray[np.bool_]:
    near = np.abs(found.sampson) < np.maximum(1.0, _TOLERANCE * rays.longest)
    return near & (found.depths > 0).all(axis=1)


def intrinsic_candidates(evidence: MatchEvidence) -> list[CameraCorrection]:
    """Corrections of the intrinsics alone, the empty one first."""
    none = no_correction()
    found = [none]
    found += [replace(none, scale=scale) for scale in _SCALES]
    found += [replace(none, focal=focal) for focal in _FOCALS]
    camera = evidence.cameras[0]
    away = max(abs(camera.cx - camera.width / 2), abs(camera.cy - camera.height / 2))
    if away > _CENTRED_AT * max(camera.width, camera.height):
        found += [replace(c, centred=True) for c in found if c.scale == 1]
    if away > 1 or abs(camera.fx / camera.fy - 1) > _TOLERANCE:
        found.append(replace(none, swapped=True))
    return found


def search_cameras(evidence: MatchEvidence, *, world_axes: Array | None) -> list[Scored]:
    """The corrections that agree best, the best first; what was given is among them.

    Every choice of camera axes (24), with poses as they are and inverted, is tried with every
    candidate of the intrinsics on a subset of the matches; the best are refined in focal length
    and scored on all.

    Args:
        evidence: ViewMatches and cameras.
        world_axes: What an inverted pose is multiplied with, see `CameraCorrection`.
    """
    few = evidence.subset(_SUBSET)
    scored: list[Scored] = []
    for lens in intrinsic_candidates(evidence):
        rays = few.rays(lens)
        if rays is None:
            continue
        for inverted in (False, True):
            for axes in axis_rotations():
                candidate = replace(
                    lens, axes=axes, inverted=inverted, world_axes=world_axes if inverted else None
                )
                share = agreement(rays, candidate.poses(few.poses))
                scored.append(Scored(correction=candidate, agreement=share))
    scored.sort(key=lambda s: (-s.agreement, s.correction.faults))
    best = [_refined(few, s.correction) for s in scored[:_KEEP]]
    simple = [no_correction(), *(s.correction for s in scored[:_KEEP])]
    tried = [Scored(correction=c, agreement=evidence.agreement(c)) for c in (*simple, *best)]
    tried.sort(key=lambda s: (-s.agreement, s.correction.faults))
    return tried[:_KEEP]


def _refined(evidence: MatchEvidence, correction: CameraCorrection) -> CameraCorrection:
    """The same with the factor of the focal length on a fine grid around it."""
    tried = [replace(correction, focal=correction.focal * step) for step in _STEPS]
    return max(tried, key=evidence.agreement)


def flipped_world(format: str) -> Array | None:
    """`world_axes` of inverted poses for a layout.

    Layouts that hold camera-to-world matrices with OpenGL axes are read as ``inv(M F)``, with F
    half a turn about x. If M was world-to-camera, the true pose is M, or F M where it had
    OpenGL axes: the inverse of what was read, times F on the right.
    """
    return FLIP if format in ("nerfstudio", "blender", "llff") else None


# How far principal point and focal length are off, with the uncertainty of the estimate.
#
# The signed Sampson distances r of matches are linear in small changes p of the principal point
# and the logarithm of the focal length, so that
#
# .. math:: \hat p = \arg\min_p \sum_k w_k (r_k + J_k p)^2
#
# with weights w of Geman and McClure, repeated until it stands still. The standard deviation comes
# from drawing pairs of views anew (bootstrap), which accounts for errors that matches of a pair
# share. What all cameras have in common (a wrong model of the lens, poses fitted with the wrong
# intrinsics) it does not see.


_ROUNDS = 8
_DRAWS = 200
_FAR = 0.7
_STEP = np.array([0.25, 0.25, 0.002])


@dataclass(frozen=True, slots=True, kw_only=True)
class IntrinsicsEstimate:
    """What should be added to the principal point, and the factor of the focal length."""

    shift: tuple[float, float]
    """Pixels of the photograph."""

    shift_sigma: tuple[float, float]
    focal: float
    focal_sigma: float

    residual: float
    """Median distance of the matches from their epipolar lines after it, pixels."""


def estimate_intrinsics(
    evidence: MatchEvidence, correction: CameraCorrection
) -> IntrinsicsEstimate | None:
    """Refine principal point and focal length of corrected cameras.

    None where matches are too few, or nothing near the cameras fits them.

    Args:
        evidence: ViewMatches and cameras.
        correction: What was found wrong before.
    """
    pairs = len(evidence.matches.views)
    if pairs < 4 or len(evidence.matches) < 150:
        return None
    p = np.zeros(3)
    r = weights = jacobian = np.zeros(0)
    for _ in range(_ROUNDS):
        value = _signed(evidence, correction, p)
        if value is None:
            return None
        r = value
        columns: list[Array] = []
        for k in range(3):
            step = np.zeros(3)
            step[k] = _STEP[k]
            above, below = (_signed(evidence, correction, p + s * step) for s in (1, -1))
            if above is None or below is None:
                return None
            columns.append((above - below) / (2 * _STEP[k]))
        jacobian = np.stack(columns, axis=1)
        spread = max(1.4826 * float(np.median(np.abs(r))), 1e-6)
        weights = 1 / (1 + (r / (2 * spread)) ** 2) ** 2
        change = _solve(jacobian.T * weights @ jacobian, -(jacobian.T * weights) @ r)
        p = p + change
        if abs(p[2]) > _FAR or np.abs(p[:2]).max() > _FAR * evidence.longest.max():
            return None  # it runs away: these cameras are wrong in other ways
        if (np.abs(change) < _STEP / 100).all():
            break
    sigma = _bootstrap(evidence, jacobian, weights, r)
    return IntrinsicsEstimate(
        shift=(float(p[0]), float(p[1])),
        shift_sigma=(float(sigma[0]), float(sigma[1])),
        focal=float(np.exp(p[2])),
        focal_sigma=float(sigma[2]),
        residual=float(np.median(np.abs(r))),
    )


def _signed(evidence: MatchEvidence, correction: CameraCorrection, p: Array) -> Array | None:
    shift = (correction.shift[0] + float(p[0]), correction.shift[1] + float(p[1]))
    changed = replace(correction, shift=shift, focal=correction.focal * float(np.exp(p[2])))
    found = evidence.residuals(changed)
    return None if found is None else found.sampson


def _solve(matrix: Array, right: Array) -> Array:
    # A direction that no match says anything about must stay where it is.
    ridge = 1e-9 * max(float(np.trace(matrix)), 1e-12)
    return np.linalg.solve(matrix + ridge * np.eye(3), right).astype(np.float64)


def _bootstrap(evidence: MatchEvidence, jacobian: Array, weights: Array, r: Array) -> Array:
    pairs = len(evidence.matches.views)
    left, right = np.zeros((pairs, 3, 3)), np.zeros((pairs, 3))
    for k in range(pairs):
        rows = evidence.matches.pair == k
        weighted = jacobian[rows].T * weights[rows]
        left[k], right[k] = weighted @ jacobian[rows], -weighted @ r[rows]
    rng = np.random.default_rng(0)
    draws = [
        _solve(left[chosen].sum(axis=0), right[chosen].sum(axis=0))
        for chosen in rng.integers(pairs, size=(_DRAWS, pairs))
    ]
    return np.std(np.array(draws, dtype=np.float64), axis=0)
