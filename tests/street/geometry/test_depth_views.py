"""z-depth and distance along rays, by hand; rays kept within a bound."""

import math

import pytest
import torch

from splatseg.core import Camera
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.street.depth_views import DepthView, axis_cosines, collect_rays, distances_of


def camera(width: int = 3, height: int = 1, *, x: float = 0.0) -> Camera:
    """Looks along z from (x, 0, 0); rays of its pixels are a unit apart at z = 1."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = -x
    return Camera(
        width=width, height=height, fx=1, fy=1, cx=width / 2, cy=height / 2, cam_from_world=pose
    )


def seed(value: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(value)


def test_distance_is_depth_over_the_cosine_of_the_ray() -> None:
    """The plane z = 2: straight ahead 2, one pixel aside 2 sqrt(2)."""
    view = DepthView(camera=camera(), depth=torch.full((1, 3), 2.0))
    root = math.sqrt(2)
    assert distances_of(view)[0].tolist() == pytest.approx([2 * root, 2, 2 * root])
    _, directions = view.camera.rays()
    assert axis_cosines(view.camera, directions)[0].tolist() == pytest.approx(
        [1 / root, 1, 1 / root]
    )


def test_a_turned_camera_measures_along_its_own_axis() -> None:
    """It looks along x, and the plane x = 3 has the depth 3 at every pixel."""
    turned = Camera(
        width=3, height=1, fx=1, fy=1, cx=1.5, cy=0.5,
        cam_from_world=torch.tensor(
            [[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]
        ),
    )  # fmt: skip
    found = distances_of(DepthView(camera=turned, depth=torch.full((1, 3), 3.0)))
    origin, directions = turned.rays()
    points = origin + directions * found[..., None].double()
    assert points[0, :, 0].tolist() == pytest.approx([3, 3, 3])


def test_unknown_depth_has_no_distance() -> None:
    view = DepthView(camera=camera(), depth=torch.tensor([[0.0, 2, 0]]))
    assert distances_of(view).tolist() == [[0, 2, 0]]


@pytest.mark.parametrize("value", [math.nan, math.inf, -1.0])
def test_depth_that_is_none_is_refused(value: float) -> None:
    with pytest.raises(RangeError, match="depth: "):
        DepthView(camera=camera(), depth=torch.tensor([[1.0, value, 1.0]]))


def test_a_map_of_other_pixels_is_refused() -> None:
    with pytest.raises(ShapeError, match=r"depth: expected shape \(1, 3\)"):
        DepthView(camera=camera(), depth=torch.ones(2, 3))


def test_rays_are_those_of_pixels_with_depth() -> None:
    views = [
        DepthView(camera=camera(), depth=torch.tensor([[0.0, 2, 3]])),
        DepthView(camera=camera(x=5.0), depth=torch.tensor([[4.0, 60, 0]])),
    ]
    rays = collect_rays(iter(views), max_rays=10, max_depth=50, generator=seed())
    assert len(rays) == 3
    assert rays.views.tolist() == [0, 0, 1]
    origins, directions, distances = rays.take(torch.arange(3))
    points = origins + directions * distances[:, None]
    torch.testing.assert_close(
        points, torch.tensor([[0, 0, 2], [3, 0, 3], [1, 0, 4]]).double(), atol=1e-5, rtol=0
    )


def test_too_many_rays_are_thinned_evenly() -> None:
    views = [DepthView(camera=camera(40, 25), depth=torch.ones(25, 40)) for _ in range(8)]
    rays = collect_rays(views, max_rays=2500, max_depth=50, generator=seed())
    assert 1250 < len(rays) <= 2500
    counts = torch.bincount(rays.views)
    assert len(counts) == 8
    assert float(counts.min()) > 0.7 * float(counts.max())


def test_views_without_depth_are_refused() -> None:
    far = DepthView(camera=camera(), depth=torch.full((1, 3), 60.0))
    with pytest.raises(InputError, match="depths: expected views with depth .* got 1 views"):
        collect_rays([far], max_rays=10, max_depth=50, generator=seed())
    with pytest.raises(InputError, match="depths: .* got 0 views"):
        collect_rays([], max_rays=10, max_depth=50, generator=seed())
