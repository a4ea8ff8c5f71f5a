"""Features of views, carried onto the Gaussians."""

from dataclasses import dataclass

import pytest
import torch

from splatseg.core import FeatureMap, View
from splatseg.errors import InputError, ShapeError
from splatseg.lift.voting import features as module
from splatseg.lift.voting.features import (
    FeatureUpliftOptions,
    read_features_at,
    read_grid,
    uplift_features,
)
from splatseg.render.warp import warp_into_photograph

from .conftest import BACKEND, BARREL, camera_at, gaussians_at, matrix_of, random_gaussians


@dataclass(frozen=True)
class Grids:
    """Feature maps by view name."""

    maps: dict[str, FeatureMap]

    @property
    def view_names(self) -> tuple[str, ...]:
        return tuple(self.maps)

    def features(self, name: str) -> FeatureMap:
        return self.maps[name]


def grid_of(values: torch.Tensor, stride: int, height: int = 12, width: int = 16) -> FeatureMap:
    return FeatureMap(features=values, stride=stride, height=height, width=width)


def random_grids(rng, views, *, stride: int = 4, channels: int = 5) -> Grids:
    shape = (12 // stride, 16 // stride, channels)
    return Grids({v.name: grid_of(torch.from_numpy(rng.normal(size=shape)), stride) for v in views})


def readable_pixel(grid: torch.Tensor, stride: float, x: int, y: int) -> torch.Tensor:
    """Bilinear between cell centres, which lie at (j + 0.5) * stride."""
    rows, columns = grid.shape[:2]
    value = torch.zeros(grid.shape[2], dtype=torch.float64)
    v = min(max((y + 0.5) / stride - 0.5, 0.0), rows - 1.0)
    u = min(max((x + 0.5) / stride - 0.5, 0.0), columns - 1.0)
    for i in range(rows):
        for j in range(columns):
            share = max(0.0, 1 - abs(i - v)) * max(0.0, 1 - abs(j - u))
            value += share * grid[i, j].double()
    return value


def image_of(grid: torch.Tensor, stride: float, width: int = 16, height: int = 12) -> torch.Tensor:
    rows = [[readable_pixel(grid, stride, x, y) for x in range(width)] for y in range(height)]
    return torch.stack([torch.stack(row) for row in rows])


@pytest.mark.parametrize("lens", [{}, BARREL])
@pytest.mark.parametrize("channels_at_once", [2, 64])
def test_features_are_weighted_means(rng, lens, channels_at_once, monkeypatch) -> None:
    views = [View(name=f"v{i}", camera=camera_at(x, **lens)) for i, x in enumerate((-0.2, 0.1))]
    gaussians = random_gaussians(rng)
    grids = random_grids(rng, views)
    sums = torch.zeros(len(gaussians), 5, dtype=torch.float64)
    weights = torch.zeros(len(gaussians), dtype=torch.float64)
    for view in views:
        image = image_of(grids.features(view.name).features, 4)
        image = torch.cat((image, torch.ones(12, 16, 1)), dim=-1)
        if lens:
            image = warp_into_photograph(view.camera, "nearest").adjoint(image)
        found = torch.einsum("hwn,hwc->nc", matrix_of(gaussians, view.camera), image)
        sums += found[:, :-1]
        weights += found[:, -1]
    expected = sums / torch.where(weights > 0, weights, 1.0).unsqueeze(1)

    calls = []
    monkeypatch.setattr(module, "_CHANNELS", channels_at_once)
    found = uplift_features(
        gaussians,
        views[::-1],
        grids,
        backend=BACKEND,
        progress=lambda *step: calls.append(step),
    )

    assert found.values.dtype == torch.float32
    torch.testing.assert_close(found.values.double(), expected, rtol=0, atol=1e-5)
    torch.testing.assert_close(found.weights.double(), weights, rtol=1e-5, atol=1e-6)
    assert calls == [(1, 2), (2, 2)]
    info = found.info
    assert info.method == "uplift_features"
    assert info.views == ("v0", "v1")
    assert info.options == {"longest_side": None}


def test_a_constant_stays_itself(rng, views) -> None:
    grids = Grids({v.name: grid_of(torch.full((3, 4, 2), 2.5), 4) for v in views})
    found = uplift_features(random_gaussians(rng), views, grids, backend=BACKEND)
    seen = found.weights > 1e-3
    torch.testing.assert_close(found.values[seen], torch.full((int(seen.sum()), 2), 2.5))


def test_bilinear_reads_between_cell_centres(rng) -> None:
    grid = torch.from_numpy(rng.normal(size=(3, 4, 2))).float()
    image = read_grid(grid, cells=(3, 4), size=(12, 16))
    torch.testing.assert_close(image.double(), image_of(grid, 4), rtol=0, atol=1e-6)
    # Pixels 5 and 6 of a row lie 1/8 before and after the centre of cell 1, which begins at 4.
    line = read_grid(torch.tensor([[[0.0], [8.0], [16.0]]]), cells=(1, 3), size=(1, 12))
    assert line.flatten().tolist() == [0, 0, 1, 3, 5, 7, 9, 11, 13, 15, 16, 16]


def test_grids_that_do_not_divide_the_photograph() -> None:
    """16x12 pixels in cells of 5: a last cell over the edge, or missing, moves nothing."""
    gaussians = gaussians_at([[-0.5, 0, 2], [0.5, 0, 2]])
    view = View(name="v", camera=camera_at())
    over = torch.arange(4.0).expand(3, 4).unsqueeze(-1)
    short = torch.arange(3.0).expand(2, 3).unsqueeze(-1)
    both = [
        uplift_features(
            gaussians, [view], Grids({"v": grid_of(grid, 5, height, width)}), backend=BACKEND
        ).values
        for grid, height, width in ((over, 15, 20), (short, 10, 15))
    ]
    # Gaussians at columns 4.4 and 11.6, that is at 0.38 and 1.82 between cell centres.
    torch.testing.assert_close(both[0].flatten(), torch.tensor([0.38, 1.82]), rtol=0, atol=0.05)
    torch.testing.assert_close(both[1], both[0], rtol=0, atol=0.05)


def test_unseen_gaussians_get_nothing() -> None:
    gaussians = gaussians_at([[0, 0, 2], [0, 0, -2]])
    view = View(name="v", camera=camera_at())
    grids = Grids({"v": grid_of(torch.ones(3, 4, 2), 4)})
    weight = float(matrix_of(gaussians, view.camera).sum())

    found = uplift_features(gaussians, [view], grids, backend=BACKEND)
    assert found.weights.tolist() == pytest.approx([weight, 0], rel=1e-5)
    assert found.values[:, 0].tolist() == pytest.approx([1, 0], abs=1e-6)


def test_smaller_views_are_seen_through(rng) -> None:
    """Half the size: the same as features of a photograph half as large."""
    gaussians = random_gaussians(rng)
    full = View(name="v", camera=camera_at(width=32, height=24))
    half = View(name="v", camera=camera_at(width=16, height=12))
    values = torch.from_numpy(rng.normal(size=(3, 4, 2))).float()
    large = Grids({"v": grid_of(values, 8, 24, 32)})
    small = Grids({"v": grid_of(values, 4)})
    options = FeatureUpliftOptions(longest_side=16)
    a = uplift_features(gaussians, [full], large, options=options, backend=BACKEND)
    b = uplift_features(gaussians, [half], small, backend=BACKEND)
    c = uplift_features(gaussians, [full], small, backend=BACKEND)
    torch.testing.assert_close(a.values, b.values)
    torch.testing.assert_close(c.values, b.values)


def test_bad_input_is_refused(rng, views) -> None:
    gaussians = random_gaussians(rng)
    grids = random_grids(rng, views)

    def lift(**changes: FeatureMap) -> None:
        uplift_features(gaussians, views, Grids(grids.maps | changes), backend=BACKEND)

    poison = grids.maps["v1"].features.clone()
    poison[1, 2, 3] = float("nan")
    with pytest.raises(InputError, match=r"features of view v1, 1 of 60 values are NaN"):
        lift(v1=grid_of(poison, 4))
    with pytest.raises(ShapeError, match=r"expected 5 channels of view v2, as of view v0, got 2"):
        lift(v2=grid_of(torch.zeros(3, 4, 2), 4))
    with pytest.raises(ShapeError, match=r"rows of cells of 4 pixels .* 12 pixels of view v1"):
        lift(v1=grid_of(torch.zeros(5, 4, 5), 4))
    with pytest.raises(ShapeError, match=r"v0: expected a map of 16x12 .* got 12x12"):
        lift(v0=grid_of(torch.zeros(3, 3, 5), 4, 12, 12))
    with pytest.raises(ShapeError, match=r"at least one cell and channel of view v0"):
        lift(v0=grid_of(torch.zeros(3, 4, 0), 4))
    with pytest.raises(InputError, match="at least one view"):
        uplift_features(gaussians, [], grids, backend=BACKEND)
    with pytest.raises(InputError, match="features of every view that votes, 1 of 1 have none"):
        uplift_features(gaussians, [View(name="x", camera=camera_at())], grids, backend=BACKEND)
    for wrong in ({"longest_side": 0},):
        with pytest.raises(InputError, match=next(iter(wrong))):
            FeatureUpliftOptions(**wrong)


@pytest.mark.parametrize("size", [(12, 16), (6, 8)])
def test_features_at_pixels_are_those_of_the_image(rng, size) -> None:
    """Also where pixels are counted in a smaller image than the photograph."""
    view = View(name="v0", camera=camera_at())
    grid = grid_of(torch.from_numpy(rng.normal(size=(3, 4, 5))).float(), 4)
    image = read_grid(grid.features, cells=(3, 4), size=size)
    pixels = torch.from_numpy(rng.choice(size[0] * size[1], 20, replace=False))
    found = read_features_at(view, grid, size=size, pixels=pixels)
    torch.testing.assert_close(found, image.reshape(-1, 5)[pixels], rtol=1e-5, atol=1e-5)
    with pytest.raises(ShapeError):
        read_features_at(view, grid_of(torch.zeros(9, 9, 2), 4), size=size, pixels=pixels)
