"""Points of masks, and the points of the world that they are."""

import pytest
import torch

from lift.conftest import camera_at, gaussians_at
from splatseg.core import View
from splatseg.methods.prompt.views import lifted, points_around, points_inside
from splatseg.render import prepare


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
    points = points_around(square, 4)
    assert len(points) == 4
    pixels = points.long()
    assert not bool(square[pixels[:, 1], pixels[:, 0]].any())
    assert float(torch.pdist(points).min()) > 15
    assert len(points_around(square, 0)) == 0
    # A mask that fills the picture has nothing around it.
    assert len(points_around(torch.ones(8, 8, dtype=torch.bool), 4)) == 0
    random = points_around(square, 3, how="random", generator=torch.Generator().manual_seed(1))
    assert not torch.equal(random, points_around(square, 3))


def faint_before_solid():
    """A faint Gaussian on the axis, near, and a solid one behind it."""
    gaussians = gaussians_at([[0.0, 0.0, 1.0], [0.05, 0.0, 2.0]], scale=0.2)
    return gaussians.replace(opacities=torch.tensor([0.05, 0.95]))


def test_equation_6_takes_the_nearest_centre_whatever_it_hides() -> None:
    gaussians = faint_before_solid()
    view = View(name="v", camera=camera_at(width=32, height=24))
    middle = torch.tensor([[16.0, 12.0]])
    with prepare(gaussians, view.camera) as prepared:
        points, ids = lifted(view, prepared, gaussians, middle, how="centre", tolerance=5.0)
        assert ids.tolist() == [0]
        assert points[0].tolist() == pytest.approx([0.0, 0.0, 1.0])
        # The second centre falls 0.7 pixels aside, the first none.
        _, ids = lifted(view, prepared, gaussians, middle + 0.7, how="centre", tolerance=0.8)
        assert ids.tolist() == [1]
        _, ids = lifted(view, prepared, gaussians, middle + 6, how="centre", tolerance=2.0)
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
