"""Depth, label and colour maps in closed form: a ball or a box that stands on a table."""

import math
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import Camera
from splatseg.mesh import Grid, ViewMaps
from splatseg.synthetic import look_at

OBJECT, TABLE = 7, 2
SIDE = 160

Hit = tuple[NDArray[np.float64], NDArray[np.uint8]]
Solid = Callable[[NDArray[np.float64], NDArray[np.float64]], Hit]
"""Of rays (origin, directions): distance in lengths of the direction, inf for none; and colour."""


def ball(centre: tuple[float, float, float], radius: float) -> Solid:
    def hit(origin: NDArray[np.float64], directions: NDArray[np.float64]) -> Hit:
        offset = origin - np.array(centre)
        a = (directions**2).sum(-1)
        b = directions @ offset
        inside = b**2 - a * (offset @ offset - radius**2)
        t = np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / a, np.inf)
        return t, np.full((*t.shape, 3), 200, np.uint8)

    return hit


RED, BLUE = (220, 30, 20), (20, 40, 210)


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Solid:
    """Red where x is below 0 and blue above."""

    def hit(origin: NDArray[np.float64], directions: NDArray[np.float64]) -> Hit:
        with np.errstate(divide="ignore"):
            first = (np.array(low) - origin) / directions
            second = (np.array(high) - origin) / directions
        near = np.minimum(first, second).max(-1)
        far = np.maximum(first, second).min(-1)
        t = np.where((near < far) & (near > 0), near, np.inf)
        x = origin[0] + np.where(np.isfinite(t), t, 0) * directions[..., 0]
        return t, np.where((x < 0)[..., None], np.uint8(RED), np.uint8(BLUE))

    return hit


def table(origin: NDArray[np.float64], directions: NDArray[np.float64]) -> Hit:
    with np.errstate(divide="ignore"):
        t = -origin[2] / directions[..., 2]
    return np.where(t > 0, t, np.inf), np.full((*t.shape, 3), 90, np.uint8)


def ring(
    target: tuple[float, float, float], *, distance: float = 2.0, count: int = 12
) -> list[Camera]:
    """Cameras about a target at two heights, above the table; none looks from below."""
    cameras: list[Camera] = []
    for height in (20.0, 50.0):
        for i in range(count // 2):
            around, above = 2 * math.pi * (i + height / 100) / (count // 2), math.radians(height)
            away = np.array([math.cos(around), math.sin(around), math.tan(above)])
            eye = np.array(target) + distance * away / np.linalg.norm(away)
            cameras.append(look_at(eye.tolist(), list(target), width=SIDE, height=SIDE))
    return cameras


def seen(solid: Solid, cameras: list[Camera]) -> list[ViewMaps]:
    """What cameras see of a solid on the table z = 0."""
    return [_seen(solid, camera) for camera in cameras]


def _seen(solid: Solid, camera: Camera) -> ViewMaps:
    origin, directions = (found.numpy() for found in camera.rays())
    (one, colour), (two, ground) = solid(origin, directions), table(origin, directions)
    t = np.minimum(one, two)
    ids = np.where(one < two, OBJECT, np.where(np.isfinite(two), TABLE, -1))
    forward = camera.cam_from_world[2, :3].numpy()
    depth = np.where(np.isfinite(t), t, 0) * (directions @ forward)
    return ViewMaps(
        camera=camera,
        depth=torch.from_numpy(depth.astype(np.float32)),
        ids=torch.from_numpy(ids.astype(np.int32)),
        colour=torch.from_numpy(np.where((ids == OBJECT)[..., None], colour, ground)),
    )


def grid(
    low: tuple[float, float, float], high: tuple[float, float, float], *, resolution: int
) -> Grid:
    """The grid of a box with the axes of the world."""
    corners = torch.tensor([low, high], dtype=torch.float64)
    return Grid.about(
        corners.mean(0),
        corners[1] - corners[0],
        torch.eye(3, dtype=torch.float64),
        resolution=resolution,
    )
