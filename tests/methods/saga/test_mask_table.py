"""What is measured of masks: areas, scales in 3D, ranks and levels."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from splatseg.core import MaskSet
from splatseg.methods.saga._mask_table import mask_scale, mask_table
from splatseg.methods.saga._smoothing import Smoother
from splatseg.methods.saga._targets import SagaTargets

from .conftest import HEIGHT, WIDTH, Masks

BACKEND = "reference"


def test_the_scale_is_the_norm_of_two_deviations() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(6, 7, 3)) * (3.0, 2.0, 0.5)
    mask = np.zeros((6, 7), dtype=bool)
    mask[1:5, 2:6] = True
    mask[0, 0] = True  # a speck, which erosion takes
    known = np.ones((6, 7), dtype=bool)
    # Corners of the block have four of nine pixels inside, and go; its edges have six, and stay.
    kept = mask.copy()
    kept[0, 0] = False
    for corner in ((1, 2), (1, 5), (4, 2), (4, 5)):
        kept[corner] = False
    expected = 2 * math.sqrt(sum(points[kept][:, axis].var() for axis in range(3)))
    assert mask_scale(mask, points, known) == pytest.approx(expected)
    known[2, 3] = False
    kept[2, 3] = False
    expected = 2 * math.sqrt(sum(points[kept][:, axis].var() for axis in range(3)))
    assert mask_scale(mask, points, known) == pytest.approx(expected)
    assert mask_scale(mask, points, np.zeros_like(known)) != mask_scale(mask, points, known)
    assert math.isnan(mask_scale(mask, points, np.zeros_like(known)))
    assert math.isnan(mask_scale(np.zeros_like(mask), points, known))
    line = np.zeros_like(mask)
    line[3, 1:6] = True  # erosion would leave none of it
    expected = 2 * math.sqrt(sum(points[line][:, axis].var() for axis in range(3)))
    assert mask_scale(line, points, np.ones_like(known)) == pytest.approx(expected)


def test_masks_of_a_wall_are_measured_on_it(walls) -> None:
    """The wall stands at z = 2: a mask of w x h pixels of 1/15 m spreads as a plate does."""
    table = mask_table(walls.gaussians, walls.views, walls.evidence, backend=BACKEND)
    assert len(table) == 12
    assert table.first == {"v0": 0, "v1": 4, "v2": 8}
    for number in range(12):
        mask = walls.evidence.masks(f"v{number // 4}").dense(number % 4)
        assert float(table.areas[number]) == pytest.approx(float(mask.float().mean()))
    # A window is 0.6 x 0.53 m less its corners: 2 sqrt(0.6^2 / 12 + 0.53^2 / 12).
    window = 2 * math.sqrt((0.6**2 + 0.53**2) / 12)
    assert float(table.scales[6]) == pytest.approx(window, rel=0.12)
    assert bool((table.ranks[[0, 1, 4, 5]] > table.ranks[[2, 3, 6, 7]].max()).all())
    assert len(table.quantiles) == 101
    assert table.levels[0] == pytest.approx(
        float(table.ranks[[0, 1, 4, 5, 8, 9]].median()), abs=0.1
    )
    assert table.levels[0] > table.levels[1] == 0.5 > table.levels[2]


def test_masks_without_depth_have_the_median(walls) -> None:
    """A mask beside all Gaussians has no points; with only such masks nothing is measured."""
    corner = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    corner[:, -2:] = True
    seen = torch.where(walls.means[:, 0] > 0.7, 0.05, 0.95)
    gaussians = replace(walls.gaussians, opacities=seen)
    evidence = Masks(
        {
            view.name: MaskSet.from_dense(
                torch.stack((*(walls.mask_set(view).dense(i) for i in range(3)), corner))
            )
            for view in walls.views
        }
    )
    table = mask_table(gaussians, walls.views, evidence, backend=BACKEND)
    measured = table.scales[[0, 1, 2, 4, 5, 6, 8, 9, 10]]
    assert float(table.scales[3]) == pytest.approx(float(np.median(measured.numpy())))
    only = Masks({v.name: MaskSet.from_dense(corner[None]) for v in walls.views})
    table = mask_table(gaussians, walls.views, only, backend=BACKEND)
    assert table.scales.tolist() == [0.0] * 3


def test_targets_are_numbered_through_all_views(walls) -> None:
    table = mask_table(walls.gaussians, walls.views, walls.evidence, backend=BACKEND)
    source = SagaTargets(walls.evidence, walls.views, table.first, walls.grids)
    assert source.channels == 4
    pixels = torch.tensor([12 * WIDTH + 24, 2 * WIDTH + 1])
    found = source.targets("v1", pixels)
    assert found["masks"].row(0).tolist() == [5, 7]
    assert found["masks"].row(1).tolist() == [4]
    # A pixel at the middle between four cells reads their mean.
    cells = walls.grids.features("v1").features
    between = source.targets("v1", torch.tensor([7 * WIDTH + 7]))["guidance"][0]
    near = [
        cells[i, j] * a * b
        for i, a in ((1, 0.625), (2, 0.375))
        for j, b in ((1, 0.625), (2, 0.375))
    ]
    torch.testing.assert_close(between.float(), sum(near), rtol=2e-3, atol=2e-3)
    assert "guidance" not in SagaTargets(walls.evidence, walls.views, table.first).targets(
        "v1", pixels
    )
    assert source.fingerprint != SagaTargets(walls.evidence, walls.views, table.first).fingerprint


def test_pixels_outside_all_masks_are_a_group(walls) -> None:
    window = Masks(
        {v.name: MaskSet.from_dense(walls.mask_set(v).dense(2)[None]) for v in walls.views}
    )
    source = SagaTargets(window, walls.views, {"v0": 0, "v1": 1, "v2": 2})
    groups = source.groups("v1")
    assert len(groups) == 2
    assert len(groups.values) == HEIGHT * WIDTH
    full = SagaTargets(walls.evidence, walls.views, {"v0": 0, "v1": 4, "v2": 8})
    assert len(full.groups("v1")) == 4


def test_smoothing_is_the_mean_of_directions(walls, rng) -> None:
    """Against loops; with a drop-out the nearest is still the Gaussian itself."""
    features = torch.from_numpy(rng.normal(size=(96, 5))).float()
    smoother = Smoother(walls.means, neighbours=4)
    found = smoother.smoothed(features)
    distance = torch.cdist(walls.means.double(), walls.means.double())
    for i in (0, 17, 95):
        near = sorted(range(96), key=lambda j, i=i: (round(float(distance[i, j]), 6), j))[:4]
        own = [features[j] / features[j].norm() for j in near]
        if round(float(distance[i].sort().values[4]), 5) > round(
            float(distance[i].sort().values[3]), 5
        ):
            torch.testing.assert_close(found[i], sum(own) / 4, rtol=1e-4, atol=1e-5)
    some = torch.tensor([3, 40])
    rows = smoother.rows(some, drop=0.5, rng=np.random.default_rng(1))
    dense = rows.product(torch.eye(len(rows.touched)))
    assert [int((row > 0).sum()) for row in dense] == [3, 3]
    at = torch.searchsorted(rows.touched, some)
    assert bool((dense[torch.arange(2), at] > 0).all())
    alone = Smoother(walls.means, neighbours=1).smoothed(features)
    torch.testing.assert_close(alone.norm(dim=1), torch.ones(96))
