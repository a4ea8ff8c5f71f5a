"""Features of pixels summed onto voxels, against twins, identities and scenes solved by hand."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from lift.conftest import BACKEND, camera_at, gaussians_at, random_gaussians
from splatseg import _native
from splatseg.core import FeatureMap, View
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.lift.voting.features import uplift_features
from splatseg.lift.voxels import reference
from splatseg.lift.voxels.assignment import AssignmentOptions, assign_voxels
from splatseg.lift.voxels.filtering import FilterOptions, surface_gaussians
from splatseg.lift.voxels.grid import voxelise
from splatseg.lift.voxels.lifting import HitOptions, lift_to_voxels, optical_depths


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
    """A cloud of Gaussians, its voxels, views of it and features of these."""
    gaussians = random_gaussians(rng, 60)
    grid = voxelise(gaussians.means, 0.4)
    views = views_of(3)
    return gaussians, grid, views, random_grids(rng, views)


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


@pytest.mark.parametrize("rule", ["first", "several", "weights"])
@pytest.mark.parametrize("average", ["hits", "views"])
def test_one_feature_everywhere_is_what_every_voxel_gets(scene, rule: str, average: str) -> None:
    gaussians, grid, views, _ = scene
    rows = assign_voxels(grid, gaussians.means).rows[:, 0].long()
    lifted = lift_to_voxels(
        grid,
        views,
        constant_grids(views, [[2.0, -1.0]] * 3),
        options=HitOptions(hits=rule, average=average),
        depths=optical_depths(grid, gaussians, rows),
        gaussians=gaussians,
        rows=rows,
        backend=BACKEND,
    )
    hit = lifted.totals > 0
    assert bool(hit.any())
    torch.testing.assert_close(
        lifted.values[hit], torch.tensor([[2.0, -1.0]]).expand(int(hit.sum()), -1)
    )
    assert float(lifted.values[~hit].abs().sum()) == 0


def test_views_count_once_with_means_of_views(scene) -> None:
    """Two views of different features: the mean is by pixels, or half of each."""
    _, grid, views, _ = scene
    near = view_at("near", 0.0, 1.0)
    pair = [views[0], near]
    features = constant_grids(pair, [[0.0], [1.0]])
    by_pixels = lift_to_voxels(grid, pair, features)
    by_views = lift_to_voxels(grid, pair, features, options=HitOptions(average="views"))
    both = by_views.totals == 2
    assert bool(both.any())
    torch.testing.assert_close(by_views.values[both], torch.full((int(both.sum()), 1), 0.5))
    assert float((by_pixels.values[both] - 0.5).abs().max()) > 0.05


def test_weights_of_w_are_uplift_where_each_gaussian_has_its_voxel(rng) -> None:
    """The mean over the Gaussians of a voxel, by their visibility, of what uplift gives them."""
    gaussians = random_gaussians(rng, 30)
    views = views_of(2)
    features = random_grids(rng, views, channels=70)  # more than are held at a time
    grid = voxelise(gaussians.means, 0.5)
    rows = assign_voxels(grid, gaussians.means).rows[:, 0].long()
    lifted = lift_to_voxels(
        grid, views, features, options=HitOptions(hits="weights"),
        gaussians=gaussians, rows=rows, backend=BACKEND,
    )  # fmt: skip
    own = uplift_features(gaussians, views, features, backend=BACKEND)
    weights = torch.zeros(len(grid), dtype=torch.float64).index_add_(0, rows, own.weights.double())
    sums = torch.zeros(len(grid), 70).index_add_(0, rows, own.values * own.weights[:, None])
    seen = weights > 1e-3
    torch.testing.assert_close(lifted.totals, weights, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(
        lifted.values[seen], (sums / weights[:, None].float())[seen], rtol=1e-3, atol=1e-4
    )


@pytest.mark.bits
def test_the_order_of_views_and_the_threads_make_no_difference(scene) -> None:
    _, grid, views, features = scene
    first = lift_to_voxels(grid, views, features)
    before = _native.threads()
    try:
        for threads in (1, 3):
            _native.set_threads(threads)
            again = lift_to_voxels(grid, views[::-1], features)
            assert torch.equal(first.values, again.values)
            assert torch.equal(first.totals, again.totals)
    finally:
        _native.set_threads(before)


def test_rays_begin_and_end_where_options_say(scene) -> None:
    _, grid, views, features = scene
    usual = lift_to_voxels(grid, views, features)
    for options in (HitOptions(near=3.0), HitOptions(far=2.5)):
        other = lift_to_voxels(grid, views, features, options=options)
        assert not torch.equal(usual.totals, other.totals)


def test_several_hits_reach_what_is_behind(scene) -> None:
    gaussians, grid, views, features = scene
    rows = assign_voxels(grid, gaussians.means).rows[:, 0].long()
    depths = optical_depths(grid, gaussians, rows)

    def lifted(hits: int):
        options = HitOptions(hits="several", max_hits=hits)
        return lift_to_voxels(grid, views, features, options=options, depths=depths)

    assert bool(((lifted(1).totals == 0) & (lifted(4).totals > 0)).any())


def test_nearest_and_trilinear_by_hand() -> None:
    """Two voxels side by side, of side 2, with centres at x = 1 and x = 3."""
    grid = voxelise(torch.tensor([[0.0, 0, 0], [3.0, 1, 1]]), 2.0)
    points = torch.tensor([[1.5, 1, 1], [2.5, 1, 1], [1.0, 1, 1], [3.0, 1.0, 6.5], [40.0, 0, 0]])
    nearest = assign_voxels(grid, points, options=AssignmentOptions(max_distance=3.0))
    assert nearest.rows[:, 0].tolist() == [0, 1, 0, 1, -1]
    assert nearest.shares[:, 0].tolist() == [1, 1, 1, 1, 0]
    far = assign_voxels(grid, points, options=AssignmentOptions(max_distance=None))
    assert far.rows[:, 0].tolist() == [0, 1, 0, 1, 1]
    mixed = assign_voxels(
        grid, points, options=AssignmentOptions(interpolation="trilinear", max_distance=3.0)
    )
    table = torch.tensor([10.0, 20.0, 0.0])  # the last row stands for -1
    value = (mixed.shares * table[mixed.rows.long()]).sum(dim=1)
    torch.testing.assert_close(value, torch.tensor([12.5, 17.5, 10.0, 20.0, 0.0]))
    torch.testing.assert_close(mixed.shares.sum(dim=1), torch.tensor([1.0, 1, 1, 1, 0]))


def left_out(gaussians, options) -> list[int]:
    return torch.nonzero(~surface_gaussians(gaussians, options=options)).squeeze(1).tolist()


def test_what_is_no_surface_is_left_out() -> None:
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
    options = FilterOptions(scale_share=36 / 37, min_neighbours=2, radius=1.5)
    assert left_out(gaussians, options) == [0, 1, 2, 36]
    rules = {"min_opacity": 2, "max_elongation": 0, "scale_share": 1, "min_neighbours": 36}
    none = dict.fromkeys(("min_opacity", "max_elongation", "scale_share", "min_neighbours"))
    for rule, row in rules.items():
        only = FilterOptions(**{**none, "radius": 1.5, rule: getattr(options, rule)})
        assert torch.nonzero(~surface_gaussians(gaussians, options=only)).squeeze(1).tolist() == [
            row
        ]
    half = surface_gaussians(gaussians, options=FilterOptions(**{**none, "opaque_share": 0.5}))
    assert int(half.sum()) == 18
    assert not bool(half[2])
    # Ten times the median distance to the nearest reaches the whole sheet, and not what floats.
    own = surface_gaussians(gaussians, options=FilterOptions(**{**none, "min_neighbours": 4}))
    assert torch.nonzero(~own).squeeze(1).tolist() == [36]


def test_bad_input_is_refused(scene) -> None:
    gaussians, grid, views, features = scene
    with pytest.raises(InputError, match="depths: expected the optical depth"):
        lift_to_voxels(grid, views, features, options=HitOptions(hits="several"))
    with pytest.raises(InputError, match="gaussians, rows: expected"):
        lift_to_voxels(grid, views, features, options=HitOptions(hits="weights"))
    with pytest.raises(InputError, match="features of every view"):
        lift_to_voxels(grid, [*views, View(name="w", camera=views[0].camera)], features)
    broken = random_grids(np.random.default_rng(1), views)
    broken.maps["v1"].features[0, 0, 0] = torch.nan
    with pytest.raises(InputError, match="finite features of view v1"):
        lift_to_voxels(grid, views, broken)
    other = {
        **features.maps,
        "v2": random_grids(np.random.default_rng(1), views, channels=3).maps["v2"],
    }
    with pytest.raises(ShapeError, match="expected 5 channels of view v2"):
        lift_to_voxels(grid, views, Grids(other))
    with pytest.raises(InputError, match="none of 60 does"):
        surface_gaussians(gaussians, options=FilterOptions(min_neighbours=60))
    wrong = (
        (HitOptions, {"near": 2, "far": 1}),
        (HitOptions, {"max_hits": 0}),
        (AssignmentOptions, {"max_distance": 0}),
        (FilterOptions, {"radius": 0}),
        (FilterOptions, {"opaque_share": 0}),
        (FilterOptions, {"max_elongation": 0.5}),
        (FilterOptions, {"min_neighbours": -1}),
    )
    for options, value in wrong:
        with pytest.raises(RangeError, match=next(iter(value))):
            options(**value)
    with pytest.raises(InputError, match="hits"):
        HitOptions(hits="last")
