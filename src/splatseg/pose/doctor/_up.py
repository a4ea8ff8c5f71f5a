"""Which way is up, told by how photographs are held."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from splatseg.core import Camera

Array = NDArray[np.float64]

CERTAIN = 0.4
"""Least length of the mean of the photographs' up directions that says something."""

WRONG = 60.0
"""Degrees between the up axis given and the photographs' from which it is wrong."""

_NAMES = ("+x", "-x", "+y", "-y", "+z", "-z")
_AXES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float64)


def photographs_up(cameras: Sequence[Camera]) -> tuple[Array, float]:
    """Mean direction (3,) of the photographs' upper edges in the world, and how sure it is.

    The second value is the length of the mean of the unit vectors: 1 where all photographs
    were held the same way, 0 where they say nothing.
    """
    ups = np.stack([-c.cam_from_world.detach().numpy()[1, :3] for c in cameras])
    mean = ups.mean(axis=0)
    length = float(np.linalg.norm(mean))
    return mean / max(length, 1e-12), length


def degrees_between(first: Array, second: Array) -> float:
    """Angle between two directions."""
    cosine = first @ second / (np.linalg.norm(first) * np.linalg.norm(second))
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def nearest_axis(direction: Array) -> tuple[str, tuple[float, float, float]]:
    """Name and direction of the axis of the world that is closest, such as ``+z``."""
    at = int(np.argmax(_AXES @ direction))
    x, y, z = _AXES[at].tolist()
    return _NAMES[at], (x, y, z)


def axis_name(direction: Sequence[float]) -> str:
    """A direction in words: the axis it is, or its numbers."""
    at = _AXES @ np.array(direction)
    if at.max() > 0.999:
        return _NAMES[int(np.argmax(at))]
    return f"({', '.join(f'{v:.2f}' for v in direction)})"
