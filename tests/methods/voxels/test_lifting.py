"""Features of pixels summed onto voxels, against twins, identities and scenes solved by hand."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter1d

from lift.conftest import BACKEND, camera_at, gaussians_at, random_gaussians
from methods.voxels import reference
from splatseg import _native
from splatseg.core import UNLABELLED, FeatureMap, Labels, View
from splatseg.core.sh import base_colours
from splatseg.core.voxels import VoxelGrid
from splatseg.errors import InputError, ShapeError
from splatseg.lift import label_map
from splatseg.lift.neighbour_graph import NodeAttributes, neighbour_graph
from splatseg.lift.voting.features import uplift_features
from splatseg.methods.voxels.grid import nearest_voxels, surface_gaussians, voxelise
from splatseg.methods.voxels.lifting import conjugate_gradients, lift_to_voxels


@dataclass(frozen=True)
class Grids:
    """Feature maps by view name."""

    maps: dict[str, FeatureMap]

    @property
    def view_names(self) -> tuple[str, ...]:
        return tuple(self.maps)

    def features(self, name: str) -> FeatureMap:
        return self.maps[name]


def view_at(name: str, x: float, z: float = 0.0) -> View:
    """A view along z from (x, 0, z)."""
    camera = camera_at(x)
    pose = camera.cam_from_world.clone()
    pose[2, 3] = -z
    return View(name=name, camera=replace(camera, cam_from_world=pose))


def views_of(count: int) -> list[View]:
    return [view_at(f"v{i}", 0.3 * i) for i in range(count)]


def random_grids(rng, views, *, stride: int = 4, channels: int = 5) -> Grids:
    shape = (12 // stride, 16 // stride, channels)
    return Grids(
        {
            view.name: FeatureMap(
                features=torch.from_numpy(rng.normal(size=shape)),
                stride=stride,
                height=12,
                width=16,
            )
            for view in views
        }
    )


def constant_grids(views, values) -> Grids:
    return Grids(
        {
            view.name: FeatureMap(
                features=torch.tensor(value).float().expand(3, 4, -1),
                stride=4,
                height=12,
                width=16,
            )
            for view, value in zip(views, values, strict=True)
        }
    )


@pytest.fixture
def scene(rng):
    """A cloud of Gaussians of many colours, its voxels, views of it and features of these."""
    gaussians = random_gaussians(rng, 60)
    colours = rng.normal(size=gaussians.sh.shape, scale=0.5)
    gaussians = replace(gaussians, sh=torch.from_numpy(colours).to(gaussians.sh.dtype))
    grid, views = voxelise(gaussians.means, 0.4), views_of(3)
    return gaussians, grid, views, random_grids(rng, views)


def lift(scene, features=None, views=None, hits="solved", **more):
    gaussians, grid, own, usual = scene
    views, features = own if views is None else views, usual if features is None else features
    return lift_to_voxels(grid, views, features, gaussians, hits=hits, backend=BACKEND, **more)


@pytest.mark.parametrize("each", [1, 3])
@pytest.mark.parametrize("view_means", [False, True])
def test_sums_are_those_of_the_reference(rng, each: int, view_means: bool) -> None:
    height, width, voxels, channels = 6, 7, 9, 4
    hits = torch.from_numpy(rng.integers(-1, voxels, (height * width, each))).int()
    weights = torch.from_numpy(rng.random((height * width, each))).float()
    features = torch.from_numpy(rng.normal(size=(3, 4, channels))).float()
    taps = []
    for cells, pixels in ((3, height), (4, width)):
        first = torch.from_numpy(rng.integers(0, cells, pixels))
        second = torch.from_numpy(rng.integers(0, cells, pixels))
        taps.append(
            (torch.stack((first, second)).int(), torch.from_numpy(rng.random(pixels)).float())
        )
    (rows, down), (columns, right) = taps
    image = torch.zeros(height, width, channels)
    for y in range(height):
        for x in range(width):
            upper = torch.lerp(
                features[rows[0, y], columns[0, x]], features[rows[0, y], columns[1, x]], right[x]
            )
            lower = torch.lerp(
                features[rows[1, y], columns[0, x]], features[rows[1, y], columns[1, x]], right[x]
            )
            image[y, x] = torch.lerp(upper, lower, down[y])
    for given in (None, weights):
        sums, totals = torch.zeros(voxels, channels), torch.zeros(voxels, dtype=torch.float64)
        _native.add_hit_features(
            rows, down, columns, right, hits, given, features, view_means, sums, totals
        )
        wanted = torch.zeros(voxels, channels, dtype=torch.float64)
        counted = torch.zeros(voxels, dtype=torch.float64)
        reference.add_hit_features(
            image.reshape(-1, channels), hits, weights=given, view_means=view_means,
            sums=wanted, totals=counted,
        )  # fmt: skip
        torch.testing.assert_close(sums.double(), wanted, rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(totals, counted, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("hits", ["first", "solved"])
def test_one_feature_everywhere_is_what_every_voxel_gets(scene, hits: str) -> None:
    lifted = lift(scene, constant_grids(scene[2], [[2.0, -1.0]] * 3), hits=hits)
    hit = lifted.totals > 0
    assert bool(hit.any())
    torch.testing.assert_close(
        lifted.values[hit], torch.tensor([[2.0, -1.0]]).expand(int(hit.sum()), -1)
    )
    if hits != "solved":
        assert float(lifted.values[~hit].abs().sum()) == 0


@pytest.mark.bits
def test_the_order_of_views_and_the_threads_make_no_difference(scene) -> None:
    first = lift(scene, hits="first")
    before = _native.threads()
    try:
        for threads in (1, 3):
            _native.set_threads(threads)
            again = lift(scene, views=scene[2][::-1], hits="first")
            assert torch.equal(first.values, again.values)
            assert torch.equal(first.totals, again.totals)
    finally:
        _native.set_threads(before)


def test_rays_begin_and_end_where_constants_say(scene, monkeypatch) -> None:
    usual = lift(scene, hits="first")
    for name, value in (("_NEAR", 3.0), ("_FAR", 2.5)):
        with monkeypatch.context() as patch:
            patch.setattr(f"splatseg.methods.voxels.lifting.{name}", value)
            assert not torch.equal(usual.totals, lift(scene, hits="first").totals)


def test_the_nearest_voxel_by_hand() -> None:
    """Two voxels side by side, of side 2, with centres at x = 1 and x = 3."""
    grid = voxelise(torch.tensor([[0.0, 0, 0], [3.0, 1, 1]]), 2.0)
    points = torch.tensor([[1.5, 1, 1], [2.5, 1, 1], [1.0, 1, 1], [3.0, 1.0, 6.5], [40.0, 0, 0]])
    assert nearest_voxels(grid, points).tolist() == [0, 1, 0, 1, 1]


def test_the_first_voxel_of_a_ray_gets_what_its_pixel_shows() -> None:
    """Two voxels side by side before the camera, and a third behind the left one, out of sight."""
    points = torch.tensor([[-2.0, -1.0, 3.0], [0.5, 0.0, 3.5], [-1.0, 0.0, 5.5]])
    grid = voxelise(points, 2.0)
    left, right, behind = nearest_voxels(grid, points).tolist()
    view = view_at("v", 0.0)
    view = replace(view, camera=replace(view.camera, fx=12.0, fy=12.0))
    columns = torch.tensor([1.0, 1, 0, 0])[None, :, None].expand(3, 4, 1)
    features = Grids({"v": FeatureMap(features=columns, stride=4, height=12, width=16)})
    found = lift((gaussians_at(points), grid, [view], features), hits="first")
    # 8 columns each and rows 2 to 9; from cell to cell 7/8, 5/8, 3/8 and 1/8.
    assert found.totals[[left, right, behind]].tolist() == [64, 64, 0]
    expected = torch.tensor([[7.5 / 8], [0.5 / 8], [0]])
    torch.testing.assert_close(found.values[[left, right, behind]], expected)


def test_what_is_no_surface_is_left_out(monkeypatch) -> None:
    """One Gaussian breaks each rule; the others are a sheet."""
    x, y = torch.meshgrid(torch.arange(6.0), torch.arange(6.0), indexing="ij")
    means = torch.stack((x.reshape(-1), y.reshape(-1), torch.zeros(36)), dim=1)
    gaussians = gaussians_at(torch.cat((means, torch.tensor([[2.5, 2.5, 90.0]]))).tolist())
    scales = torch.full((37, 3), 0.1)
    scales[:, 2] = 0.001  # flat ones are no needles
    scales[0] = torch.tensor([3.0, 0.01, 0.01])
    scales[1] = torch.tensor([50.0, 50.0, 0.1])
    opacities = torch.full((37,), 0.9)
    opacities[2] = 0.05
    gaussians = replace(gaussians, scales=scales, opacities=opacities)

    def left_out(**constants) -> list[int]:
        with monkeypatch.context() as patch:
            for name, value in constants.items():
                patch.setattr(f"splatseg.methods.voxels.grid.{name}", value)
            return torch.nonzero(~surface_gaussians(gaussians)).squeeze(1).tolist()

    # Ten times the median distance to the fourth nearest reaches the whole sheet.
    assert left_out(_SCALE_SHARE=36 / 37) == [0, 1, 2, 36]
    assert left_out(_SCALE_SHARE=1.0) == [0, 2, 36]
    scales[3], scales[4] = torch.tensor([0.31, 0.01, 0.01]), torch.tensor([0.29, 0.01, 0.01])
    assert left_out(_SCALE_SHARE=1.0) == [0, 2, 3, 36]
    scales[3:5] = scales[5]
    assert left_out(_SCALE_SHARE=36 / 37, _MAX_ELONGATION=1e9) == [1, 2, 36]
    assert left_out(_SCALE_SHARE=36 / 37, _MIN_OPACITY=0.0) == [0, 1, 36]
    assert left_out(_SCALE_SHARE=36 / 37, _NEAREST_FACTOR=1e3) == [0, 1, 2]
    monkeypatch.setattr("splatseg.methods.voxels.grid._OPAQUE_RADIUS", 100.0)
    half = surface_gaussians(gaussians, rule="opaque")
    assert int(half.sum()) == 18
    assert not bool(half[2])
    monkeypatch.setattr("splatseg.methods.voxels.grid._OPAQUE_RADIUS", 1.5)
    assert 0 < int(surface_gaussians(gaussians, rule="opaque").sum()) < 18
    monkeypatch.setattr("splatseg.methods.voxels.grid._MIN_NEIGHBOURS", 60)
    with pytest.raises(InputError, match="none of 37 does"):
        surface_gaussians(gaussians)


def test_bad_input_is_refused(scene) -> None:
    _, _, views, features = scene
    with pytest.raises(InputError, match="features of every view"):
        lift(scene, views=[*views, View(name="w", camera=views[0].camera)])
    broken = random_grids(np.random.default_rng(1), views)
    broken.maps["v1"].features[0, 0, 0] = torch.nan
    with pytest.raises(InputError, match="finite features of view v1"):
        lift(scene, broken)
    other = random_grids(np.random.default_rng(1), views, channels=3)
    mixed = Grids({**features.maps, "v2": other.maps["v2"]})
    for hits in ("first", "solved"):
        with pytest.raises(ShapeError, match="expected 5 channels of view v2"):
            lift(scene, mixed, hits=hits)
    with pytest.raises(InputError, match="hits"):
        lift(scene, hits="last")
    with pytest.raises(InputError, match="views"):
        lift(scene, views=[])


@pytest.mark.parametrize(
    ("blur", "smoothness", "stride"), [(0.0, 0.3, 4), (0.8, 0.1, 4), (0.8, 0.1, 5)]
)
def test_against_the_dense_equations(rng, scene, monkeypatch, blur, smoothness, stride) -> None:
    """With cells of 5 pixels the last ones have more, those beyond the last whole cell."""
    monkeypatch.setattr("splatseg.methods.voxels.lifting._TOLERANCE", 1e-6)
    monkeypatch.setattr("splatseg.methods.voxels.lifting._STEPS", 300)
    monkeypatch.setattr("splatseg.methods.voxels.lifting.BLUR", blur)
    monkeypatch.setattr("splatseg.methods.voxels.lifting.SMOOTHNESS", smoothness)
    gaussians, grid, views, _ = scene
    rows = nearest_voxels(grid, gaussians.means)
    grids, count = random_grids(rng, views, stride=stride), len(grid)
    down, right = 12 // stride, 16 // stride
    pixels = np.zeros((down, right))
    for y in range(12):
        for x in range(16):
            pixels[min(y // stride, down - 1), min(x // stride, right - 1)] += 1
    labels = Labels(ids=rows.int(), confidence=torch.ones(len(rows)), background=UNLABELLED)
    shares, features = [], []
    for view in sorted(views, key=lambda one: one.name):
        ids = label_map(gaussians, view.camera, labels, backend=BACKEND).ids.numpy()
        part = np.zeros((down, right, count))
        for y in range(12):
            for x in range(16):
                if ids[y, x] >= 0:
                    cell = min(y // stride, down - 1), min(x // stride, right - 1)
                    part[(*cell, ids[y, x])] += 1 / pixels[cell]
        if blur:
            for axis in (0, 1):
                part = gaussian_filter1d(part, blur, axis=axis, mode="reflect")
        shares.append(part.reshape(down * right, count))
        features.append(grids.features(view.name).features.double().flatten(0, 1).numpy())
    a, f = np.concatenate(shares), np.concatenate(features)
    own = base_colours(gaussians.sh).double().numpy()
    colours = np.stack([own[rows.numpy() == k].mean(axis=0) for k in range(count)])
    graph = neighbour_graph(
        NodeAttributes(positions=grid.centres.numpy(), colours=colours.astype(np.float32)),
        neighbours=16,
        colour_width=0.2,
        feature_width=1.0,
    ).toarray()
    laplacian = np.diag(graph.sum(axis=1)) - graph
    mean = f.mean(axis=0)
    matrix = a.T @ a + smoothness * laplacian + 0.05 * np.eye(count)
    expected = np.linalg.solve(matrix, a.T @ (f - mean)) + mean
    found = lift(scene, grids)
    np.testing.assert_allclose(found.values.numpy(), expected, atol=2e-4)
    np.testing.assert_allclose(found.totals.numpy(), a.sum(axis=0), atol=1e-6)


def test_two_in_one_cell_are_told_apart(monkeypatch) -> None:
    """Left and right of a cell's middle in shares that differ from view to view: means mix them."""
    gaussians = gaussians_at(torch.tensor([[-0.4, 0.0, 2.0], [0.4, 0.0, 2.0]]), scale=0.25)
    grid = voxelise(gaussians.means, 0.5)
    rows = nearest_voxels(grid, gaussians.means)
    views = [view_at(f"v{i}", 0.25 * (i - 2)) for i in range(5)]
    labels = Labels(ids=rows.int(), confidence=torch.ones(2), background=UNLABELLED)
    true = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    maps = {}
    for view in views:
        ids = label_map(gaussians, view.camera, labels, backend=BACKEND).ids.long()
        seen = torch.where((ids >= 0)[..., None], true[ids.clamp_min(0)], 0.5)
        cells = seen.reshape(3, 4, 4, 4, 2).mean(dim=(1, 3))
        maps[view.name] = FeatureMap(features=cells, stride=4, height=12, width=16)

    two = (gaussians, grid, views, Grids(maps))
    monkeypatch.setattr("splatseg.methods.voxels.lifting.BLUR", 0.0)
    monkeypatch.setattr("splatseg.methods.voxels.lifting.SMOOTHNESS", 0.0)
    apart = lift(two).values
    mixed = uplift_features(gaussians, views, two[3], backend=BACKEND).values[rows.argsort()]
    assert float((apart - true).abs().max()) < 0.1
    assert float((mixed - true).abs().max()) > 0.2


def test_two_halves_of_a_wall_draw_on_each_other_by_hand(monkeypatch) -> None:
    """Each makes 6 whole cells, which show 1 and -1: (6 + 0.05 + 0.7 w) x - 0.7 w (-x) = 6.

    The strength w is exp(-1/2) of two that are each other's farthest neighbour and of one colour.
    """
    view = view_at("v", 0.0)
    rays = view.camera.rays()[1].reshape(-1, 3)  # a small Gaussian in the middle of each pixel
    gaussians = gaussians_at(4 * rays / rays[:, 2:], scale=0.05)
    cells = torch.tensor([[0, 0, 0], [1, 0, 0]])
    grid = VoxelGrid(cells=cells, size=4.0, origin=torch.tensor([-4.0, -2.0, 2.0]))
    columns = torch.tensor([1.0, 1, -1, -1])[None, :, None].expand(3, 4, 1)
    features = Grids({"v": FeatureMap(features=columns, stride=4, height=12, width=16)})
    monkeypatch.setattr("splatseg.methods.voxels.lifting.BLUR", 0.0)
    found = lift((gaussians, grid, [view], features))
    assert found.totals.tolist() == pytest.approx([6, 6])
    own = 6 / (6.05 + 2 * 0.7 * math.exp(-0.5))
    assert found.values[:, 0].tolist() == pytest.approx([own, -own], abs=1e-3)


def test_progress_counts_views_and_parts_of_channels(scene, monkeypatch) -> None:
    whole = lift(scene).values
    monkeypatch.setattr("splatseg.methods.voxels.lifting._CHANNELS", 2)
    calls = []
    found = lift(scene, progress=lambda *one: calls.append(one))
    assert calls == [(done, 6) for done in range(1, 7)]
    torch.testing.assert_close(whole, found.values, atol=1e-3, rtol=0)


def test_conjugate_gradients(rng) -> None:
    root = rng.normal(size=(9, 9)).astype(np.float32)
    matrix = root @ root.T + 3 * np.eye(9, dtype=np.float32)
    right = rng.normal(size=(9, 3)).astype(np.float32)
    right[:, 1] = 0
    scale = (1 / matrix.diagonal())[:, None].astype(np.float32)
    found = conjugate_gradients(lambda x: matrix @ x, right, scale)
    np.testing.assert_allclose(found, np.linalg.solve(matrix, right), atol=2e-3)
    assert not found[:, 1].any()


def test_a_voxel_that_no_view_shows_is_as_its_neighbours(rng, scene) -> None:
    gaussians, _, views, _ = scene
    behind = replace(
        gaussians, means=torch.cat((gaussians.means[:-1], torch.tensor([[0, 0, -5.0]])))
    )
    grid = voxelise(behind.means, 0.4)
    rows = nearest_voxels(grid, behind.means)
    found = lift((behind, grid, views, random_grids(rng, views)))
    hidden = int(rows[-1])
    assert float(found.totals[hidden]) == 0
    graph = neighbour_graph(
        NodeAttributes(positions=grid.centres.numpy()),
        neighbours=16, colour_width=1.0, feature_width=1.0,
    )  # fmt: skip
    near = graph[hidden].indices
    beside, own = found.values[near], found.values[hidden]
    assert bool((own >= beside.amin(dim=0) - 0.05).all())
    assert bool((own <= beside.amax(dim=0) + 0.05).all())
