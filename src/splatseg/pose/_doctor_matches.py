"""Features matched between photographs: what the images say, whatever the poses say."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg.core import View
from splatseg.core.boundary import boundary
from splatseg.io.images import load_image

_FEATURES = 2500
# Most matches kept of a pair, so that no pair outvotes the others.
_PER_PAIR = 160
_RATIO = 0.8
# A fundamental matrix of a pair holds for matches this close to their epipolar lines, pixels of
# the reduced photographs.
_VERIFIED = 1.5
_MIN_KEYPOINTS = 24
# Matches that hardly move between two photographs say little; median motion as a share of the
# longest side.
_MIN_MOTION = 0.015


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewMatches:
    """Pixels of two views that show the same place, verified pair by pair.

    Verified means that some fundamental matrix explains them (7 parameters a pair, fitted to the
    pixels alone); poses and intrinsics play no part in it.
    """

    pair: NDArray[np.int64]
    """(n,) index of the pair of each match."""

    views: NDArray[np.int64]
    """(pairs, 2) the two views of each pair, indices into the views given."""

    pixels: NDArray[np.float64]
    """(n, 2, 2) pixels (u, v) of the photograph in the first and in the second view."""

    def __len__(self) -> int:
        return len(self.pair)


def choose_views(count: int, max_views: int) -> list[int]:
    """At most `max_views` of `count` views in short runs of neighbours, spread over all of them.

    Captures are sorted by name, which mostly is the order in which they were taken; a run has
    views 1, 2 and 4 apart, so that one of the pairs has parallax without losing the overlap.
    """
    run = (0, 1, 2, 4, 8)
    if count <= max_views:
        return list(range(count))
    runs = max(1, max_views // len(run))
    starts = np.linspace(0, count - 1 - run[-1], runs).round().astype(int) if count > 8 else [0]
    return sorted({min(int(start) + step, count - 1) for start in starts for step in run})


def candidate_pairs(views: Sequence[View], chosen: Sequence[int]) -> list[tuple[int, int]]:
    """Pairs of chosen views to match: neighbours by name and neighbours by pose.

    Poses may be wrong; near cameras are still near when all of them were changed the same way.
    """
    poses = np.stack([views[i].camera.cam_from_world.numpy() for i in chosen])
    rotations, translations = poses[:, :3, :3], poses[:, :3, 3]
    centres = -np.einsum("nji,nj->ni", rotations, translations)
    trace = np.einsum("aij,bij->ab", rotations, rotations)
    angle = np.arccos(np.clip((trace - 1) / 2, -1, 1))
    distance = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    spread = float(np.median(distance[distance > 0])) if (distance > 0).any() else 1.0
    apart = angle + distance / spread
    pairs: set[tuple[int, int]] = set()
    for i in range(len(chosen)):
        by_pose = [int(j) for j in np.argsort(apart[i], kind="stable") if j != i][:3]
        by_name = [i + step for step in (1, 2, 3) if i + step < len(chosen)]
        pairs |= {(min(i, j), max(i, j)) for j in (*by_pose, *by_name)}
    return sorted((chosen[i], chosen[j]) for i, j in pairs)


@boundary
def match_views(
    views: Sequence[View],
    *,
    max_views: int,
    longest: int,
) -> ViewMatches:
    """Match features (SIFT) between neighbouring photographs.

    Args:
        views: Views with photographs.
        max_views: How many of them to look at.
        longest: Longest side at which features are found, pixels.
    """
    import cv2

    chosen = choose_views(len(views), max_views)
    features = {i: sift_features(views[i], longest) for i in chosen}
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    rng = np.random.default_rng(0)
    kept: list[NDArray[np.float64]] = []
    pairs: list[tuple[int, int]] = []
    for i, j in candidate_pairs(views, chosen):
        pixels = _match(features[i], features[j], matcher, cv2)
        if pixels is None:
            continue
        if len(pixels) > _PER_PAIR:
            pixels = pixels[np.sort(rng.permutation(len(pixels))[:_PER_PAIR])]
        pairs.append((i, j))
        kept.append(pixels)
    counts = [len(pixels) for pixels in kept]
    return ViewMatches(
        pair=np.repeat(np.arange(len(pairs)), counts),
        views=np.array(pairs, dtype=np.int64).reshape(-1, 2),
        pixels=np.concatenate(kept) if kept else np.zeros((0, 2, 2)),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SiftFeatures:
    """Features of one photograph."""

    pixels: NDArray[np.float64]
    """(n, 2) in the photograph's own pixels."""

    descriptors: NDArray[np.float32]
    scale: float
    """Photograph's pixels a pixel of the reduced one."""

    longest: float


def sift_features(view: View, longest: int) -> SiftFeatures:
    """SIFT features of a view's photograph, found at a longest side of so many pixels."""
    import cv2

    image = load_image(view, longest=longest).numpy()
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    # Without the precise enlargement every keypoint lies a quarter of a pixel off.
    sift: Any = cv2.SIFT_create(_FEATURES, enable_precise_upscale=True)  # pyright: ignore[reportAttributeAccessIssue, reportCallIssue]
    keypoints, descriptors = sift.detectAndCompute(grey, None)
    scale = np.array(
        [view.camera.width / grey.shape[1], view.camera.height / grey.shape[0]], dtype=np.float64
    )
    if not keypoints:
        return SiftFeatures(
            pixels=np.zeros((0, 2)),
            descriptors=np.zeros((0, 128), np.float32),
            scale=float(scale[0]),
            longest=float(max(view.camera.width, view.camera.height)),
        )
    # OpenCV has the centre of the first pixel at (0, 0), splatseg at (0.5, 0.5).
    pixels = (np.array([k.pt for k in keypoints], dtype=np.float64) + 0.5) * scale
    # Hellinger distance instead of Euclidean (RootSIFT): fewer wrong matches at no cost.
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))
    return SiftFeatures(
        pixels=pixels,
        descriptors=root.astype(np.float32),
        scale=float(scale[0]),
        longest=float(max(view.camera.width, view.camera.height)),
    )


def mutual_matches(first: SiftFeatures, second: SiftFeatures, matcher: Any) -> NDArray[np.int64]:
    """(n, 2) features that are each other's nearest, and much nearer than the next (Lowe 2004).

    Args:
        first: At least two features.
        second: At least two features.
        matcher: OpenCV's, of the Euclidean distance.
    """
    forward = matcher.knnMatch(first.descriptors, second.descriptors, k=2)
    back = {m.queryIdx: m.trainIdx for m in matcher.match(second.descriptors, first.descriptors)}
    good = [
        (best.queryIdx, best.trainIdx)
        for best, other in forward
        if best.distance < _RATIO * other.distance and back.get(best.trainIdx) == best.queryIdx
    ]
    return np.array(good, dtype=np.int64).reshape(-1, 2)


def _match(
    first: SiftFeatures, second: SiftFeatures, matcher: Any, cv2: Any
) -> NDArray[Any] | None:
    """(n, 2, 2) verified pixels of a pair; None where there are too few or they do not move."""
    if min(len(first.pixels), len(second.pixels)) < _MIN_KEYPOINTS:
        return None
    index = mutual_matches(first, second, matcher)
    if len(index) < _MIN_KEYPOINTS:
        return None
    pixels = np.stack([first.pixels[index[:, 0]], second.pixels[index[:, 1]]], axis=1)
    cv2.setRNGSeed(0)
    try:
        _, inliers = cv2.findFundamentalMat(
            pixels[:, 0], pixels[:, 1], cv2.USAC_MAGSAC, _VERIFIED * first.scale, 0.999, 4000
        )
    except cv2.error:
        # The estimator fails an assertion where no matrix explains the pair: it says nothing.
        return None
    if inliers is None:
        return None
    pixels = pixels[inliers[:, 0] > 0]
    if len(pixels) < _MIN_KEYPOINTS:
        return None
    motion = np.median(np.linalg.norm(pixels[:, 0] - pixels[:, 1], axis=-1))
    return pixels if motion >= _MIN_MOTION * first.longest else None


# How well matches agree with cameras: distance to epipolar lines, and depth in front.
#
# For rays x (homogeneous, camera axes) of a match and the essential matrix E = [t]_x R of the
# pair, the signed Sampson distance in pixels is
#
# .. math:: r = \frac{x_2^\top E x_1}
#     {\sqrt{(E x_1)_1^2 / f_1^2 + (E x_1)_2^2 / f_1^2 + (E^\top x_2)_1^2 / f_2^2 + ...}}
#
# (Hartley and Zisserman 2004, eq. 11.9, with plane coordinates divided by the focal lengths).


Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rays:
    """Matches as plane coordinates of both cameras, under some intrinsics."""

    pair: NDArray[np.int64]
    views: NDArray[np.int64]
    """(pairs, 2) rows of the poses."""

    first: Array
    """(n, 3) homogeneous, z = 1."""

    second: Array
    focal: Array
    """(n, 2) focal length of the two views, pixels."""

    longest: Array
    """(n,) longest side of the first view's photograph, pixels."""

    def subset(self, index: NDArray[np.int64]) -> "Rays":
        """Some of the matches."""
        return Rays(
            pair=self.pair[index],
            views=self.views,
            first=self.first[index],
            second=self.second[index],
            focal=self.focal[index],
            longest=self.longest[index],
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Residuals:
    """What cameras make of matches."""

    sampson: Array
    """(n,) signed distance from the epipolar geometry, pixels."""

    depths: Array
    """(n, 2) z-depths of the triangulated place in both cameras, scene units."""

    angle: Array
    """(n,) angle between the two rays, radians."""


def relative_poses(poses: Array, views: NDArray[np.int64]) -> tuple[Array, Array]:
    """Rotation (pairs, 3, 3) and translation (pairs, 3) of second_from_first."""
    first, second = poses[views[:, 0]], poses[views[:, 1]]
    rotation = second[:, :3, :3] @ first[:, :3, :3].transpose(0, 2, 1)
    translation = second[:, :3, 3] - np.einsum("nij,nj->ni", rotation, first[:, :3, 3])
    return rotation, translation


def residuals(rays: Rays, poses: Array) -> Residuals:
    """Signed epipolar distances and triangulated depths of all matches under some poses."""
    rotation, translation = relative_poses(poses, rays.views)
    length = np.linalg.norm(translation, axis=1, keepdims=True)
    unit = translation / np.maximum(length, 1e-12)
    essential = np.cross(unit[:, None, :], rotation.transpose(0, 2, 1)).transpose(0, 2, 1)
    e = essential[rays.pair]
    in_second = np.einsum("nij,nj->ni", e, rays.first)
    in_first = np.einsum("nji,nj->ni", e, rays.second)
    value = np.einsum("ni,ni->n", rays.second, in_second)
    slope = np.sqrt(
        (in_second[:, :2] ** 2).sum(1) / rays.focal[:, 1] ** 2
        + (in_first[:, :2] ** 2).sum(1) / rays.focal[:, 0] ** 2
    )
    turned = np.einsum("nij,nj->ni", rotation[rays.pair], rays.first)
    depths, angle = _triangulated(turned, rays.second, translation[rays.pair])
    return Residuals(sampson=value / np.maximum(slope, 1e-12), depths=depths, angle=angle)


def _triangulated(first: Array, second: Array, offset: Array) -> tuple[Array, Array]:
    """Depths (n, 2) along both rays where z1 * first + offset and z2 * second are closest."""
    a, b = (first * first).sum(1), (second * second).sum(1)
    c = (first * second).sum(1)
    p, q = (first * offset).sum(1), (second * offset).sum(1)
    determinant = np.maximum(a * b - c * c, 1e-18)
    depths = np.stack([(c * q - b * p) / determinant, (a * q - c * p) / determinant], axis=1)
    cosine = np.clip(c / np.sqrt(a * b), -1, 1)
    return depths, np.arccos(cosine)


def rays_of(matches: ViewMatches, planes: Array, focal: Array, longest: Array) -> Rays:
    """Rays of matches from plane coordinates (n, 2, 2) and per-view focal lengths (views,)."""
    ones = np.ones((len(matches), 1))
    views = matches.views[matches.pair]
    return Rays(
        pair=matches.pair,
        views=matches.views,
        first=np.concatenate([planes[:, 0], ones], axis=1),
        second=np.concatenate([planes[:, 1], ones], axis=1),
        focal=focal[views],
        longest=longest[views[:, 0]],
    )
