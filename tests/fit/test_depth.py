"""Depth maps as supervision, and those of laser scans."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import Camera, DepthMap, PointCloud, Scan, View
from splatseg.errors import FileFormatError, InputError, MissingFileError, ShapeError
from splatseg.fit import DepthPoints, FitOptions, fit, scan_depths
from splatseg.fit.depth import DepthMaps, aligned_inverse, unhidden
from splatseg.io.depths import load_depth
from splatseg.io.evidence import save_depth_map
from splatseg.render import render

OPTIONS = FitOptions(minutes=None, steps=1, depth="metric", depth_weight=0.5)


def _camera(width: int, height: int) -> Camera:
    return Camera(
        width=width,
        height=height,
        fx=8.0,
        fy=8.0,
        cx=width / 2,
        cy=height / 2,
        cam_from_world=torch.eye(4),
    )


def _maps(folder: Path, values: np.ndarray, *, width: int, height: int, **changes) -> DepthMaps:
    np.save(folder / "depth.npy", values)
    view = View(
        name="one",
        camera=_camera(width, height),
        image=folder / "one.png",
        depth=folder / "depth.npy",
        depth_unit=1.0,
    )
    options = replace(OPTIONS, **changes)
    return DepthMaps([view], points=None, options=options, where=str(folder))


def test_the_loss_by_hand(tmp_path: Path) -> None:
    """Measured 2, 4, unknown, 4, 2 with median 4; drawn 4, 4, 9, 2 and, too faint, 8.

    The differences of 4 / depth are -1, 0, 1; of three pixels, times 0.5.
    """
    maps = _maps(tmp_path, np.array([[2.0, 4, 0, 4, 2]]), width=5, height=1)
    drawn = torch.tensor([[4.0, 4, 9, 2, 8]])
    alpha = torch.tensor([[1.0, 1, 1, 0.5, 0.49]])
    # Inverse depths 0.5, 0.25, 0.25, 0.5: torch's median is the lower one, of depth 4.
    loss = maps.loss(0, drawn, alpha, progress=0.0)
    assert loss.value == pytest.approx(0.5 * (1 + 0 + 1) / 3)
    # d |4 / d - 4 / D| / d d = -+ 4 / d^2.
    expected = 0.5 / 3 * torch.tensor([[4 / 16, 0, 0, -4 / 4, 0]])
    assert torch.allclose(loss.gradient, expected)
    masked = torch.tensor([[True, True, True, False, True]])
    assert maps.loss(0, drawn, alpha, progress=0.0, mask=masked).value == pytest.approx(0.25)
    late = maps.loss(0, drawn, alpha, progress=1.0)
    assert late.value == pytest.approx(0.01 * loss.value)
    assert maps.loss(0, drawn, torch.zeros(1, 5), progress=0.0).value == 0


def test_the_gradient_is_that_of_the_value(tmp_path: Path, rng: np.random.Generator) -> None:
    maps = _maps(tmp_path, rng.uniform(1, 9, (6, 8)), width=8, height=6)
    drawn = torch.from_numpy(rng.uniform(1, 9, (6, 8))).float()
    alpha = torch.ones(6, 8)
    depth_gradient = maps.loss(0, drawn, alpha, progress=0.3).gradient
    move = torch.from_numpy(rng.normal(size=(6, 8))).float()
    h = 1e-3
    up, down = (maps.loss(0, drawn + s * h * move, alpha, progress=0.3).value for s in (1, -1))
    assert (up - down) / (2 * h) == pytest.approx(float((depth_gradient * move).sum()), rel=2e-2)


def test_a_gaussian_before_the_lens_does_not_drown_the_rest(tmp_path: Path) -> None:
    maps = _maps(tmp_path, np.full((1, 2), 4.0), width=2, height=1)
    loss = maps.loss(0, torch.tensor([[1e-6, 8.0]]), torch.ones(1, 2), progress=0.0)
    # At a tenth of the median the gradient is 4 / 0.4^2, and no more below.
    assert float(loss.gradient[0, 0]) == pytest.approx(-0.25 * 4 / 0.16)
    assert loss.value == pytest.approx(0.25 * (10 - 1 + 0.5))


@pytest.mark.parametrize(("width", "height"), [(8, 6), (4, 3), (2, 3)])
def test_maps_of_another_size(tmp_path: Path, width: int, height: int) -> None:
    """A map of 4 x 3 and a rendering of any size: compared at the coarser one, no blending."""
    values = np.array([[1.0, 2, 3, 4], [5, 6, 7, 8], [9, 10, 11, 12]])
    maps = _maps(tmp_path, values, width=8, height=6)
    truth = torch.from_numpy(values).float()
    rows = torch.arange(height) * 3 // height
    columns = torch.arange(width) * 4 // width
    exact = truth[rows][:, columns]
    loss = maps.loss(0, exact, torch.ones(height, width), progress=0.0)
    assert loss.value == pytest.approx(0, abs=1e-6)
    off = maps.loss(0, exact * 1.1, torch.ones(height, width), progress=0.0)
    compared = min(width, 4) * min(height, 3)
    assert int((off.gradient > 0).sum()) == compared


def test_relative_maps_are_aligned_by_points(rng: np.random.Generator) -> None:
    """A map a / z + b at points of known z becomes 1 / z; hidden points do not matter much."""
    camera = _camera(40, 30)
    depth = torch.from_numpy(rng.uniform(2, 10, (30, 40))).float()
    values = 700 / depth + 150
    pixels = camera.pixel_centres().reshape(-1, 2)[::3]
    points = camera.unproject(pixels, depth.reshape(-1)[::3].double())
    behind = torch.tensor([[0.0, 0.0, -3.0], [90.0, 0.0, 1.0]]).double()
    found = aligned_inverse(values, camera, torch.cat((points, behind)).float())
    assert torch.allclose(found, 1 / depth, atol=4e-3)
    hidden = points.clone()
    hidden[::3] *= 1.5
    found = aligned_inverse(values, camera, hidden.float())
    assert torch.allclose(found, 1 / depth, atol=4e-3)
    assert aligned_inverse(values, camera, points[:19].float()) is None
    assert aligned_inverse(torch.full((30, 40), 5.0), camera, points.float()) is None


def test_what_a_depth_map_may_be(tmp_path: Path) -> None:
    view = View(name="one", camera=_camera(2, 1), depth=tmp_path / "d.png", depth_unit=0.5)
    Image.fromarray(np.array([[4, 0]], np.uint16)).save(view.depth)
    assert load_depth(view).tolist() == [[2.0, 0.0]]
    np.save(tmp_path / "d.npy", np.array([[[3.0], [np.nan]], [[-1.0], [np.inf]]]))
    assert load_depth(replace(view, depth=tmp_path / "d.npy")).tolist() == [[1.5, 0], [0, 0]]
    Image.fromarray(np.array([[2.5, 1]], np.float32)).save(tmp_path / "d.tiff")
    assert load_depth(replace(view, depth=tmp_path / "d.tiff")).tolist() == [[1.25, 0.5]]
    Image.fromarray(np.zeros((1, 2, 3), np.uint8)).save(tmp_path / "rgb.png")
    with pytest.raises(FileFormatError, match="of one channel"):
        load_depth(replace(view, depth=tmp_path / "rgb.png"))
    with pytest.raises(MissingFileError):
        load_depth(replace(view, depth=tmp_path / "none.npy"))
    (tmp_path / "bad.npy").write_bytes(b"no array")
    with pytest.raises(FileFormatError, match="expected an array of NumPy"):
        load_depth(replace(view, depth=tmp_path / "bad.npy"))
    with pytest.raises(InputError, match="a view with a depth map"):
        load_depth(replace(view, depth=None))


def test_there_must_be_something_to_learn_from(photograph) -> None:
    capture = photograph(count=4)
    options = replace(OPTIONS, steps=1)
    with pytest.raises(InputError, match="expected depth maps of training views"):
        fit(capture, options=options)
    with_maps = replace(
        capture, views=tuple(replace(v, depth=v.image) for v in capture.views), points=None
    )
    with pytest.raises(InputError, match="start points to align relative depth maps"):
        fit(with_maps, options=replace(options, depth="relative", start="random"))


@pytest.mark.parametrize("kind", ["metric", "relative"])
def test_depth_maps_make_the_depth_right(photograph, scene_photographed, kind: str) -> None:
    """Five photographs of a thing of one colour leave its shape open; maps settle some of it."""
    scene = scene_photographed.replace(sh=torch.full_like(scene_photographed.sh, 0.4))
    capture = photograph(scene=scene, count=5, noise=0.12, depth_step=2)
    if kind == "relative":
        views, points = [], []
        for view in capture.views:
            depth = load_depth(view).numpy()
            inverse = np.where(depth > 0, 5000 / np.maximum(depth, 1e-3) + 900, 0)
            Image.fromarray(inverse.astype(np.uint16)).save(view.depth)
            views.append(replace(view, depth_unit=1.0))
            # Points as structure from motion finds them, on the surface.
            pixels = view.camera.pixel_centres()[::2, ::2][depth > 0][::25]
            z = torch.from_numpy(depth[depth > 0][::25]).double()
            points.append(view.camera.unproject(pixels, z).float())
        cloud = torch.cat(points)
        capture = replace(capture, views=tuple(views), points=PointCloud(points=cloud))
    options = FitOptions(minutes=None, steps=400, max_gaussians=150, background="black")
    errors = []
    for depth in ("off", kind):
        found = fit(capture, options=replace(options, depth=depth, depth_weight=1.0)).gaussians
        wrong = []
        for view in capture.train_views:
            with torch.no_grad():
                drawn, true = render(found, view.camera), render(scene, view.camera)
            both = (drawn.alpha > 0.5) & (true.alpha > 0.5)
            wrong.append(float((drawn.depth - true.depth)[both].abs().mean()))
        errors.append(sum(wrong) / len(wrong))
    # Start points on the surface leave less to settle than wrong ones.
    most = 0.93 if kind == "metric" else 0.97
    assert errors[1] < most * errors[0], errors


def _evidence_maps(folder: Path, truth: np.ndarray, kind: str, **changes) -> DepthMaps:
    """Maps of a view whose depths are an npz of evidence, with points on the surface."""
    camera = _camera(truth.shape[1], truth.shape[0])
    z = torch.from_numpy(truth)
    points = camera.unproject(camera.pixel_centres().reshape(-1, 2), z.reshape(-1).double())
    values = truth if kind == "metric" else 7 / truth + 3
    save_depth_map(DepthMap(values=torch.from_numpy(values).float(), kind=kind), folder, "one")
    view = View(name="one", camera=camera, depth=folder / "one.npz", depth_unit=1.0)
    options = replace(OPTIONS, **changes)
    return DepthMaps([view], points=points.float(), options=options, where=str(folder))


def test_evidence_tells_what_it_is(tmp_path: Path, rng: np.random.Generator) -> None:
    """The same surfaces as metres, as metres that count as relative, and as inverse depth."""
    depth = rng.uniform(2, 9, (6, 8)).round(1)
    losses = {}
    for kind, use in (("metric", "metric"), ("metric", "relative"), ("relative", "relative")):
        maps = _evidence_maps(tmp_path, depth, kind, depth=use)
        drawn, alpha = torch.from_numpy(depth).float() * 1.1, torch.ones(6, 8)
        losses[kind, use] = maps.loss(0, drawn, alpha, progress=0.0).value
        exact = maps.loss(0, torch.from_numpy(depth).float(), alpha, progress=0.0).value
        assert exact < 0.03 * losses[kind, use], "the points and the map agree"
    first = losses["metric", "metric"]
    assert list(losses.values()) == pytest.approx([first] * 3, rel=0.03)
    with pytest.raises(InputError, match=r"expected metric depth maps, got relative ones \(view"):
        _evidence_maps(tmp_path, depth, "relative", depth="metric")


# Depth maps of scans: what hides what, by hand and on a plane.


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
