"""Votes of views: one camera, points before, on, behind and beside a wall."""

import torch

from lift.conftest import camera_at
from splatseg.lift.points.votes import SeenView, view_votes

WALL = 4.0


def wall(columns: torch.Tensor | None = None, depth: float = WALL) -> SeenView:
    camera = camera_at()
    shown = torch.zeros(camera.height, camera.width, dtype=torch.int32)
    return SeenView(
        camera=camera,
        columns=shown if columns is None else columns,
        depth=torch.full(shown.shape, depth),
    )


def votes(views, points, **options) -> list[list[float]]:
    given = {"tolerance": 0.1, "relative_tolerance": 0.05, "full_distance": 2.0} | options
    at = torch.tensor(points, dtype=torch.float64)
    return view_votes(views, at, 2, **given).tolist()


def test_views_vote_for_what_is_on_the_surface_or_before_it() -> None:
    # 4 (1 + 0.05) + 0.1 = 4.3 is where a point is no longer seen.
    points = [[0, 0, 1.0], [0, 0, 4.0], [0, 0, 4.29], [0, 0, 4.31], [0, 0, -4], [99, 0, 4]]
    found = votes([wall()], points)
    assert [row[0] > 0 for row in found] == [True, True, True, False, False, False]
    assert all(row[1] == 0 for row in found)


def test_each_tolerance_counts() -> None:
    point = [[0, 0, 4.25]]
    assert votes([wall()], point, tolerance=0.0) == [[0, 0]]
    assert votes([wall()], point, relative_tolerance=0.0) == [[0, 0]]


def test_far_views_count_less_in_inverse_proportion() -> None:
    found = votes([wall(depth=9.0)], [[0, 0, 1.0], [0, 0, 2.0], [0, 0, 8.0]])
    assert [row[0] for row in found] == [1.0, 1.0, 0.25]
    assert votes([wall()], [[0, 0, 4.0]], full_distance=4.0) == [[1.0, 0.0]]


def test_a_point_takes_the_label_of_its_own_pixel() -> None:
    columns = torch.zeros(12, 16, dtype=torch.int32)
    columns[:, 8:] = 1
    columns[:6, 8:] = -1
    # The left half has the column 0, the lower right 1, and the upper right none.
    points = [[-1, 0.5, 3], [1, 0.5, 3], [1, -0.5, 3]]
    found = votes([wall(columns)], points, full_distance=9)
    assert found == [[1, 0], [0, 1], [0, 0]]


def test_where_there_is_no_surface_nothing_is_seen() -> None:
    assert votes([wall(depth=0.0)], [[0, 0, 0.05]]) == [[0, 0]]


def test_views_add_up() -> None:
    seen = [wall(), wall(torch.ones(12, 16, dtype=torch.int32)), wall()]
    assert votes(seen, [[0, 0, 4.0]]) == [[1.0, 0.5]]
