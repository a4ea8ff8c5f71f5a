"""Depth maps of scans: what hides what, by hand and on a plane."""

from collections.abc import Mapping
from dataclasses import dataclass

import pytest
import torch

from splatseg.core import Camera, Scan
from splatseg.errors import ShapeError
from splatseg.fit import DepthPoints, scan_depths
from splatseg.fit.depth import unhidden

INF = torch.inf


@dataclass
class Scans:
    """Scans in memory, and the names that were asked for."""

    points: Mapping[str, torch.Tensor]

    def __post_init__(self) -> None:
        self.asked: list[str] = []

    @property
    def scan_names(self):
        return tuple(self.points)

    def scan(self, name: str) -> Scan:
        self.asked.append(name)
        return Scan(name=name, points=self.points[name])


def camera(x: float = 0.0) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = -x
    return Camera(width=9, height=7, fx=10, fy=10, cx=4.5, cy=3.5, cam_from_world=pose)


def maps(points, cameras=None, **words) -> list[torch.Tensor]:
    named = {f"{i}": torch.tensor(part, dtype=torch.float64) for i, part in enumerate(points)}
    return list(scan_depths(Scans(named), cameras or [camera()], **words))


def test_the_nearest_point_of_a_pixel_counts_of_whatever_scan() -> None:
    (found,) = maps([[[0, 0, 5.0], [0, 0, 3.0]], [[0, 0, 4.0], [1.2, 0, 4.0], [0, 0, -2.0]]])
    expected = torch.zeros(7, 9)
    expected[3, 4], expected[3, 7] = 3, 4
    torch.testing.assert_close(found, expected)


def test_what_is_at_the_lens_is_the_vehicle() -> None:
    assert float(maps([[[0, 0, 0.29]]])[0].max()) == 0
    assert float(maps([[[0, 0, 0.31]]])[0].max()) == pytest.approx(0.31)
    # A unit of ten metres: 0.31 of it is far from the lens, and so is 0.05.
    assert float(maps([[[0, 0, 0.05]]], metres_per_unit=10.0)[0].max()) == pytest.approx(0.05)


def test_sparse_surfaces_hide_what_is_behind_them_between_their_points() -> None:
    depth = torch.full((5, 7), INF)
    depth[2, 1], depth[2, 3], depth[2, 6] = 2.0, 9.0, 9.0
    # r = ceil(10 x 0.4 / 2 - 0.5) = 2 pixels: up to the column 3, and not the column 6.
    given = {"focal": 10.0, "spacing": 0.4, "tolerance": 0.1, "relative_tolerance": 0.0}
    found = unhidden(depth, **given)
    assert found[2].tolist() == [0, 2, 0, 0, 0, 0, 9]
    assert unhidden(depth, **{**given, "spacing": 0.25})[2, 3] == 9
    assert unhidden(depth, **{**given, "tolerance": 7.0})[2, 3] == 9
    assert unhidden(depth, **{**given, "relative_tolerance": 3.5})[2, 3] == 9


def test_a_slanted_surface_hides_nothing_of_itself() -> None:
    depth = torch.linspace(4.0, 4.4, 9).repeat(7, 1)
    found = unhidden(depth, focal=50.0, spacing=0.08, tolerance=0.1, relative_tolerance=0.02)
    assert torch.equal(found, depth)


def test_spacing_and_tolerances_are_metres(monkeypatch: pytest.MonkeyPatch) -> None:
    points = [[[0, 0, 2.0], [1.0, 0, 5.0]]]
    assert maps(points)[0][3, 6] == 5
    assert maps(points, spacing=0.4)[0][3, 6] == 0
    assert maps(points, spacing=0.4, metres_per_unit=10.0)[0][3, 6] == 5
    for name, value in (("_TOLERANCE", 3.0), ("_RELATIVE_TOLERANCE", 1.6)):
        with monkeypatch.context() as changed:
            changed.setattr(f"splatseg.fit.depth.{name}", value)
            assert maps(points, spacing=0.4)[0][3, 6] == 5


def test_views_at_a_time_change_nothing_but_how_often_scans_are_read(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    points = {f"{i}": torch.rand(50, 3, generator=torch.manual_seed(i)) * 4 for i in range(2)}
    cameras = [camera(x) for x in (0.0, 0.5, 1.0)]
    one, two = Scans(points), Scans(points)
    whole = list(scan_depths(one, cameras))
    monkeypatch.setattr("splatseg.fit.depth._VIEWS", 2)
    parts = list(scan_depths(two, cameras))
    assert all(torch.equal(a, b) for a, b in zip(whole, parts, strict=True))
    assert (len(one.asked), len(two.asked)) == (2, 4)


def test_points_of_depths_are_where_they_were_measured_with_their_colour() -> None:
    at = torch.tensor([[-0.2, 0.0, 3.1], [1.0, 0.0, 4.1]], dtype=torch.float64)
    views = [camera(0.0), camera(0.02)]
    image = torch.zeros(7, 9, 3, dtype=torch.uint8)
    image[:, 5:] = 200
    points = DepthPoints(0.5)
    for view, depth in zip(views, scan_depths(Scans({"0": at}), views), strict=True):
        points.add(view, depth, image)
    cloud = points.cloud()
    assert len(cloud) == 2
    # A pixel is 0.3 wide at 3: the centre of the pixel stands for the point.
    assert float((cloud.points.double() - at).abs().max()) < 0.2
    assert cloud.colours is not None
    assert cloud.colours.tolist() == [[0, 0, 0], [200, 200, 200]]
    with pytest.raises(ShapeError, match="image"):
        points.add(views[0], torch.ones(7, 9), image[:3])
