"""From start points to Gaussians, by hand."""

from pathlib import Path

import pytest
import torch

from splatseg.core import Camera, Capture, PointCloud, View
from splatseg.fit import FitOptions
from splatseg.fit._start import initial_parameters, scene_extent


def _view(x: float, y: float, z: float) -> View:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = -torch.tensor([x, y, z], dtype=torch.float64)
    camera = Camera(width=8, height=8, fx=8.0, fy=8.0, cx=4.0, cy=4.0, cam_from_world=pose)
    return View(name=f"{x}_{y}_{z}", camera=camera, image=Path("x.png"))


def _capture(points: torch.Tensor, colours: torch.Tensor | None = None) -> Capture:
    return Capture(
        path=Path("capture"),
        format="test",
        views=(_view(0, 0, -100), _view(0, 0, -50)),
        points=PointCloud(points=points, colours=colours),
    )


def _start(capture: Capture, **options: object):
    return initial_parameters(
        capture, options=FitOptions(**options), generator=torch.Generator().manual_seed(0)
    )


def test_scales_are_the_mean_of_three_distances() -> None:
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [10, 10, 10]])
    gaussians = _start(_capture(points)).gaussians()
    assert gaussians.scales[0].tolist() == pytest.approx([2.0] * 3)  # (1 + 2 + 3) / 3
    assert torch.equal(gaussians.means, points)
    assert gaussians.opacities.tolist() == pytest.approx([0.1] * 5)
    assert gaussians.rotations.tolist() == [[1, 0, 0, 0]] * 5


def test_far_and_doubled_points_get_scales_that_can_be_drawn() -> None:
    """At most a tenth of the distance to the nearest camera, at least a hundred-thousandth."""
    points = torch.tensor([[0.0, 0, 0]] * 4 + [[0, 0, 5000.0]])
    scales = _start(_capture(points)).gaussians().scales
    assert scales[4].tolist() == pytest.approx([505.0] * 3)
    assert scales[0].tolist() == pytest.approx([50e-5] * 3)
    lone = _start(_capture(torch.zeros(1, 3))).gaussians().scales
    assert lone[0].tolist() == pytest.approx([5.0] * 3)


def test_colours_are_the_points() -> None:
    points = torch.rand(3, 3)
    colours = torch.tensor([[0, 128, 255], [10, 20, 30], [255, 255, 255]], dtype=torch.uint8)
    coloured = _start(_capture(points, colours), sh_degree=3).gaussians()
    assert coloured.sh.shape == (3, 16, 3)
    torch.testing.assert_close(coloured.colours, colours / 255.0)
    assert not bool(coloured.sh[:, 1:].any())
    grey = _start(_capture(points)).gaussians()
    torch.testing.assert_close(grey.colours, torch.full((3, 3), 0.5))


def test_too_many_points_are_drawn_from() -> None:
    points = torch.arange(300.0).reshape(100, 3)
    chosen = _start(_capture(points), max_gaussians=30).means
    assert len(chosen) == 30
    assert len(torch.unique(chosen[:, 0])) == 30
    assert bool((torch.cdist(chosen, points).amin(dim=1) == 0).all())


def test_extent_is_the_reach_of_the_cameras() -> None:
    points = torch.tensor([[0.0, 0, 1000], [0, 0, 1000], [0, 0, 2000]])
    views = (_view(0, 0, 0), _view(4, 0, 0))
    assert scene_extent(views, points) == pytest.approx(2.2)
    assert scene_extent(views[:1], points) == pytest.approx(1.0)
