"""Depth maps that primitives are fitted to, and the first hits of their rays."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseg.core import Camera, DepthMap, Scan, View
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.fit import scan_depths
from splatseg.street.depth_views import (
    DepthView,
    axis_cosines,
    capture_views,
    collect_rays,
    evidence_views,
    field_views,
    point_views,
    scan_views,
)
from splatseg.street.hits import PrimitiveCaster, enclosing
from splatseg.street.primitives import PrimitiveMesh
from splatseg.street.shapes import template
from support import brute_rays as reference
from support.analytic import BallOverFloor
from support.mesh_fields import mesh_depth, mesh_distances


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
    """Straight ahead 1, one pixel aside 1 / sqrt(2)."""
    root = math.sqrt(2)
    _, directions = camera().rays()
    assert axis_cosines(camera(), directions)[0].tolist() == pytest.approx([1 / root, 1, 1 / root])


def test_a_turned_camera_measures_along_its_own_axis() -> None:
    """It looks along x, and the plane x = 3 has the depth 3 at every pixel."""
    turned = Camera(
        width=3, height=1, fx=1, fy=1, cx=1.5, cy=0.5,
        cam_from_world=torch.tensor(
            [[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]
        ),
    )  # fmt: skip
    origin, directions = turned.rays()
    found = 3.0 / axis_cosines(turned, directions)
    points = origin + directions * found[..., None]
    assert points[0, :, 0].tolist() == pytest.approx([3, 3, 3])


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


# Every source of depth gives views of z-depth in scene units.


def wide_camera(width: int = 20, height: int = 12) -> Camera:
    return Camera(
        width=width, height=height, fx=20, fy=20, cx=width / 2, cy=height / 2,
        cam_from_world=torch.eye(4),
    )  # fmt: skip


def wall(z: float, step: float = 0.05) -> torch.Tensor:
    """Points of a wall across the axis, wider than the view."""
    x, y = np.meshgrid(np.arange(-0.55, 0.55, step) * z, np.arange(-0.35, 0.35, step) * z)
    return torch.from_numpy(np.stack((x.ravel(), y.ravel(), np.full(x.size, z)), axis=1))


class Scans:
    """Two walls, one a scan."""

    scan_names: Sequence[str] = ("near", "far")

    def scan(self, name: str) -> Scan:
        return Scan(name=name, points=wall({"near": 2.0, "far": 5.0}[name]))


class Maps:
    """One depth map for every view."""

    def __init__(self, found: DepthMap) -> None:
        self._found = found

    def depth_map(self, name: str) -> DepthMap:
        del name
        return self._found


def test_scans_are_seen_as_a_fit_sees_them() -> None:
    cameras = [wide_camera(), wide_camera(10, 6)]
    options = {"spacing": 0.3}
    views = list(scan_views(Scans(), cameras, **options, metres_per_unit=2.0))
    maps = scan_depths(Scans(), cameras, **options, metres_per_unit=2.0)
    for view, one, depth in zip(views, cameras, maps, strict=True):
        assert view.camera is one
        assert torch.equal(view.depth, depth)
    assert float(views[0].depth.max()) == 2


def test_points_hide_what_is_behind_them_by_their_spacing() -> None:
    """A wall of points five pixels apart hides the one behind it."""
    both = torch.cat((wall(2.0, 0.125), wall(5.0, 0.125)))
    (view,) = point_views(both, [wide_camera()])
    assert set(view.depth.unique().tolist()) == {0.0, 2.0}
    few = torch.tensor([[0.0, 0, 3], [0.4, 0, 3]])
    (view,) = point_views(few, [wide_camera()])
    assert int((view.depth == 3).sum()) == 2


def test_points_that_tell_nothing_are_refused() -> None:
    with pytest.raises(InputError, match="points: expected at least one point to see"):
        list(point_views(torch.zeros(0, 3), [wide_camera()]))
    with pytest.raises(RangeError, match="points: .* not finite"):
        list(point_views(torch.full((1, 3), torch.nan), [wide_camera()]))


def saved(folder: Path, name: str, values: np.ndarray) -> View:
    np.save(folder / f"{name}.npy", values)
    return View(name=name, camera=wide_camera(), depth=folder / f"{name}.npy", depth_unit=0.5)


def test_maps_of_a_capture_have_the_pixels_of_their_file(tmp_path: Path) -> None:
    values = np.full((6, 10), 4.0, dtype=np.float32)
    values[0, 0] = np.nan
    views = list(
        capture_views([saved(tmp_path, "a", values), View(name="b", camera=wide_camera())])
    )
    assert len(views) == 1
    assert (views[0].camera.width, views[0].camera.fx) == (10, 10)
    assert views[0].depth[0, 0] == 0
    assert views[0].depth[3, 3] == 2


def test_relative_maps_of_a_capture_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, depth=np.ones((6, 10), dtype=np.float32), kind=np.array("relative"))
    view = View(name="a", camera=wide_camera(), depth=path)
    with pytest.raises(InputError, match="view 'a': expected a metric depth map"):
        list(capture_views([view]))


def test_metric_evidence_is_metres() -> None:
    source = Maps(DepthMap(values=torch.full((6, 10), 3.0), kind="metric"))
    view = View(name="a", camera=wide_camera())
    (found,) = evidence_views(source, [view], metres_per_unit=1.5)
    assert (found.camera.height, found.depth[0, 0].item()) == (6, 2.0)


def test_relative_evidence_is_aligned_to_points() -> None:
    """Inverse depth times 3 plus 1: two walls, left and right."""
    depth = torch.full((12, 20), 4.0)
    depth[:, 10:] = 2.0
    source = Maps(DepthMap(values=3 / depth + 1, kind="relative"))
    view = View(name="a", camera=wide_camera())
    points = wide_camera().unproject(wide_camera().pixel_centres(), depth).reshape(-1, 3)
    (found,) = evidence_views(source, [view], points=points)
    torch.testing.assert_close(found.depth, depth, rtol=1e-3, atol=1e-3)
    assert not list(evidence_views(source, [view], points=points[:5]))
    with pytest.raises(InputError, match="points: expected points to align the relative depth"):
        list(evidence_views(source, [view]))


def test_a_field_shows_its_depth_where_it_is_opaque() -> None:
    field = BallOverFloor()
    (found,) = field_views(field, [wide_camera()])
    with field.view(wide_camera()) as view:
        signals = view.signals(colour=False)
    wanted = signals.depth if signals.median_depth is None else signals.median_depth
    assert torch.equal(found.depth, torch.where(signals.alpha >= 0.5, wanted, 0.0).float())
    assert int((found.depth > 0).sum()) > 20
    assert field.open == 0


# First hits of primitives: fine over coarse, against the reference, and a sphere by hand.


def mesh(places: list[tuple[list[float], float, int]]) -> PrimitiveMesh:
    """Icospheres: centre, radius and level of each."""
    vertices, _ = template()
    return PrimitiveMesh(
        vertices=torch.cat([torch.tensor(c) + r * vertices for c, r, _ in places]),
        levels=torch.tensor([level for _, _, level in places]),
        sizes=(0.5, 1.0),
    )


def small_camera(width: int = 9, height: int = 7) -> Camera:
    return Camera(
        width=width, height=height, fx=8, fy=8, cx=width / 2, cy=height / 2,
        cam_from_world=torch.eye(4),
    )  # fmt: skip


def test_depth_of_a_sphere_ahead() -> None:
    """The middle ray meets the polyhedron between its inner and outer radius."""
    ball = mesh([([0, 0, 5], 1, 0)])
    depth = mesh_depth(ball, small_camera())
    assert 4.0 <= depth[3, 4].item() <= 4.2
    assert depth[0, 0].item() == 0
    distances = mesh_distances(ball, small_camera())
    _, directions = small_camera().rays()
    hit = distances > 0
    assert 3 < int(hit.sum()) < 63
    torch.testing.assert_close(depth[hit], (distances * directions[..., 2])[hit].float())


def test_the_finest_level_that_a_ray_meets_is_seen() -> None:
    """A coarse primitive in front hides no fine one, but is seen beside it."""
    both = mesh([([0, 0, 4], 1.5, 1), ([0, 0, 8], 0.6, 0)])
    depth = mesh_depth(PrimitiveCaster(both), small_camera())
    assert depth[3, 4].item() > 7
    assert 0 < depth[3, 6].item() < 4
    hits = PrimitiveCaster(both).first(torch.zeros(3), torch.tensor([[0.0, 0, 1], [0.3, 0, 1]]))
    assert hits.faces[0] >= 80
    assert 0 <= hits.faces[1] < 80


def test_hits_are_those_of_the_reference() -> None:
    one = mesh([([0.3, 0, 5], 1, 0), ([-0.8, 0.2, 6], 1, 0), ([0, 0, 9], 2, 0)])
    origin, directions = small_camera().rays()
    fast = PrimitiveCaster(one).first(origin, directions.reshape(-1, 3))
    slow = reference.cast(one.vertices, one.faces, origin, directions.reshape(-1, 3))
    assert torch.equal(fast.faces >= 0, slow.faces >= 0)
    torch.testing.assert_close(fast.distances, slow.distances, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(fast.weights.sum(1), (fast.faces >= 0).double())


def test_nothing_to_look_at_is_refused() -> None:
    none = PrimitiveMesh(
        vertices=torch.zeros(0, 3), levels=torch.zeros(0, dtype=torch.int64), sizes=(1.0,)
    )
    with pytest.raises(InputError, match="mesh: expected at least one primitive"):
        mesh_depth(none, small_camera())


def test_a_primitive_encloses_what_is_inside() -> None:
    made = mesh([([0, 0, 0], 1, 0), ([3, 0, 0], 1, 0), ([0, 0, 0.5], 2, 1)])
    assert enclosing(made, torch.tensor([[0.5, 0, 0]])).tolist() == [True, False, True]
    # Within the box around the first one, but outside its faces.
    assert enclosing(made, torch.tensor([[0.7, 0.7, 0.7]])).tolist() == [False, False, True]
    assert enclosing(made, torch.zeros(0, 3)).tolist() == [False, False, False]
