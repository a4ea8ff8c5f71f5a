"""Smoothing over a graph of three points, by hand."""

import math

import pytest
import torch

from splatseg.lift.points.shapes import Surroundings
from splatseg.lift.points.smooth import smoothed

SHARES = torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])


def graph(distances=((1.0, 2.0), (1.0, 1.0), (1.0, 2.0)), normals=None) -> Surroundings:
    flat = torch.tensor([[0.0, 0, 1]]).repeat(3, 1)
    return Surroundings(
        features=torch.zeros(3, 1),
        normals=flat if normals is None else torch.tensor(normals),
        neighbours=torch.tensor([[1, 2], [0, 2], [1, 0]]),
        distances=torch.tensor(distances),
    )


def smooth(around: Surroundings, **options) -> torch.Tensor:
    given = {"steps": 1, "weight": 0.5, "width": 1.0, "normal_width": 0.2} | options
    return smoothed(SHARES, around, **given)


def test_one_step_is_the_formula() -> None:
    near, far = math.exp(-0.5), math.exp(-2.0)
    found = smooth(graph())
    assert found[0].tolist() == pytest.approx([0.5, 0.5])
    assert found[1].tolist() == pytest.approx([0.25, 0.75])
    assert found[2].tolist() == pytest.approx(
        [0.5 * far / (near + far), 1 - 0.5 * far / (near + far)]
    )


def test_steps_weight_and_width_count() -> None:
    torch.testing.assert_close(smooth(graph(), steps=0), SHARES)
    torch.testing.assert_close(smooth(graph(), weight=0.0), SHARES)
    twice = smooth(graph(), steps=2)
    # The first point again: half its own, and of the others what they were after one step.
    near, far = math.exp(-0.5), math.exp(-2.0)
    once = smooth(graph())
    mean = (near * once[1] + far * once[2]) / (near + far)
    torch.testing.assert_close(twice[0], 0.5 * SHARES[0] + 0.5 * mean)
    # Of a width of 0.3 nothing is within three widths: each keeps its own.
    torch.testing.assert_close(smooth(graph(), width=0.3), SHARES)


def test_surfaces_at_an_angle_count_less_and_signs_of_normals_not() -> None:
    turned = [[0.0, 0, 1], [0.0, 0, -1], [1.0, 0, 0]]
    found = smooth(graph(((1.0, 1.0),) * 3, turned))
    # The second lies as the first does; the third stands on it: exp(-1 / 0.2) as much.
    edge = math.exp(-5)
    assert found[1].tolist() == pytest.approx([0.5 / (1 + edge), 1 - 0.5 / (1 + edge)])
    wide = smooth(graph(((1.0, 1.0),) * 3, turned), normal_width=1e9)
    assert wide[1].tolist() == pytest.approx([0.25, 0.75])


def test_without_neighbours_what_is_known_stays() -> None:
    alone = Surroundings(
        features=torch.zeros(3, 1),
        normals=torch.zeros(3, 3),
        neighbours=torch.full((3, 2), -1),
        distances=torch.full((3, 2), math.inf),
    )
    torch.testing.assert_close(smooth(alone, steps=5), SHARES)
