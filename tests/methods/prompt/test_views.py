"""Which views are looked at."""

import numpy as np
import pytest
import torch

from lift.conftest import camera_at, gaussians_at
from methods.prompt.conftest import camera_from
from splatseg.core import View
from splatseg.methods.prompt import initial_views, views
from splatseg.methods.prompt.views import (
    lifted,
    neighbouring_points,
    points_inside,
    projected_views,
    view_positions,
)
from splatseg.render import prepare


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


@pytest.fixture
def square() -> torch.Tensor:
    mask = torch.zeros(40, 60, dtype=torch.bool)
    mask[10:31, 20:41] = True
    return mask


def test_the_first_point_is_the_middle(square) -> None:
    first = points_inside(square, 1)
    assert first.tolist() == [[30.5, 20.5]]


def test_further_points_are_far_from_the_rim_and_from_each_other() -> None:
    bar = torch.zeros(30, 80, dtype=torch.bool)
    bar[10:21, 5:75] = True
    points = points_inside(bar, 3)
    columns = points[:, 0].sort().values
    assert bool((columns.diff() > 15).all())
    assert bool(((points[:, 1] - 15.5).abs() <= 3).all())


def test_the_edge_of_the_picture_is_a_rim() -> None:
    mask = torch.zeros(20, 20, dtype=torch.bool)
    mask[:, :10] = True
    assert points_inside(mask, 1)[0, 0] == pytest.approx(5.0, abs=1)


def test_random_points_follow_the_generator(square) -> None:
    def drawn(seed):
        generator = torch.Generator().manual_seed(seed)
        return points_inside(square, 5, how="random", generator=generator)

    assert torch.equal(drawn(1), drawn(1))
    assert not torch.equal(drawn(1), drawn(2))
    pixels = drawn(1).long()
    assert bool(square[pixels[:, 1], pixels[:, 0]].all())


def test_a_small_mask_has_few_points() -> None:
    mask = torch.zeros(9, 9, dtype=torch.bool)
    mask[4, 4] = True
    assert points_inside(mask, 3).tolist() == [[4.5, 4.5]]
    assert len(points_inside(mask, 3, how="random")) == 1


def test_points_around_are_outside_and_spread(square) -> None:
    points = neighbouring_points(square, 4)
    assert len(points) == 4
    pixels = points.long()
    assert not bool(square[pixels[:, 1], pixels[:, 0]].any())
    assert float(torch.pdist(points).min()) > 15
    assert len(neighbouring_points(square, 0)) == 0
    # A mask that fills the picture has nothing around it.
    assert len(neighbouring_points(torch.ones(8, 8, dtype=torch.bool), 4)) == 0


def faint_before_solid():
    """A faint Gaussian on the axis, near, and a solid one behind it."""
    gaussians = gaussians_at([[0.0, 0.0, 1.0], [0.05, 0.0, 2.0]], scale=0.2)
    return gaussians.replace(opacities=torch.tensor([0.05, 0.95]))


def test_equation_6_takes_the_nearest_centre_whatever_it_hides(monkeypatch) -> None:
    gaussians = faint_before_solid()
    view = View(name="v", camera=camera_at(width=32, height=24))
    middle = torch.tensor([[16.0, 12.0]])
    with prepare(gaussians, view.camera) as prepared:
        monkeypatch.setattr(views, "TOLERANCE", 5.0)
        points, ids = lifted(view, prepared, gaussians, middle, how="centre")
        assert ids.tolist() == [0]
        assert points[0].tolist() == pytest.approx([0.0, 0.0, 1.0])
        # The second centre falls 0.7 pixels aside, the first none.
        monkeypatch.setattr(views, "TOLERANCE", 0.8)
        _, ids = lifted(view, prepared, gaussians, middle + 0.7, how="centre")
        assert ids.tolist() == [1]
        monkeypatch.setattr(views, "TOLERANCE", 2.0)
        _, ids = lifted(view, prepared, gaussians, middle + 6, how="centre")
        assert ids.tolist() == [-1]


def test_weight_takes_what_is_seen_on_the_ray_of_the_pixel() -> None:
    gaussians = faint_before_solid()
    view = View(name="v", camera=camera_at(width=32, height=24))
    with prepare(gaussians, view.camera) as prepared:
        pixels = torch.tensor([[16.5, 12.5], [0.5, 0.5]])
        points, ids = lifted(view, prepared, gaussians, pixels, how="weight")
    assert ids.tolist() == [1, -1]
    assert float(points[0, 2]) == pytest.approx(2.0)
    back, _ = view.camera.project(points[:1])
    assert back[0].tolist() == pytest.approx([16.5, 12.5])
