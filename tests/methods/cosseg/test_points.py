"""Scenes before a frozen encoder: their unit, origin, colours and grid."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from splatseg.core.rigid import upright
from splatseg.errors import InputError, RangeError
from splatseg.methods.cosseg.checkpoint import PointEncoder, load_point_encoder
from splatseg.methods.cosseg.network import RandlaEncoder
from splatseg.methods.cosseg.points import PointSource, spatial_features, spatial_frame
from splatseg.methods.cosseg.pyramid import PointInputs, feed_points
from splatseg.neighbours import NeighbourIndex

from .point_scenes import pyramid_of, randomised, scene, small_config

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
    encoder: PointEncoder, positions: Tensor, colours: Tensor, seed: int = 4, *, unit=None
):
    """The frame of some points, their pyramid, and their features."""
    frame = spatial_frame(encoder, positions, metres_per_unit=unit, seed=seed)
    return frame, *spatial_features(encoder, positions, colours, frame=frame, seed=seed)


def test_points_are_fed_from_their_mean() -> None:
    positions, colours = scene(60)
    positions = positions.double() + torch.tensor([100.0, -7, 3])
    encoder = encoder_of()
    frame, pyramid, levels = features_of(encoder, positions, colours, unit=2.0)
    local = ((positions - positions.mean(dim=0)) * 2).float()
    own = pyramid_of(local, encoder.config, seed=4)
    wanted = encoder.encoder(own, torch.cat((local, colours), dim=1))
    assert (frame.metres_per_unit, frame.is_scale_assumed) == (2.0, False)
    assert torch.allclose(pyramid.positions, local, atol=1e-6)
    for one, two, width in zip(levels, wanted, encoder.config.level_widths, strict=True):
        assert one.dtype == torch.float16
        assert torch.allclose(one.float(), two, rtol=2e-3, atol=1e-3)
        assert one.shape[1] == width
        assert not one.requires_grad


def test_moving_and_scaling_a_scene_changes_nothing_where_its_unit_is_known() -> None:
    positions, colours = scene(60)
    encoder = encoder_of()
    found = features_of(encoder, positions, colours, unit=1.0)[2]
    moved = features_of(encoder, positions.double() * 50 + 9, colours, unit=0.02)[2]
    for one, two in zip(found, moved, strict=True):
        assert torch.allclose(one.float(), two.float(), rtol=5e-3, atol=1e-3)


def test_an_unknown_unit_makes_the_scene_as_dense_as_the_training() -> None:
    positions, colours = scene(60)
    encoder = encoder_of()
    frame, pyramid, levels = features_of(encoder, positions * 7, colours)
    assert frame.is_scale_assumed
    distances = NeighbourIndex(pyramid.positions).nearest_others(1).distances
    assert float(distances.median()) == pytest.approx(GRID, rel=1e-4)
    known = features_of(encoder, positions * 7, colours, unit=frame.metres_per_unit)[2]
    assert torch.equal(levels[-1], known[-1])


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
    """In the frame of the scene, a part's coordinates are those that it has in the whole."""
    positions, colours = scene(120)
    encoder = encoder_of(fed=PointInputs(grid_size=GRID, origin=origin))
    frame, whole, _ = features_of(encoder, positions, colours)
    part = torch.argsort(positions[:, 0])[:60]
    found, _ = spatial_features(encoder, positions[part], colours[part], frame=frame, seed=4)
    assert torch.equal(found.positions, whole.positions[part])
    own = features_of(encoder, positions[part], colours[part])[1]
    assert not torch.allclose(own.positions, whole.positions[part], atol=1e-2)


def test_the_floor_is_below_all_but_a_hundredth() -> None:
    z = torch.cat((torch.linspace(0, 3, 990), torch.full((10,), -50.0)))
    positions = torch.stack((torch.rand(1000) + 5, torch.rand(1000), z), dim=1)
    fed = PointInputs(grid_size=GRID, origin="floor")
    local, channels = feed_points(positions, None, inputs=fed)
    assert torch.equal(local, channels)
    assert np.allclose(local[:, :2].double().mean(dim=0), 0, atol=1e-6)
    assert torch.allclose(local[:990, 2], z[:990], atol=0.6)
    assert local[989, 2] == pytest.approx(3.0 - float(np.quantile(z.numpy(), 0.01)), abs=1e-5)


def test_colours_are_read_where_they_are_taken() -> None:
    positions, colours = scene(60)
    plain = encoder_of(inputs=3)
    found = features_of(plain, positions, colours, unit=1.0)[2]
    unread = features_of(plain, positions, colours.flip(0), unit=1.0)[2]
    for one, two in zip(found, unread, strict=True):
        assert torch.equal(one, two)


@pytest.mark.bits
def test_threads_and_seeds() -> None:
    positions, colours = scene(300)
    encoder = encoder_of()
    before = torch.get_num_threads()
    try:
        found = []
        for threads, seed in ((1, 4), (2, 4), (2, 5)):
            torch.set_num_threads(threads)
            found.append(features_of(encoder, positions, colours, seed))
    finally:
        torch.set_num_threads(before)
    for one, two in zip(found[0][2], found[1][2], strict=True):
        assert torch.equal(one, two)
    assert not torch.equal(found[0][1].kept[1], found[2][1].kept[1])


def test_what_does_not_fit() -> None:
    positions, colours = scene(60)
    encoder = encoder_of()
    with pytest.raises(InputError, match="positions: expected at least 24 points"):
        features_of(encoder, positions[:23], colours[:23])
    with pytest.raises(RangeError, match="positions: expected a scene of at most 1e"):
        features_of(encoder, positions, colours, unit=1e9)
    with pytest.raises(RangeError, match="positions: expected at least one point, got none"):
        features_of(encoder, positions[:0], colours[:0], unit=1.0)
    with torch.no_grad():
        encoder.encoder.blocks[0].exit.linear.weight.mul_(1e7)
    with pytest.raises(RangeError, match="encoder: expected features that float16 holds"):
        features_of(encoder, positions, colours, unit=1.0)
    for fields, message in (
        ({"grid_size": 0.0}, "grid_size: expected"),
        ({"grid_size": 0.1, "colour_range": 256.0}, "colour_range: expected"),
        ({"grid_size": 0.1, "origin": "corner"}, "origin: expected one of"),
    ):
        with pytest.raises(InputError, match=message):
            PointInputs(**fields)


def test_the_encoder_says_what_it_takes() -> None:
    assert encoder_of().colour
    plain = encoder_of(inputs=3)
    assert not plain.colour
    assert plain.config == plain.encoder.config
    assert replace(plain, source="b").source == "b"


def source(halves, encoder_file, **more) -> PointSource:
    scales = (torch.rand(len(halves.gaussians), 2), torch.rand(len(halves.gaussians), 3))
    given = {
        "gaussians": halves.gaussians, "scales": scales, "spatial": "all",
        "encoder": load_point_encoder(encoder_file), "up": None, "seed": 0,
    } | more  # fmt: skip
    frame = None
    if given["encoder"] is not None:
        means = upright(given["gaussians"].means, given["up"])
        frame = spatial_frame(given["encoder"], means, metres_per_unit=1.0, seed=0)
    return PointSource(**given, frame=frame)


def test_features_stand_at_the_points_of_their_level(halves, encoder_file) -> None:
    made = source(halves, encoder_file)
    chosen = torch.arange(0, 384, 2)
    raw = made.raw(chosen)
    assert [len(level[0]) for level in raw.parts] == [192, 64, 21, 10]
    assert [len(level) for level in raw.parts] == [2, 2, 1, 1]
    torch.testing.assert_close(raw.parts[0][1], made.scales[0][chosen])
    # Every point of the next level is one of this level, with its own feature.
    second = made.scales[1]
    for row in raw.parts[1][1]:
        assert bool((second[chosen] == row).all(dim=1).any())
    found = raw.scaled(raw.scalings(), 384)
    assert found.rows[chosen].tolist() == list(range(192))
    assert bool((found.rows[1::2] == -1).all())
    assert found.inputs.widths == (8 + 2, 8 + 3, 8, 12)
    torch.testing.assert_close(
        found.inputs.levels[0].float().mean(dim=0), torch.zeros(10), atol=1e-2, rtol=0
    )


def test_single_scale_brings_the_last_level_down(halves, encoder_file) -> None:
    chosen = torch.arange(384)
    raw = source(halves, encoder_file, spatial="first").raw(chosen)
    whole = source(halves, encoder_file).raw(chosen)
    last = whole.parts[-1][0]
    rows = chosen
    for up in whole.up:
        rows = up[rows]
    torch.testing.assert_close(raw.parts[0][0], last[rows])
    assert (len(raw.parts), raw.up, len(raw.parts[0])) == (1, (), 2)


def test_without_a_point_network_features_stand_side_by_side(halves, encoder_file) -> None:
    raw = source(halves, encoder_file, encoder=None).raw(torch.tensor([4, 9]))
    assert [part.shape for part in raw.parts[0]] == [(2, 2), (2, 3)]


def test_turned_scenes_are_encoded_alike(halves, encoder_file) -> None:
    """With y up the encoder sees what it sees of the same scene with z up."""
    from dataclasses import replace

    turn = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    lying = replace(halves.gaussians, means=halves.means @ turn.T)
    first = source(halves, encoder_file).raw(torch.arange(384))
    second = source(halves, encoder_file, gaussians=lying, up=(0.0, 1.0, 0.0))
    found = second.raw(torch.arange(384))
    torch.testing.assert_close(found.parts[0][0], first.parts[0][0], atol=2e-2, rtol=1e-2)
