"""Every source of depth gives views of z-depth in scene units."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseg.core import Camera, DepthMap, Scan, View
from splatseg.errors import InputError, RangeError
from splatseg.fit import scan_depths
from splatseg.street.depth_views import (
    capture_views,
    evidence_views,
    field_views,
    point_views,
    scan_views,
)
from support.analytic import BallOverFloor


def camera(width: int = 20, height: int = 12) -> Camera:
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
    cameras = [camera(), camera(10, 6)]
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
    (view,) = point_views(both, [camera()])
    assert set(view.depth.unique().tolist()) == {0.0, 2.0}
    few = torch.tensor([[0.0, 0, 3], [0.4, 0, 3]])
    (view,) = point_views(few, [camera()])
    assert int((view.depth == 3).sum()) == 2


def test_points_that_tell_nothing_are_refused() -> None:
    with pytest.raises(InputError, match="points: expected at least one point to see"):
        list(point_views(torch.zeros(0, 3), [camera()]))
    with pytest.raises(RangeError, match="points: .* not finite"):
        list(point_views(torch.full((1, 3), torch.nan), [camera()]))


def saved(folder: Path, name: str, values: np.ndarray) -> View:
    np.save(folder / f"{name}.npy", values)
    return View(name=name, camera=camera(), depth=folder / f"{name}.npy", depth_unit=0.5)


def test_maps_of_a_capture_have_the_pixels_of_their_file(tmp_path: Path) -> None:
    values = np.full((6, 10), 4.0, dtype=np.float32)
    values[0, 0] = np.nan
    views = list(capture_views([saved(tmp_path, "a", values), View(name="b", camera=camera())]))
    assert len(views) == 1
    assert (views[0].camera.width, views[0].camera.fx) == (10, 10)
    assert views[0].depth[0, 0] == 0
    assert views[0].depth[3, 3] == 2


def test_relative_maps_of_a_capture_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, depth=np.ones((6, 10), dtype=np.float32), kind=np.array("relative"))
    view = View(name="a", camera=camera(), depth=path)
    with pytest.raises(InputError, match="view 'a': expected a metric depth map"):
        list(capture_views([view]))


def test_metric_evidence_is_metres() -> None:
    source = Maps(DepthMap(values=torch.full((6, 10), 3.0), kind="metric"))
    view = View(name="a", camera=camera())
    (found,) = evidence_views(source, [view], metres_per_unit=1.5)
    assert (found.camera.height, found.depth[0, 0].item()) == (6, 2.0)


def test_relative_evidence_is_aligned_to_points() -> None:
    """Inverse depth times 3 plus 1: two walls, left and right."""
    depth = torch.full((12, 20), 4.0)
    depth[:, 10:] = 2.0
    source = Maps(DepthMap(values=3 / depth + 1, kind="relative"))
    view = View(name="a", camera=camera())
    points = camera().unproject(camera().pixel_centres(), depth).reshape(-1, 3)
    (found,) = evidence_views(source, [view], points=points)
    torch.testing.assert_close(found.depth, depth, rtol=1e-3, atol=1e-3)
    assert not list(evidence_views(source, [view], points=points[:5]))
    with pytest.raises(InputError, match="points: expected points to align the relative depth"):
        list(evidence_views(source, [view]))


def test_a_field_shows_its_depth_where_it_is_opaque() -> None:
    field = BallOverFloor()
    (found,) = field_views(field, [camera()])
    with field.view(camera()) as view:
        signals = view.signals(colour=False)
    wanted = signals.depth if signals.median_depth is None else signals.median_depth
    assert torch.equal(found.depth, torch.where(signals.alpha >= 0.5, wanted, 0.0).float())
    assert int((found.depth > 0).sum()) > 20
    assert field.open == 0
