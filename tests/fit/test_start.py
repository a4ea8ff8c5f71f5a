"""Start points and the first Gaussians."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from splatseg.core import Camera, Capture, PointCloud, View
from splatseg.errors import InputError
from splatseg.evaluate import evaluate_photographs
from splatseg.fit import FitOptions, fit
from splatseg.fit._photographs import TrainingPhotographs
from splatseg.fit._start import (
    depth_range_of_cameras,
    initial_parameters,
    random_points,
    scene_extent,
    with_start_points,
)
from splatseg.io.images import save_png
from splatseg.lift import GaussianField

from .conftest import ring_camera, tiny_scene


def _looking_along_z(x: float, y: float = 0.0, turn: float = 0.0) -> Camera:
    """At (x, y, 0), looking along z, turned by an angle to the right."""
    c, s = torch.cos(torch.tensor(turn)).item(), torch.sin(torch.tensor(turn)).item()
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.tensor([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    pose[:3, 3] = -pose[:3, :3] @ torch.tensor([x, y, 0], dtype=torch.float64)
    return Camera(width=40, height=30, fx=40.0, fy=40.0, cx=20.0, cy=15.0, cam_from_world=pose)


def _drawn(photographs: TrainingPhotographs, count: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return random_points(photographs, count=count, generator=generator).points


def test_cameras_around_one_thing_look_at_a_ball() -> None:
    """They stand 3.2 from it; the shorter side of an image has a half angle of atan(24 / 60)."""
    depth_range = depth_range_of_cameras([ring_camera(0.7 * i) for i in range(9)])
    radius = 3.2 * 24 / 60
    assert depth_range.object_range == pytest.approx((3.2 - radius, 3.2 + radius), rel=1e-3)
    assert depth_range.near == pytest.approx(3.2 / 3, rel=1e-3)
    assert depth_range.far == pytest.approx(64, rel=1e-3)


def test_wide_cameras_have_the_whole_ball_in_front() -> None:
    wide = [ring_camera(0.7 * i, fx=10.0, fy=10.0) for i in range(9)]
    depth_range = depth_range_of_cameras(wide)
    assert depth_range.object_range == pytest.approx((0.32, 6.08), rel=1e-3)
    assert depth_range.near == pytest.approx(0.32, rel=1e-3)


def test_cameras_that_look_elsewhere_have_no_ball() -> None:
    """Outwards from a ring of radius 2; side by side and parallel; all in one spot."""
    outwards = []
    for i in range(8):
        inward = ring_camera(0.8 * i)
        pose = torch.diag(torch.tensor([-1.0, 1, -1, 1], dtype=torch.float64))
        outwards.append(replace(inward, cam_from_world=pose @ inward.cam_from_world))
    depth_range = depth_range_of_cameras(outwards)
    assert depth_range.object_range is None
    assert (depth_range.near, depth_range.far) == pytest.approx((0.32, 160), rel=0.05)
    parallel = depth_range_of_cameras([_looking_along_z(x) for x in (-3.0, -1.0, 1.0, 3.0)])
    assert parallel.object_range is None
    assert parallel.near == pytest.approx(0.1)  # the lower median of 1, 1, 3, 3
    spot = depth_range_of_cameras([_looking_along_z(0, 0, turn) for turn in (0.0, 0.5, 1.0)])
    assert (spot.near, spot.far, spot.object_range) == pytest.approx((0.1, 50.0, None))
    one = depth_range_of_cameras([_looking_along_z(0)])
    assert one.object_range is None


def test_points_lie_on_what_is_photographed(capture: Capture) -> None:
    """Most pixels show blobs within 1.3 of the centre; others show black, which is ambiguous."""
    photographs = TrainingPhotographs(capture.train_views, longest=1600)
    generator = torch.Generator().manual_seed(1)
    cloud = random_points(photographs, count=2000, generator=generator)
    assert len(cloud) == 2000
    assert cloud.colours is not None
    bright = cloud.colours.float().amax(dim=1) > 60
    assert float(bright.float().mean()) > 0.3
    points = cloud.points[bright]
    near_blobs = torch.cdist(points, tiny_scene().means).amin(dim=1)
    assert float((near_blobs < 0.3).float().mean()) > 0.8
    assert float(points.norm(dim=1).quantile(0.9)) < 1.3
    blind = torch.randn(2000, 3)
    blind *= 1.3 * torch.rand(2000, 1) ** (1 / 3) / blind.norm(dim=1, keepdim=True)
    blindly = torch.cdist(blind, tiny_scene().means).amin(dim=1)
    assert float((blindly < 0.3).float().mean()) < 0.6


def test_points_have_the_colour_of_their_pixel(capture: Capture) -> None:
    """Each point is seen by the view it was drawn from in a pixel of its colour."""
    views = capture.train_views[:1]
    photographs = TrainingPhotographs(views, longest=1600)
    cloud = random_points(photographs, count=300, generator=torch.Generator().manual_seed(1))
    assert cloud.colours is not None
    pixels, depth = views[0].camera.project(cloud.points.double())
    assert bool((depth > 0).all())
    example = photographs.example(0)
    found = example.photograph[pixels[:, 1].long(), pixels[:, 0].long()]
    torch.testing.assert_close(found, cloud.colours / 255.0, atol=0.003, rtol=0)


def test_same_seed_same_points(capture: Capture) -> None:
    photographs = TrainingPhotographs(capture.train_views, longest=1600)
    assert torch.equal(_drawn(photographs, 100), _drawn(photographs, 100))
    assert not torch.equal(_drawn(photographs, 100), _drawn(photographs, 100, seed=1))


def test_masked_pixels_start_nothing(capture: Capture, tmp_path: Path) -> None:
    """Only the central column of each photograph is valid."""
    mask = torch.zeros(48, 56, dtype=torch.uint8)
    mask[:, 28] = 255
    save_png(mask, tmp_path / "mask.png")
    views = tuple(replace(view, mask=tmp_path / "mask.png") for view in capture.train_views)
    photographs = TrainingPhotographs(views, longest=1600)
    points = _drawn(photographs, 110).reshape(len(views), -1, 3)
    for view, own in zip(views, points, strict=True):
        pixels, _ = view.camera.project(own.double())
        assert bool((pixels[:, 0].floor() == 28).all())
    save_png(torch.zeros(48, 56, dtype=torch.uint8), tmp_path / "mask.png")
    assert len(_drawn(TrainingPhotographs(views, longest=1600), 110)) == 0


def test_a_fit_starts_without_points(capture: Capture) -> None:
    options = FitOptions(
        minutes=None, steps=250, max_gaussians=400, sh_degree=1, background="black", densify_from=80
    )
    bare = replace(capture, points=None)
    result = fit(bare, options=options)
    assert evaluate_photographs(GaussianField(result.gaussians), capture.test_views).psnr > 22
    again = fit(bare, options=replace(options, steps=2)).gaussians
    forced = fit(capture, options=replace(options, steps=2, start="random")).gaussians
    assert torch.equal(again.means, forced.means)
    with pytest.raises(InputError, match="expected a capture with start points"):
        fit(bare, options=replace(options, start="points"))
    with pytest.raises(InputError, match="start: expected one of auto, points, random"):
        replace(options, start="nowhere")


def test_the_capture_keeps_its_points(capture: Capture) -> None:
    photographs = TrainingPhotographs(capture.train_views, longest=1600)
    generator = torch.Generator().manual_seed(0)

    def points(start: str, **options: object) -> int:
        chosen = FitOptions(start=start, **options)
        found = with_start_points(capture, photographs, options=chosen, generator=generator)
        assert found.points is not None
        return len(found.points)

    assert points("points") == points("auto", strategy="classic") == 60
    assert points("auto", max_gaussians=120) == 60, "half of the budget is there already"
    assert points("random", max_gaussians=77) == 77


def test_few_points_are_joined_by_places_where_photographs_agree(capture: Capture) -> None:
    """The capture's points come first, as they were; those beside them lie between their depths."""
    photographs = TrainingPhotographs(capture.train_views, longest=1600)

    def filled(**options: object) -> Capture:
        generator = torch.Generator().manual_seed(0)
        chosen = FitOptions(max_gaussians=4000, **options)
        return with_start_points(capture, photographs, options=chosen, generator=generator)

    cloud, own = filled().points, capture.points
    assert cloud is not None
    assert own is not None
    assert 1000 < len(cloud) <= 2000
    assert torch.equal(cloud.points[:60], own.points)
    assert cloud.colours is not None
    assert own.colours is not None
    assert torch.equal(cloud.colours[:60], own.colours)
    bounds = []
    for view in capture.train_views:
        pixels, depth = view.camera.project(own.points.double())
        inside = (pixels >= 0).all(1) & (pixels[:, 0] < 56) & (pixels[:, 1] < 48) & (depth > 0)
        bounds.append(depth[inside])
    low, high = float(torch.cat(bounds).min()), float(torch.cat(bounds).max())
    _, from_first = capture.train_views[0].camera.project(cloud.points[60:100].double())
    assert float(from_first.min()) > 0.75 * low
    assert float(from_first.max()) < 1.3 * high
    example = photographs.example(0)
    pixels, _ = capture.train_views[0].camera.project(cloud.points[60:100].double())
    found = example.photograph[pixels[:, 1].long(), pixels[:, 0].long()]
    torch.testing.assert_close(found, cloud.colours[60:100] / 255.0, atol=0.003, rtol=0)
    grey = replace(capture, points=replace(own, colours=None))
    mixed = with_start_points(
        grey,
        photographs,
        options=FitOptions(max_gaussians=4000),
        generator=torch.Generator().manual_seed(0),
    ).points
    assert mixed is not None
    assert torch.equal(mixed.points, cloud.points)
    assert mixed.colours is None


def test_places_that_views_disagree_about_are_left_out(capture: Capture) -> None:
    """Photographs that have nothing in common agree nowhere."""
    photographs = TrainingPhotographs(capture.train_views, longest=1600)
    generator = torch.Generator().manual_seed(0)
    none = random_points(photographs, count=500, generator=generator, max_difference=0.0)
    assert len(none) == 0
    generator = torch.Generator().manual_seed(0)
    some = random_points(photographs, count=500, generator=generator, max_difference=0.02)
    assert 0 < len(some) < 500


# From start points to Gaussians, by hand.


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
