"""Shapes of things whose shape is known, and of a graph solved by hand."""

import numpy as np
import pytest
import torch

from splatseg.lift.points.shapes import surroundings

UP = torch.tensor([0.0, 0, 2.0])
LINEAR, PLANAR, SCATTER, SIZE, NORMAL_UP, LONG_UP = range(6)


def described(points: torch.Tensor, up: torch.Tensor = UP) -> torch.Tensor:
    return surroundings(points.double(), up).features.median(dim=0).values


def grid(*axes: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, len(axes)))


def test_a_floor_a_wall_a_pole_and_a_bush_are_told_apart(rng) -> None:
    steps = np.arange(15) * 0.1
    floor = grid(steps, steps, np.zeros(1))
    wall = floor[:, [0, 2, 1]]
    pole = torch.stack((torch.zeros(60), torch.zeros(60), torch.arange(60) * 0.1), dim=1)
    bush = torch.from_numpy(rng.random((600, 3)))
    flat, upright, post, leaves = (described(part) for part in (floor, wall, pole, bush))
    assert flat[SCATTER] == pytest.approx(0, abs=1e-6)
    assert flat[NORMAL_UP] == pytest.approx(1)
    assert flat[PLANAR] > 0.5
    assert upright[NORMAL_UP] == pytest.approx(0, abs=1e-6)
    assert post[LINEAR] == pytest.approx(1)
    assert post[LONG_UP] == pytest.approx(1)
    assert leaves[SCATTER] > 0.3


def test_heights_are_over_the_lowest_and_below_the_highest() -> None:
    pole = torch.stack((torch.full((30,), 0.25), torch.full((30,), 0.25), torch.arange(30) * 0.1))
    ground = grid(np.arange(-20, 20) * 0.1, np.arange(-20, 20) * 0.1, np.array([-1.0]))
    found = surroundings(torch.cat((pole.T.double(), ground)), UP)
    # Of the narrow columns the first three, behind the two shapes of six numbers.
    around, own, below = found.features[20, 12:15].tolist()
    assert around == pytest.approx(3.0, abs=1e-5)
    assert own == pytest.approx(3.0, abs=1e-5)
    assert below == pytest.approx(0.9, abs=1e-5)


def test_neighbours_are_the_nearest_others() -> None:
    line = torch.stack((torch.arange(40.0), torch.zeros(40), torch.zeros(40)), dim=1).double()
    found = surroundings(line, UP)
    assert found.neighbours[0].tolist() == list(range(1, 17))
    assert found.distances[0].tolist() == list(range(1, 17))
    assert sorted(found.neighbours[20, :2].tolist()) == [19, 21]


def test_moved_and_turned_about_up_a_shape_is_the_same(rng) -> None:
    cloud = torch.from_numpy(rng.random((200, 3))) * torch.tensor([3.0, 1.0, 0.3])
    one = surroundings(cloud, UP).features[:, :12]
    turn = torch.tensor([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]]).double()
    other = surroundings(cloud @ turn.T + torch.tensor([40.0, -7, 3]), UP).features[:, :12]
    torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-4)
    tipped = surroundings(cloud[:, [0, 2, 1]], torch.tensor([0.0, 1, 0])).features[:, :12]
    torch.testing.assert_close(one, tipped, atol=1e-4, rtol=1e-4)


def test_few_points_have_shapes_too() -> None:
    for count in (0, 1, 2):
        found = surroundings(torch.rand(count, 3).double(), UP)
        assert bool(torch.isfinite(found.features).all())
        assert found.neighbours.shape == (count, 16)
    assert found.neighbours[0].tolist() == [1] + [-1] * 15
