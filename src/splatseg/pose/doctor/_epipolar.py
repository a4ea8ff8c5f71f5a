r"""How well matches agree with cameras: distance to epipolar lines, and depth in front.

For rays x (homogeneous, camera axes) of a match and the essential matrix E = [t]_x R of the
pair, the signed Sampson distance in pixels is

.. math:: r = \frac{x_2^\top E x_1}
    {\sqrt{(E x_1)_1^2 / f_1^2 + (E x_1)_2^2 / f_1^2 + (E^\top x_2)_1^2 / f_2^2 + ...}}

(Hartley and Zisserman 2004, eq. 11.9, with plane coordinates divided by the focal lengths).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatseg.pose.doctor._matches import Matches

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


def rays_of(matches: Matches, planes: Array, focal: Array, longest: Array) -> Rays:
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
