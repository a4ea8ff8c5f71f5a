"""Cameras on a car that drives along a street."""

import math

import numpy as np

from splatseg._check import check_range
from splatseg.core import View
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.synthetic._scene import SyntheticScene
from splatseg.synthetic._views import look_at

_HEIGHT = 1.55
_AHEAD = 14.0


@boundary
def drive_cameras(
    scene: SyntheticScene,
    count: int = 40,
    *,
    test_every: int = 8,
    width: int = 352,
    height: int = 192,
    field_of_view: float = 90.0,
    reach: float = 0.7,
) -> tuple[View, ...]:
    """Forward-looking pinhole cameras along the drive of a street, in the order of the drive.

    They stand 1.55 m above the road, evenly spaced, and look along the line that is driven,
    with a little sway. The same scene gives the same views.

    Args:
        scene: A scene with a `drive`.
        count: Number of views.
        test_every: Of how many views one has the split ``test``; 0 for none.
        width: Pixels a row.
        height: Rows.
        field_of_view: Horizontal, degrees.
        reach: Share of the drive that is driven, in (0, 1]; the rest is what the last sees ahead.

    Returns:
        Views named ``drive_0000`` ..., without photographs.

    Raises:
        InputError: If the scene has no drive, as rooms have none.
    """
    check_range("count", count, 1, 100000)
    check_range("test_every", test_every, 0, 100000)
    check_range("reach", reach, 0.01, 1.0)
    if len(scene.drive) < 2:
        raise InputError(
            f"scene: expected one with a drive, such as a street, {scene.name!r:.60} has none."
        )
    line = np.array(scene.drive)
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    along = np.concatenate(([0.0], np.cumsum(steps)))
    rng = np.random.default_rng([scene.seed, 31])

    def place(s: float) -> np.ndarray:
        """On the line; before its ends and beyond them straight on."""
        inside = min(max(s, 0.0), float(along[-1]))
        point = np.array([np.interp(inside, along, line[:, k]) for k in range(3)])
        end = line[-1] - line[-2] if s > inside else line[1] - line[0]
        return point + (s - inside) * end / np.linalg.norm(end)

    views: list[View] = []
    for i, s in enumerate(np.linspace(0.0, reach * float(along[-1]), count)):
        eye, ahead = place(float(s)), place(float(s) + _AHEAD)
        eye[2] += _HEIGHT + rng.uniform(-0.02, 0.02)
        eye[:2] += rng.uniform(-0.06, 0.06, size=2)
        sway = math.tan(math.radians(0.8)) * _AHEAD
        ahead[:2] += rng.uniform(-sway, sway, size=2)
        ahead[2] += _HEIGHT - 0.35 + rng.uniform(-0.1, 0.1)
        camera = look_at(
            eye.tolist(), ahead.tolist(), width=width, height=height, field_of_view=field_of_view
        )
        split = "test" if test_every and i % test_every == test_every // 2 else "train"
        views.append(View(name=f"drive_{i:04d}", camera=camera, split=split))
    return tuple(views)
