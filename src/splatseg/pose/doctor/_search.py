"""Which correction of the cameras makes matches agree with them: all are tried."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import Camera
from splatseg.errors import InputError
from splatseg.pose.doctor._corrections import (
    FLIP,
    CameraCorrection,
    axis_rotations,
    no_correction,
)
from splatseg.pose.doctor._epipolar import Rays, Residuals, rays_of, residuals
from splatseg.pose.doctor._matches import Matches

Array = NDArray[np.float64]

_TOLERANCE = 0.002
"""A match agrees if it lies this close to its epipolar line, as a share of the longest side."""

_SUBSET = 800
_SCALES = (0.125, 0.25, 0.5, 2.0, 4.0, 8.0)
_FOCALS = tuple(1.15**k for k in range(-12, 13) if k)
_STEPS = tuple(float(v) for v in np.exp(np.linspace(-0.08, 0.08, 17)))
_KEEP = 12
_CENTRED_AT = 0.05
"""A principal point this near the middle (share of the longest side) is not worth centring."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scored:
    """A correction and the share of matches that agree with it."""

    correction: CameraCorrection
    agreement: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatchEvidence:
    """Matches with the cameras as they were given, ready to try corrections on."""

    matches: Matches
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

    def subset(self, max_matches: int, *, seed: int = 0) -> "MatchEvidence":
        """Fewer matches, drawn at random."""
        count = len(self.matches)
        if count <= max_matches:
            return self
        index = np.sort(np.random.default_rng(seed).permutation(count)[:max_matches])
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


def match_evidence(matches: Matches, cameras: Sequence[Camera]) -> MatchEvidence:
    """Matches and the cameras they are to be held against."""
    return MatchEvidence(
        matches=matches,
        cameras=tuple(cameras),
        poses=np.stack([camera.cam_from_world.detach().numpy() for camera in cameras]),
        longest=np.array([float(max(c.width, c.height)) for c in cameras]),
    )


def agreement(rays: Rays, poses: Array) -> float:
    """Share of matches on their epipolar lines and in front of both cameras."""
    return float(_agrees(rays, residuals(rays, poses)).mean())


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
        evidence: Matches and cameras.
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
