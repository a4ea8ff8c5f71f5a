"""Places a virtual camera could stand: around a scene looking in, or inside it looking out."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from splatseg.core import Camera
from splatseg.importing._extent import Extent
from splatseg.neighbours import NeighbourIndex

OUTSIDE_VIEW = 50.0
"""Horizontal field of view of cameras that look in, degrees."""

INSIDE_VIEW = 75.0
"""The same of cameras that look out."""

_TURNS = 16
_HEIGHTS = (-12.0, 12.0, 36.0, 62.0)
_NEARER = (1.0, 0.6)
_MARGIN = 1.12
_GRID = (7, 7, 4)
_INNER = 0.85
_CLEARANCE = 0.08
_POSITIONS = 24
_DIRECTIONS = 8
_PITCHES = (-22.0, 4.0)

VIEWS_A_PLACE = _DIRECTIONS * len(_PITCHES)
"""How many cameras stand at each free place, all round."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """Size of the pictures."""

    width: int
    height: int


def outside(extent: Extent, frame: Frame) -> list[Camera]:
    """Cameras around the scene, at heights from below to far above.

    The first half has all of the bounds in the picture. The second stands nearer, and where one
    side of the bounds is the longest by far, it looks at its ends in turn as well as at its middle.
    """
    half = extent.half
    signs = torch.cartesian_prod(*([torch.tensor([-1.0, 1.0], dtype=torch.float64)] * 3))
    corners = signs * half
    tangent_x = math.tan(math.radians(OUTSIDE_VIEW) / 2)
    tangent_y = tangent_x * frame.height / frame.width
    cameras: list[Camera] = []
    half_lengths, axes = half.sort(descending=True)
    along = torch.zeros(3, dtype=torch.float64)
    along[axes[0]] = half_lengths[0] - half_lengths[1]
    for near in _NEARER:
        for height in _HEIGHTS:
            for turn in range(_TURNS):
                azimuth = 2 * math.pi * (turn + 0.5 * (height > 0)) / _TURNS
                pitch = math.radians(height)
                away = torch.tensor(
                    [
                        math.cos(pitch) * math.cos(azimuth),
                        math.cos(pitch) * math.sin(azimuth),
                        math.sin(pitch),
                    ],
                    dtype=torch.float64,
                )
                rotation = _looking(-away)
                x, y, z = (corners @ rotation.T).unbind(-1)
                needed = torch.maximum(x.abs() / tangent_x, y.abs() / tangent_y) - z
                distance = _MARGIN * float(needed.max()) * near
                target = extent.centre + (turn % 3 - 1) * (1 - near) * along
                eye = target + distance * away
                cameras.append(_camera(extent, eye, rotation, frame, OUTSIDE_VIEW))
    return cameras


def inside(extent: Extent, frame: Frame) -> list[Camera]:
    """Cameras at free places within the bounds, in all directions; none where nothing is free."""
    cameras: list[Camera] = []
    for eye in free_positions(extent):
        for pitch in _PITCHES:
            for turn in range(_DIRECTIONS):
                azimuth = 2 * math.pi * (turn + 0.5 * (pitch > 0)) / _DIRECTIONS
                slope = math.radians(pitch)
                forward = torch.tensor(
                    [
                        math.cos(slope) * math.cos(azimuth),
                        math.cos(slope) * math.sin(azimuth),
                        math.sin(slope),
                    ],
                    dtype=torch.float64,
                )
                cameras.append(_camera(extent, eye, _looking(forward), frame, INSIDE_VIEW))
    return cameras


def free_positions(extent: Extent) -> list[Tensor]:
    """Points of a grid within the bounds that are away from all solid Gaussians, spread out."""
    axes = [
        torch.linspace(-_INNER, _INNER, n, dtype=torch.float64) * extent.half[k]
        for k, n in enumerate(_GRID)
    ]
    grid = torch.cartesian_prod(*axes) + extent.centre
    distance = NeighbourIndex(extent.solid).nearest(grid, 1).distances[:, 0]
    clear = distance > _CLEARANCE * extent.radius
    free, room = grid[clear], distance[clear]
    if not len(free):
        return []
    # Farthest points first, beginning with the one that has most room.
    chosen = [int(room.argmax())]
    apart = torch.linalg.vector_norm(free - free[chosen[0]], dim=1)
    while len(chosen) < min(_POSITIONS, len(free)):
        chosen.append(int(apart.argmax()))
        apart = torch.minimum(apart, torch.linalg.vector_norm(free - free[chosen[-1]], dim=1))
    return [free[i] for i in chosen]


def _looking(forward: Tensor) -> Tensor:
    """Rotation cam_from_level of a camera that looks along `forward`, level."""
    right = torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    right = right / torch.linalg.vector_norm(right)
    return torch.stack((right, torch.linalg.cross(forward, right), forward))


def _camera(extent: Extent, eye: Tensor, rotation: Tensor, frame: Frame, view: float) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation @ extent.world_from_level.T
    pose[:3, 3] = -rotation @ eye
    focal = frame.width / 2 / math.tan(math.radians(view) / 2)
    return Camera(
        width=frame.width,
        height=frame.height,
        fx=focal,
        fy=focal,
        cx=frame.width / 2,
        cy=frame.height / 2,
        cam_from_world=pose,
    )
