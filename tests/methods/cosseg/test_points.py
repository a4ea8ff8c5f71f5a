"""Sets of points: in boxes, joined."""

import pytest
import torch

from splatseg.errors import InputError
from splatseg.lift.point_network import SpatialOptions, load_point_encoder
from splatseg.methods.cosseg._points import (
    PointSource,
    boxes,
    check_decoded,
    joined_blocks,
)


def test_boxes_hold_all_points_once_and_lie_apart() -> None:
    means = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    means[:, 1] *= 10
    chosen = torch.arange(0, 50, 2)
    found = boxes(means, chosen, 7)
    assert sorted(torch.cat(found).tolist()) == chosen.tolist()
    assert max(map(len, found)) <= 7
    first = torch.cat(found[: len(found) // 2])
    second = torch.cat(found[len(found) // 2 :])
    assert float(means[first, 1].max()) <= float(means[second, 1].min())
    assert boxes(means, chosen, 25)[0] is chosen


def source(halves, encoder_file, **more) -> PointSource:
    scales = (torch.rand(len(halves.gaussians), 2), torch.rand(len(halves.gaussians), 3))
    given = {
        "gaussians": halves.gaussians, "scales": scales, "spatial": "all",
        "space": SpatialOptions(metres_per_unit=1.0, precision="float16"),
        "encoder": load_point_encoder(encoder_file), "up": None, "seed": 0,
    }  # fmt: skip
    return PointSource(**given | more)


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


def test_boxes_are_joined_as_if_each_stood_alone(halves, encoder_file) -> None:
    made = source(halves, encoder_file)
    parts = boxes(halves.means, torch.arange(384), 200)
    raw = [made.raw(part) for part in parts]
    joined = joined_blocks(raw)
    assert joined.chosen.tolist() == torch.cat(parts).tolist()
    begin = len(parts[0])
    for own, level in zip(raw[1].parts, joined.parts, strict=True):
        torch.testing.assert_close(level[0][-len(own[0]) :], own[0])
    rows, alone = torch.tensor([begin + 3]), torch.tensor([3])
    for up, one in zip(joined.up, raw[1].up, strict=True):
        rows, alone = up[rows], one[alone]
    torch.testing.assert_close(joined.parts[-1][0][rows], raw[1].parts[-1][0][alone])


def test_turned_scenes_are_encoded_alike(halves, encoder_file) -> None:
    """With y up the encoder sees what it sees of the same scene with z up."""
    from dataclasses import replace

    turn = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    lying = replace(halves.gaussians, means=halves.means @ turn.T)
    first = source(halves, encoder_file).raw(torch.arange(384))
    second = source(halves, encoder_file, gaussians=lying, up=(0.0, 1.0, 0.0))
    found = second.raw(torch.arange(384))
    torch.testing.assert_close(found.parts[0][0], first.parts[0][0], atol=2e-2, rtol=1e-2)


def test_none_left_to_decode() -> None:
    with pytest.raises(InputError, match="at least 30 pixels, got none of 4"):
        check_decoded(torch.zeros(4, dtype=torch.bool), 30)
