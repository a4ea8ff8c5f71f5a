"""Which views are looked at."""

import numpy as np
import pytest
import torch

from methods.prompt.conftest import camera_from
from splatseg.core import View
from splatseg.methods.prompt import initial_views
from splatseg.methods.prompt.views import projected_views, view_positions


def view_at(name: str, x: float, y: float = 0.0, turn: float = 0.0) -> View:
    return View(name=name, camera=camera_from(x, y, turn))


@pytest.fixture
def clusters() -> list[View]:
    """Three bunches of views; the middle one of each is at its centre."""
    return [
        view_at(f"{bunch}{i}", 5.0 * bunch + offset)
        for bunch in range(3)
        for i, offset in enumerate((-0.3, 0.0, 0.3))
    ]


def test_kmeans_takes_the_middle_of_every_bunch(clusters) -> None:
    for seed in range(5):
        found = initial_views(clusters[::-1], count=3, seed=seed)
        assert [view.name for view in found] == ["01", "11", "21"]


def test_rotations_count_as_positions_do() -> None:
    views = [view_at(f"a{i}", 0.0) for i in range(3)] + [view_at("b", 0.0, turn=1.0)]
    assert "b" in {view.name for view in initial_views(views, count=2)}


def test_positions_do_not_depend_on_the_origin_or_the_unit(clusters) -> None:
    moved = [view_at(view.name, 2.0 * float(view.camera.centre[0]) + 40.0) for view in clusters]
    np.testing.assert_allclose(view_positions(moved), view_positions(clusters), atol=1e-12)


def test_single_is_the_nearest_to_the_mean(clusters) -> None:
    assert [view.name for view in initial_views(clusters, how="single", count=3)] == ["11"]


def test_random_views_follow_the_seed_and_not_the_order(clusters) -> None:
    def names(views, seed):
        return [view.name for view in initial_views(views, how="random", count=4, seed=seed)]

    assert names(clusters, 1) == names(clusters[::-1], 1)
    assert len({tuple(names(clusters, seed)) for seed in range(8)}) > 1
    assert len(set(names(clusters, 1))) == 4


def test_no_more_views_than_there_are_and_none_twice() -> None:
    views = [view_at(str(i), 1.0) for i in range(3)]
    assert [view.name for view in initial_views(views, count=7)] == ["0", "1", "2"]


def test_coverage_takes_what_shows_the_points_from_all_sides() -> None:
    points = torch.tensor([[0.0, 0.0, 2.5]], dtype=torch.float64)
    near = [view_at(f"a{i}", 0.01 * i, turn=-0.004 * i) for i in range(4)]
    aside = view_at("b", 2.0, turn=-0.7)
    away = view_at("c", 0.0, turn=2.5)
    found = projected_views([*near, aside, away], points, share=2 / 6)
    assert len(found) == 2
    assert "b" in {view.name for view in found}
    # What does not show them is not taken, even where there is room for it.
    everywhere = projected_views([*near, aside, away], points, share=1.0)
    assert "c" not in {view.name for view in everywhere}
    assert len(everywhere) == 5


def test_random_projection_takes_any_view() -> None:
    points = torch.tensor([[0.0, 0.0, 2.5]], dtype=torch.float64)
    views = [view_at(f"a{i}", 0.0, turn=2.5) for i in range(6)]
    found = projected_views(views, points, share=0.5, how="random", seed=2)
    assert len(found) == 3
    assert found == projected_views(views[::-1], points, share=0.5, how="random", seed=2)
