"""Voxels that share cells of feature maps: against the dense equations, and by hand."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter1d

from lift.conftest import BACKEND, gaussians_at, random_gaussians
from lift.voxels.test_lifting import Grids, constant_grids, random_grids, view_at, views_of
from splatseg.core import UNLABELLED, FeatureMap, Labels
from splatseg.core.sh import base_colours
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.lift import label_map
from splatseg.lift.neighbour_graph import NodeAttributes, neighbour_graph
from splatseg.lift.voxels.assignment import AssignmentOptions, assign_voxels
from splatseg.lift.voxels.grid import voxelise
from splatseg.lift.voxels.lifting import HitOptions, lift_to_voxels
from splatseg.lift.voxels.solving import conjugate_gradients

SOLVED = HitOptions(hits="solved")


@pytest.fixture
def scene(rng):
    """A cloud of Gaussians of many colours, its voxels, which of them each reads, and views."""
    gaussians = random_gaussians(rng, 60)
    colours = rng.normal(size=gaussians.sh.shape, scale=0.5)
    gaussians = replace(gaussians, sh=torch.from_numpy(colours).to(gaussians.sh.dtype))
    grid = voxelise(gaussians.means, 0.4)
    rows = assign_voxels(grid, gaussians.means, options=AssignmentOptions()).rows[:, 0].long()
    return gaussians, grid, rows, views_of(3)


def solve(scene, grids, options=SOLVED):
    gaussians, grid, rows, views = scene
    return lift_to_voxels(
        grid, views, grids, options=options, gaussians=gaussians, rows=rows, backend=BACKEND
    )


@pytest.mark.parametrize(
    ("blur", "smoothness", "stride"), [(0.0, 0.3, 4), (0.8, 0.1, 4), (0.8, 0.1, 5)]
)
def test_against_the_dense_equations(rng, scene, monkeypatch, blur, smoothness, stride) -> None:
    """With cells of 5 pixels the last ones have more, those beyond the last whole cell."""
    monkeypatch.setattr("splatseg.lift.voxels.solving._TOLERANCE", 1e-6)
    monkeypatch.setattr("splatseg.lift.voxels.solving._STEPS", 300)
    gaussians, grid, rows, views = scene
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
    found = solve(scene, grids, replace(SOLVED, blur=blur, smoothness=smoothness))
    np.testing.assert_allclose(found.values.numpy(), expected, atol=2e-4)
    np.testing.assert_allclose(found.totals.numpy(), a.sum(axis=0), atol=1e-6)


def test_what_is_the_same_everywhere_is_what_voxels_are(scene) -> None:
    values = [[3.0, -1.0]] * 3
    found = solve(scene, constant_grids(scene[3], values)).values
    torch.testing.assert_close(found, torch.tensor(values[:1]).expand(len(found), 2))


def test_two_in_one_cell_are_told_apart() -> None:
    """Left and right of a cell's middle in shares that differ from view to view: means mix them."""
    gaussians = gaussians_at(torch.tensor([[-0.4, 0.0, 2.0], [0.4, 0.0, 2.0]]), scale=0.25)
    grid = voxelise(gaussians.means, 0.5)
    rows = assign_voxels(grid, gaussians.means, options=AssignmentOptions()).rows[:, 0].long()
    views = [view_at(f"v{i}", 0.25 * (i - 2)) for i in range(5)]
    labels = Labels(ids=rows.int(), confidence=torch.ones(2), background=UNLABELLED)
    true = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    maps = {}
    for view in views:
        ids = label_map(gaussians, view.camera, labels, backend=BACKEND).ids.long()
        seen = torch.where((ids >= 0)[..., None], true[ids.clamp_min(0)], 0.5)
        cells = seen.reshape(3, 4, 4, 4, 2).mean(dim=(1, 3))
        maps[view.name] = FeatureMap(features=cells, stride=4, height=12, width=16)

    def found(options):
        return lift_to_voxels(
            grid, views, Grids(maps), options=options, gaussians=gaussians, rows=rows,
            backend=BACKEND,
        ).values  # fmt: skip

    apart = found(replace(SOLVED, blur=0.0, smoothness=0.0))
    mixed = found(HitOptions(hits="weights"))
    assert float((apart - true).abs().max()) < 0.1
    assert float((mixed - true).abs().max()) > 0.2


def test_each_option_makes_a_difference(rng, scene) -> None:
    grids = random_grids(rng, scene[3])
    usual = solve(scene, grids).values
    for changes in ({"blur": 0.3}, {"smoothness": 3.0}, {"hits": "weights"}):
        assert not torch.allclose(solve(scene, grids, replace(SOLVED, **changes)).values, usual)


def test_progress_counts_views_and_parts_of_channels(rng, scene, monkeypatch) -> None:
    monkeypatch.setattr("splatseg.lift.voxels.solving._CHANNELS", 2)
    gaussians, grid, rows, views = scene
    told = []
    grids = random_grids(rng, views)
    found = lift_to_voxels(
        grid, views, grids, options=SOLVED, gaussians=gaussians, rows=rows, backend=BACKEND,
        progress=lambda *one: told.append(one),
    )  # fmt: skip
    assert told == [(done, 6) for done in range(1, 7)]
    monkeypatch.undo()
    torch.testing.assert_close(solve(scene, grids).values, found.values, atol=1e-3, rtol=0)


def test_what_is_refused(rng, scene) -> None:
    gaussians, grid, rows, views = scene
    grids = random_grids(rng, views)
    with pytest.raises(InputError, match="gaussians, rows"):
        lift_to_voxels(grid, views, grids, options=SOLVED)
    with pytest.raises(ShapeError, match="rows"):
        solve((gaussians, grid, rows[:-1], views), grids)
    grids.maps["v2"] = random_grids(rng, views, channels=4).maps["v2"]
    with pytest.raises(ShapeError, match="expected 5 channels of view v2"):
        solve(scene, grids)
    for changes in ({"blur": -0.1}, {"blur": float("nan")}, {"smoothness": -1.0}):
        with pytest.raises(RangeError, match=next(iter(changes))):
            HitOptions(**changes)


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
    gaussians, grid, rows, views = scene
    behind = replace(
        gaussians, means=torch.cat((gaussians.means[:-1], torch.tensor([[0, 0, -5.0]])))
    )
    grid = voxelise(behind.means, 0.4)
    rows = assign_voxels(grid, behind.means, options=AssignmentOptions()).rows[:, 0].long()
    found = solve((behind, grid, rows, views), random_grids(rng, views))
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
