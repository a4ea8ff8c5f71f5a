"""Scenes before a frozen encoder: their unit, origin, colours and grid."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.lift.point_network import (
    PointEncoder,
    PointInputs,
    RandlaEncoder,
    SpatialOptions,
    average_on_grid,
    feed_points,
    scene_options,
    spatial_features,
)
from splatseg.neighbours import NeighbourIndex

from .conftest import pyramid_of, randomised, scene, small_config

GRID = 0.1


def encoder_of(inputs: int = 6, *, fed: PointInputs | None = None) -> PointEncoder:
    network = randomised(RandlaEncoder(small_config(inputs=inputs))).requires_grad_(False)
    return PointEncoder(
        encoder=network,
        inputs=PointInputs(grid_size=GRID) if fed is None else fed,
        source="a.pth",
        layout="splatseg",
        recipe={},
        assumed=(),
    )


def features_of(
    encoder: PointEncoder, positions: Tensor, colours: Tensor | None, seed: int = 4, **fields
):
    options = SpatialOptions(**fields)
    return spatial_features(encoder, positions, colours, options=options, seed=seed)


def test_points_are_fed_from_their_mean() -> None:
    positions, colours = scene(60)
    positions = positions.double() + torch.tensor([100.0, -7, 3])
    encoder = encoder_of()
    found = features_of(encoder, positions, colours, metres_per_unit=2.0)
    local = ((positions - positions.mean(dim=0)) * 2).float()
    pyramid = pyramid_of(local, encoder.config, seed=4)
    wanted = encoder.encoder(pyramid, torch.cat((local, colours), dim=1))
    assert (found.metres_per_unit, found.is_scale_assumed) == (2.0, False)
    assert torch.equal(found.rows, torch.arange(60))
    assert torch.allclose(found.pyramid.positions, local, atol=1e-6)
    for one, two, width in zip(found.levels, wanted, encoder.config.level_widths, strict=True):
        assert torch.allclose(one, two, rtol=1e-4, atol=1e-5)
        assert one.shape[1] == width
        assert not one.requires_grad


def test_moving_and_scaling_a_scene_changes_nothing_where_its_unit_is_known() -> None:
    positions, colours = scene(60)
    encoder = encoder_of()
    found = features_of(encoder, positions, colours, metres_per_unit=1.0)
    moved = features_of(encoder, positions.double() * 50 + 9, colours, metres_per_unit=0.02)
    for one, two in zip(found.levels, moved.levels, strict=True):
        assert torch.allclose(one, two, rtol=1e-3, atol=1e-4)


def test_an_unknown_unit_makes_the_scene_as_dense_as_the_training() -> None:
    positions, colours = scene(60)
    encoder = encoder_of()
    found = features_of(encoder, positions * 7, colours)
    assert found.is_scale_assumed
    distances = NeighbourIndex(found.pyramid.positions).nearest_others(1).distances
    assert float(distances.median()) == pytest.approx(GRID, rel=1e-4)
    known = features_of(encoder, positions * 7, colours, metres_per_unit=found.metres_per_unit)
    assert torch.equal(found.levels[-1], known.levels[-1])


def test_points_on_each_other_have_no_scale() -> None:
    positions, colours = scene(60)
    with pytest.raises(InputError) as caught:
        features_of(encoder_of(), positions[:20].repeat(3, 1), colours)
    assert str(caught.value) == (
        "metres_per_unit: half of the points lie on another one, so the scale cannot be told from "
        "how dense they are; give it."
    )
    with pytest.raises(InputError, match="at least 2 points to tell their scale by, got 1"):
        features_of(encoder_of(), positions[:1], colours[:1])


def test_with_a_grid_points_have_the_features_of_the_nearest_average() -> None:
    positions, colours = scene(400)
    positions = positions * 0.2
    encoder = encoder_of()
    found = features_of(encoder, positions, colours, metres_per_unit=1.0, grid=True)
    averages = average_on_grid(positions, colours, side=GRID)
    count = len(averages.positions)
    assert 24 < count < 300
    assert found.pyramid.sizes[0] == len(found.levels[0]) == count
    pairs = torch.cdist(positions.double(), averages.positions)
    assert torch.equal(found.rows, pairs.argmin(dim=1))
    plain = features_of(encoder, averages.positions, averages.colours, metres_per_unit=1.0)
    assert torch.equal(plain.levels[1], found.levels[1])


def test_colours_are_scaled_and_cut_off() -> None:
    positions, colours = scene(60)
    fed = PointInputs(grid_size=GRID, colour_range=255.0)
    local, channels = feed_points(positions, colours * 4 - 1, inputs=fed)
    assert torch.equal(channels[:, :3], local)
    assert torch.equal(channels[:, 3:], (colours * 4 - 1).clamp(0, 1) * 255)
    assert float(channels[:, 3:].min()) == 0
    assert float(channels[:, 3:].max()) == 255


@pytest.mark.parametrize("origin", ["mean", "floor"])
def test_parts_of_a_scene_are_fed_from_one_origin(origin) -> None:
    """With the options of the scene, a part's coordinates are those that it has in the whole."""
    positions, colours = scene(120)
    encoder = encoder_of(fed=PointInputs(grid_size=GRID, origin=origin))
    options = scene_options(encoder, positions, options=SpatialOptions(), seed=4)
    whole = spatial_features(encoder, positions, colours, options=SpatialOptions(), seed=4)
    assert (options.metres_per_unit, options.origin) == (whole.metres_per_unit, whole.origin)
    part = torch.argsort(positions[:, 0])[:60]
    found = spatial_features(encoder, positions[part], colours[part], options=options, seed=4)
    assert torch.equal(found.pyramid.positions, whole.pyramid.positions[part])
    own = spatial_features(
        encoder, positions[part], colours[part], options=SpatialOptions(), seed=4
    )
    assert not torch.allclose(own.pyramid.positions, whole.pyramid.positions[part], atol=1e-2)
    given = SpatialOptions(metres_per_unit=2.0, origin=(1.0, 2.0, 3.0))
    assert scene_options(encoder, positions, options=given, seed=4) == given
    with pytest.raises(RangeError, match="origin: expected finite coordinates"):
        SpatialOptions(origin=(float("nan"), 0.0, 0.0))


def test_the_floor_is_below_all_but_a_hundredth() -> None:
    z = torch.cat((torch.linspace(0, 3, 990), torch.full((10,), -50.0)))
    positions = torch.stack((torch.rand(1000) + 5, torch.rand(1000), z), dim=1)
    fed = PointInputs(grid_size=GRID, origin="floor")
    local, channels = feed_points(positions, None, inputs=fed)
    assert torch.equal(local, channels)
    assert np.allclose(local[:, :2].double().mean(dim=0), 0, atol=1e-6)
    assert torch.allclose(local[:990, 2], z[:990], atol=0.6)
    assert local[989, 2] == pytest.approx(3.0 - float(np.quantile(z.numpy(), 0.01)), abs=1e-5)


def test_colours_are_asked_for_where_they_are_taken() -> None:
    positions, colours = scene(60)
    with pytest.raises(InputError, match=r"colours: a\.pth takes colours of points, got none"):
        features_of(encoder_of(), positions, None)
    plain = encoder_of(inputs=3)
    without = features_of(plain, positions, None, metres_per_unit=1.0)
    unread = features_of(plain, positions, colours, metres_per_unit=1.0)
    for one, two in zip(without.levels, unread.levels, strict=True):
        assert torch.equal(one, two)


def test_half_the_memory() -> None:
    positions, colours = scene(60)
    encoder = encoder_of()
    whole = features_of(encoder, positions, colours, metres_per_unit=1.0)
    half = features_of(encoder, positions, colours, metres_per_unit=1.0, precision="float16")
    for one, two in zip(whole.levels, half.levels, strict=True):
        assert two.dtype == torch.float16
        assert torch.equal(one.half(), two)
    with torch.no_grad():
        encoder.encoder.blocks[0].exit.linear.weight.mul_(1e7)
    with pytest.raises(RangeError, match="precision: expected features that float16 holds"):
        features_of(encoder, positions, colours, metres_per_unit=1.0, precision="float16")


@pytest.mark.bits
def test_threads_and_seeds() -> None:
    positions, colours = scene(300)
    encoder = encoder_of()
    before = torch.get_num_threads()
    try:
        found = []
        for threads, seed in ((1, 4), (2, 4), (2, 5)):
            torch.set_num_threads(threads)
            found.append(features_of(encoder, positions, colours, seed, grid=True))
    finally:
        torch.set_num_threads(before)
    for one, two in zip(found[0].levels, found[1].levels, strict=True):
        assert torch.equal(one, two)
    assert not torch.equal(found[0].pyramid.kept[1], found[2].pyramid.kept[1])


def test_what_does_not_fit() -> None:
    positions, colours = scene(60)
    encoder = encoder_of()
    with pytest.raises(InputError, match="positions: expected at least 24 points"):
        features_of(encoder, positions[:23], colours[:23])
    with pytest.raises(ShapeError, match=r"colours: expected shape \(60, 3\), got \(59, 3\)"):
        features_of(encoder, positions, colours[:59])
    with pytest.raises(RangeError, match="positions: expected a scene of at most 1e"):
        features_of(encoder, positions, colours, metres_per_unit=1e9)
    with pytest.raises(RangeError, match="seed: expected 0 or more"):
        features_of(encoder, positions, colours, seed=-1)
    with pytest.raises(RangeError, match="positions: expected at least one point, got none"):
        features_of(encoder, positions[:0], colours[:0], metres_per_unit=1.0, grid=True)
    positions[5] = torch.inf
    with pytest.raises(RangeError, match="positions: 3 of 180 values are not finite"):
        features_of(encoder, positions, colours)


def test_wrong_options_and_inputs() -> None:
    for fields, message in (
        ({"metres_per_unit": 0.0}, "metres_per_unit: expected above 0, got 0.0"),
        ({"precision": "int8"}, "precision: expected one of float32, float16"),
        ({"grid": "yes"}, "grid"),
    ):
        with pytest.raises(InputError, match=message):
            SpatialOptions(**fields)
    for fields, message in (
        ({"grid_size": 0.0}, "grid_size: expected above 0 and at most 1000, got 0.0"),
        ({"grid_size": 0.1, "colour_range": 256.0}, "colour_range: expected above 0 and at most"),
        ({"grid_size": 0.1, "origin": "corner"}, "origin: expected one of mean, floor"),
    ):
        with pytest.raises(InputError, match=message):
            PointInputs(**fields)


def test_a_grid_by_hand() -> None:
    points = torch.tensor([[0.1, 0.1, 0.9], [-0.1, 0, 0], [0.3, 0.5, 0.1], [0.2, 0, 1.0]])
    colours = torch.tensor([[0.0, 0, 0], [1, 1, 1], [1, 0.5, 0], [0.25, 0.25, 0.25]])
    found = average_on_grid(points, colours, side=1.0)
    wanted = torch.tensor([[-0.1, 0, 0], [0.2, 0.3, 0.5], [0.2, 0, 1.0]], dtype=torch.float64)
    assert torch.allclose(found.positions, wanted, atol=1e-7)
    assert found.colours.tolist() == [[1, 1, 1], [0.5, 0.25, 0], [0.25, 0.25, 0.25]]
    assert average_on_grid(points, None, side=1.0).colours is None
    assert len(average_on_grid(points[:0], colours[:0], side=1.0).positions) == 0


def test_every_cell_has_one_point(rng: np.random.Generator) -> None:
    points = torch.from_numpy(rng.normal(size=(500, 3)))
    found = average_on_grid(points, None, side=0.4).positions
    cells = np.floor(points.numpy() / 0.4)
    assert len(found) == len(np.unique(cells, axis=0))
    for average in found.numpy()[::20]:
        inside = (cells == np.floor(average / 0.4)).all(axis=1)
        np.testing.assert_allclose(points.numpy()[inside].mean(axis=0), average, atol=1e-12)


def test_grids_that_do_not_fit() -> None:
    points, colours = scene(10)
    with pytest.raises(RangeError, match="side: expected above 0, got 0"):
        average_on_grid(points, None, side=0.0)
    with pytest.raises(RangeError, match="positions: expected values in"):
        average_on_grid(points, None, side=1e-18)
    with pytest.raises(ShapeError, match="colours: expected shape"):
        average_on_grid(points, colours[:4], side=1.0)


def test_the_encoder_says_what_it_takes() -> None:
    assert encoder_of().colour
    plain = encoder_of(inputs=3)
    assert not plain.colour
    assert plain.config == plain.encoder.config
    assert replace(plain, source="b").source == "b"
