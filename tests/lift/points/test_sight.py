"""Which points cameras saw: a wall before a camera by hand, tolerances, and what is refused."""

import pytest
import torch

from splatseg.core import Camera
from splatseg.errors import RangeError, ShapeError
from splatseg.lift.points import points_in_sight

WALL = 2.0


def camera(x: float = 0.0) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = -x
    return Camera(width=40, height=30, fx=40.0, fy=40.0, cx=20, cy=15, cam_from_world=pose)


def wall(depth: float = WALL) -> torch.Tensor:
    """A wall in the left half of a picture, nothing known in the right."""
    found = torch.zeros(30, 40)
    found[:, :20] = depth
    return found


def test_what_lies_before_a_surface_or_a_little_behind_is_seen() -> None:
    points = torch.tensor([
        [-0.1, 0, 1.0], [-0.1, 0, 2.15], [-0.1, 0, 2.17], [0.1, 0, 1.0], [-0.1, 0, -1.0],
        [-9.0, 0, 1.0], [0.005, 0, 0.05],
    ])  # fmt: skip
    # 2 m, 3 % and 0.1 m: up to 2.16 m.
    seen = [True, True, False, False, False, False, False]
    assert points_in_sight(points, [(camera(), wall())]).tolist() == seen
    assert points_in_sight(points, []).tolist() == [False] * 7
    # A scene in decimetres: the same wall and points.
    scaled = points_in_sight(10 * points, [(camera(), wall(20.0))], metres_per_unit=0.1)
    assert scaled.tolist() == seen


def test_one_view_is_enough() -> None:
    points = torch.tensor([[-0.1, 0, 1.0], [4.9, 0, 1.0], [9.9, 0, 1.0]])
    views = [(camera(5.0), wall()), (camera(), wall())]
    assert points_in_sight(points, views).tolist() == [True, True, False]
    assert points_in_sight(points, views[::-1]).tolist() == [True, True, False]


def test_what_is_refused() -> None:
    with pytest.raises(ShapeError, match="^points: "):
        points_in_sight(torch.zeros(3, 2), [])
    with pytest.raises(RangeError, match="^points: "):
        points_in_sight(torch.full((1, 3), torch.nan), [])
    with pytest.raises(ShapeError, match="^depth: "):
        points_in_sight(torch.zeros(1, 3), [(camera(), wall()[::2])])
