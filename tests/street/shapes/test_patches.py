"""Patches of surfaces in the frames of their primitives."""

import math

import numpy as np
import pytest
import torch

from splatseg.errors import RangeError, ShapeError
from splatseg.street.shapes import primitive_scale
from support.shape_quality import cut_patches


def cut(points: torch.Tensor, size: float = 1.0, **rest: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(rest.pop("seed", 0))
    settings = {"count": 40, "min_points": 10} | rest
    return cut_patches(points, voxel_size=size, generator=generator, **settings)


def plane(count: int, rng: np.random.Generator, side: float = 6.0) -> torch.Tensor:
    points = rng.uniform(0, side, size=(count, 3))
    points[:, 2] = 1.7
    return torch.from_numpy(points).float()


def test_a_plane_falls_into_squares_of_the_size_of_voxels(rng: np.random.Generator) -> None:
    points = plane(40_000, rng)
    for size in (0.5, 1.0):
        found = cut(points, size)
        assert found.shape[1:] == (40, 3)
        # Squares that the border cuts have fewer cells; most of them are whole.
        whole = (6 / size) ** 2
        assert 0.9 * whole <= len(found) <= (6 / size + 1) ** 2
        # In units: half a diagonal of a voxel. Sizes of voxels do not show.
        np.testing.assert_allclose(found[..., 2], np.zeros(found.shape[:2]), atol=1e-5)
        spread = (found.amax(dim=1) - found.amin(dim=1))[:, :2].median(dim=0).values
        side = 1 / (0.5 * math.sqrt(3))
        assert bool((spread > 0.85 * side).all())
        assert bool((spread < side + 1e-4).all())


def test_the_origin_is_the_mean_of_what_is_in_the_voxel(rng: np.random.Generator) -> None:
    """All points of each voxel are drawn where as many are asked for as it can hold."""
    points = plane(3000, rng, side=0.9)
    whole = cut(points, 40.0, count=5000, min_points=3)
    distinct = [torch.unique(patch, dim=0) for patch in whole]
    for patch in distinct:
        np.testing.assert_allclose(patch.mean(dim=0), np.zeros(3), atol=1e-5)


def test_thinning_forgets_how_dense_points_were(rng: np.random.Generator) -> None:
    """Left of 2 there are a 50th of the points, still many a cell; patches do not lean right."""
    some = plane(400_000, rng, side=4.0)
    kept = (some[:, 0] > 2.0) | (torch.from_numpy(rng.random(len(some))) < 0.02)
    patches = torch.cat([cut(some[kept], 8.0, count=500, min_points=4, seed=i) for i in range(9)])
    low, high = patches[..., 0].amin(dim=1), patches[..., 0].amax(dim=1)
    whole = (high - low) * primitive_scale(8.0) > 3.5
    assert int(whole.sum()) > 3
    left = patches[whole][..., 0] < ((low + high) / 2)[whole][:, None]
    assert float(left.double().mean()) == pytest.approx(0.5, abs=0.1)


def test_voxels_with_few_points_are_left_out(rng: np.random.Generator) -> None:
    lone = torch.tensor([[100.0, 100, 100]])
    assert cut(lone).shape == (0, 40, 3)
    assert cut(torch.zeros(0, 3)).shape == (0, 40, 3)
    # One cell keeps one point, however many it had.
    same = lone + 1e-6 * torch.rand(500, 3, generator=torch.Generator().manual_seed(1))
    assert len(cut(same, min_points=9)) == 0
    assert cut(same, min_points=1).shape == (1, 40, 3)


def test_the_seed_decides(rng: np.random.Generator) -> None:
    points = plane(5000, rng)
    assert torch.equal(cut(points, seed=3), cut(points, seed=3))
    assert not torch.equal(cut(points, seed=3)[:9], cut(points, seed=4)[:9])


def test_scale_is_the_published_one() -> None:
    assert primitive_scale(0.5) == pytest.approx(0.5 * 0.5 * 3**0.5)


def test_bad_input_is_refused() -> None:
    with pytest.raises(ShapeError, match=r"points: expected shape \(any, 3\)"):
        cut(torch.zeros(4, 2))
    with pytest.raises(RangeError, match="points: 1 of 6 values are not finite"):
        cut(torch.tensor([[0.0, 0, 0], [0, 0, math.inf]]))
    with pytest.raises(RangeError, match="voxel_size: expected a positive length, got 0"):
        cut(torch.zeros(4, 3), 0.0)
    with pytest.raises(RangeError, match="count: expected a value in"):
        cut(torch.zeros(4, 3), count=0)
    with pytest.raises(RangeError, match="min_points: expected a value in"):
        cut(torch.zeros(4, 3), min_points=0)
