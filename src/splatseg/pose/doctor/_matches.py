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
_RATIO = 0.8
# A fundamental matrix of a pair holds for matches this close to their epipolar lines, pixels of
# the reduced photographs.
_VERIFIED = 1.5
_MIN_KEYPOINTS = 24
# Matches that hardly move between two photographs say little; median motion as a share of the
# longest side.
_MIN_MOTION = 0.015


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Matches:
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
    per_pair: int = 160,
    seed: int = 0,
) -> Matches:
    """Match features (SIFT) between neighbouring photographs.

    Args:
        views: Views with photographs.
        max_views: How many of them to look at.
        longest: Longest side at which features are found, pixels.
        per_pair: Most matches kept of a pair, so that no pair outvotes the others.
        seed: Of the choice of those.
    """
    import cv2

    chosen = choose_views(len(views), max_views)
    features = {i: _features(views[i], longest) for i in chosen}
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    rng = np.random.default_rng(seed)
    kept: list[NDArray[np.float64]] = []
    pairs: list[tuple[int, int]] = []
    for i, j in candidate_pairs(views, chosen):
        pixels = _match(features[i], features[j], matcher, cv2)
        if pixels is None:
            continue
        if len(pixels) > per_pair:
            pixels = pixels[np.sort(rng.permutation(len(pixels))[:per_pair])]
        pairs.append((i, j))
        kept.append(pixels)
    counts = [len(pixels) for pixels in kept]
    return Matches(
        pair=np.repeat(np.arange(len(pairs)), counts),
        views=np.array(pairs, dtype=np.int64).reshape(-1, 2),
        pixels=np.concatenate(kept) if kept else np.zeros((0, 2, 2)),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Features:
    pixels: NDArray[np.float64]
    """(n, 2) in the photograph's own pixels."""

    descriptors: NDArray[np.float32]
    scale: float
    """Photograph's pixels a pixel of the reduced one."""

    longest: float


def _features(view: View, longest: int) -> _Features:
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
        return _Features(
            pixels=np.zeros((0, 2)),
            descriptors=np.zeros((0, 128), np.float32),
            scale=float(scale[0]),
            longest=float(max(view.camera.width, view.camera.height)),
        )
    # OpenCV has the centre of the first pixel at (0, 0), splatseg at (0.5, 0.5).
    pixels = (np.array([k.pt for k in keypoints], dtype=np.float64) + 0.5) * scale
    # Hellinger distance instead of Euclidean (RootSIFT): fewer wrong matches at no cost.
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))
    return _Features(
        pixels=pixels,
        descriptors=root.astype(np.float32),
        scale=float(scale[0]),
        longest=float(max(view.camera.width, view.camera.height)),
    )


def _match(first: _Features, second: _Features, matcher: Any, cv2: Any) -> NDArray[Any] | None:
    """(n, 2, 2) verified pixels of a pair; None where there are too few or they do not move."""
    if min(len(first.pixels), len(second.pixels)) < _MIN_KEYPOINTS:
        return None
    forward = matcher.knnMatch(first.descriptors, second.descriptors, k=2)
    back = {m.queryIdx: m.trainIdx for m in matcher.match(second.descriptors, first.descriptors)}
    good = [
        (best.queryIdx, best.trainIdx)
        for best, other in forward
        if best.distance < _RATIO * other.distance and back.get(best.trainIdx) == best.queryIdx
    ]
    if len(good) < _MIN_KEYPOINTS:
        return None
    index = np.array(good)
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
