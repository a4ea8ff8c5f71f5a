"""Points in cells: means, numbers of cells, and no order."""

import math

import numpy as np
import pytest
import torch

from splatseg.lift import point_shapes
from splatseg.lift.point_shapes import (
    LocalShapes,
    ShapeForest,
    ShapeSamples,
    drawn,
    local_shapes,
    packed_keys,
    smoothed,
    thin,
)


def test_cells_are_of_the_grid_and_centres_the_means_of_their_points() -> None:
    points = torch.tensor([[0.1, 0.1, 0.1], [0.3, 0.1, 0.1], [-0.1, 0.1, 0.1], [1.2, 0.1, 0.1]])
    found = thin(points.double(), 0.5)
    assert found.cell_of.tolist() == [1, 1, 0, 2]
    expected = torch.tensor([[-0.1, 0.1, 0.1], [0.2, 0.1, 0.1], [1.2, 0.1, 0.1]]).double()
    torch.testing.assert_close(found.centres, expected, atol=0.5 / 4096, rtol=0)


def test_no_order_of_the_points_changes_a_bit(rng) -> None:
    points = torch.from_numpy(rng.normal(size=(500, 3)) * 3)
    order = torch.from_numpy(rng.permutation(500))
    one, other = thin(points, 1.0), thin(points[order], 1.0)
    assert torch.equal(one.centres, other.centres)
    assert torch.equal(one.hashes, other.hashes)
    assert torch.equal(one.cell_of[order], other.cell_of)


def test_hashes_are_of_the_cell_and_not_of_what_else_is_there() -> None:
    pair = torch.tensor([[0.5, 0.5, 0.5], [9.5, 0.5, 0.5]], dtype=torch.float64)
    both, last = thin(pair, 1.0), thin(pair[1:], 1.0)
    assert both.hashes[1] == last.hashes[0]
    assert both.hashes[0] != both.hashes[1]
    assert bool((both.hashes >= 0).all())


def test_keys_are_ordered_as_their_coordinates() -> None:
    rows = np.array([[-2, 5], [-2, 6], [-1, -9], [0, 0], [3, -1]])
    keys = packed_keys(rows)
    assert bool((np.diff(keys) > 0).all())
    assert len(np.unique(packed_keys(np.array([[1, 2, 3], [3, 2, 1], [2, 1, 3]])))) == 3


def test_no_points_are_no_cells() -> None:
    assert len(thin(torch.zeros(0, 3).double(), 0.1)) == 0


UP = torch.tensor([0.0, 0, 2.0])
LINEAR, PLANAR, SCATTER, SIZE, NORMAL_UP, LONG_UP = range(6)


def described(points: torch.Tensor, up: torch.Tensor = UP) -> torch.Tensor:
    return local_shapes(points.double(), up).features.median(dim=0).values


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
    # A hole in the column beside the pole's, and a deeper one two columns away.
    holes = torch.tensor([[0.75, 0.25, -2.0], [1.25, 0.25, -7.0]]).double()
    found = local_shapes(torch.cat((pole.T.double(), ground, holes)), UP)
    # Of the narrow columns the first three, behind the two shapes of six numbers.
    around, own, below = found.features[20, 12:15].tolist()
    assert around == pytest.approx(4.0, abs=1e-5)
    assert own == pytest.approx(3.0, abs=1e-5)
    assert below == pytest.approx(0.9, abs=1e-5)


def test_neighbours_are_the_nearest_others() -> None:
    line = torch.stack((torch.arange(40.0), torch.zeros(40), torch.zeros(40)), dim=1).double()
    found = local_shapes(line, UP)
    assert found.neighbours[0].tolist() == list(range(1, 17))
    assert found.distances[0].tolist() == list(range(1, 17))
    assert sorted(found.neighbours[20, :2].tolist()) == [19, 21]


def test_moved_and_turned_about_up_a_shape_is_the_same(rng) -> None:
    cloud = torch.from_numpy(rng.random((200, 3))) * torch.tensor([3.0, 1.0, 0.3])
    one = local_shapes(cloud, UP).features[:, :12]
    turn = torch.tensor([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]]).double()
    other = local_shapes(cloud @ turn.T + torch.tensor([40.0, -7, 3]), UP).features[:, :12]
    torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-4)
    tipped = local_shapes(cloud[:, [0, 2, 1]], torch.tensor([0.0, 1, 0])).features[:, :12]
    torch.testing.assert_close(one, tipped, atol=1e-4, rtol=1e-4)


def test_few_points_have_shapes_too() -> None:
    for count in (0, 1, 2):
        found = local_shapes(torch.rand(count, 3).double(), UP)
        assert bool(torch.isfinite(found.features).all())
        assert found.neighbours.shape == (count, 16)
    assert found.neighbours[0].tolist() == [1] + [-1] * 15


SHARES = torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])


def graph(distances=((1.0, 2.0), (1.0, 1.0), (1.0, 2.0)), normals=None) -> LocalShapes:
    flat = torch.tensor([[0.0, 0, 1]]).repeat(3, 1)
    return LocalShapes(
        features=torch.zeros(3, 1),
        normals=flat if normals is None else torch.tensor(normals),
        neighbours=torch.tensor([[1, 2], [0, 2], [1, 0]]),
        distances=torch.tensor(distances),
    )


def smooth(shapes: LocalShapes, steps=1, weight=0.5, width=1.0, normal_width=0.2) -> torch.Tensor:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(point_shapes, "SMOOTHING", weight)
        patch.setattr(point_shapes, "SMOOTHING_WIDTH", width)
        patch.setattr(point_shapes, "NORMAL_WIDTH", normal_width)
        return smoothed(SHARES, shapes, steps=steps)


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
    alone = LocalShapes(
        features=torch.zeros(3, 1),
        normals=torch.zeros(3, 3),
        neighbours=torch.full((3, 2), -1),
        distances=torch.full((3, 2), math.inf),
    )
    torch.testing.assert_close(smooth(alone, steps=5), SHARES)


def samples(features, labels, hashes=None, weights=None, count=3) -> ShapeSamples:
    labels = torch.tensor(labels)
    return ShapeSamples(
        features=torch.as_tensor(features, dtype=torch.float32),
        labels=labels,
        weights=torch.ones(len(labels)) if weights is None else weights,
        hashes=torch.arange(len(labels)) if hashes is None else torch.tensor(hashes),
        totals=torch.bincount(labels, minlength=count).double(),
    )


def test_of_each_label_the_smallest_hashes_are_kept() -> None:
    rows = torch.arange(6.0)[:, None]
    found = drawn([samples(rows, [0, 0, 0, 1, 1, 2], hashes=[5, 3, 4, 9, 8, 7])], 2)
    assert found.features[:, 0].tolist() == [1, 2, 4, 3, 5]
    assert found.labels.tolist() == [0, 0, 1, 1, 2]
    assert found.totals.tolist() == [3, 2, 1]


def test_a_sample_of_samples_is_the_sample_of_all(rng) -> None:
    labels = rng.integers(0, 3, 50)
    hashes = rng.permutation(50)
    rows = torch.from_numpy(rng.random((50, 2)))
    whole = drawn([samples(rows, labels.tolist(), hashes.tolist())], 4)
    parts = [
        drawn([samples(rows[part], labels[part].tolist(), hashes[part].tolist())], 4)
        for part in (slice(0, 17), slice(17, 50))
    ]
    again = drawn(parts, 4)
    assert torch.equal(whole.features, again.features)
    assert torch.equal(whole.totals, again.totals)


def test_trees_tell_shapes_apart_and_rows_add_up_to_one(rng) -> None:
    rows = torch.from_numpy(rng.random((90, 2)).astype("float32"))
    labels = (rows[:, 0] > 0.5).long() * 2
    forest = ShapeForest(samples(rows, labels.tolist()), trees=10, seed=0)
    told = forest.shares(torch.tensor([[0.1, 0.5], [0.9, 0.5]]))
    assert told.argmax(dim=1).tolist() == [0, 2]
    assert told[:, 1].tolist() == [0, 0]
    torch.testing.assert_close(told.sum(dim=1), torch.ones(2))


def test_a_label_counts_as_often_as_it_came_though_few_were_kept() -> None:
    rows = torch.zeros(20, 1)
    found = samples(rows, [0] * 10 + [1] * 10)
    found.totals[0] = 30
    told = ShapeForest(found, trees=3, seed=0).shares(torch.zeros(1, 1))
    torch.testing.assert_close(told, torch.tensor([[0.75, 0.25, 0.0]]))


def test_unsure_points_teach_less() -> None:
    sure = torch.cat((torch.ones(10), torch.full((10,), 0.25)))
    found = samples(torch.zeros(20, 1), [0] * 10 + [1] * 10, weights=sure)
    told = ShapeForest(found, trees=3, seed=0).shares(torch.zeros(1, 1))
    torch.testing.assert_close(told, torch.tensor([[0.8, 0.2, 0.0]]))


@pytest.mark.bits
def test_threads_and_blocks_change_nothing(rng, monkeypatch) -> None:
    rows = torch.from_numpy(rng.random((200, 3)).astype("float32"))
    given = samples(rows, rng.integers(0, 3, 200).tolist())
    asked = torch.from_numpy(rng.random((100, 3)).astype("float32"))
    one = ShapeForest(given, trees=8, seed=4).shares(asked)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    monkeypatch.setattr("splatseg.lift.point_shapes._ROWS", 7)
    assert torch.equal(one, ShapeForest(given, trees=8, seed=4).shares(asked))
    assert not torch.equal(one, ShapeForest(given, trees=8, seed=5).shares(asked))


def test_heights_count_from_the_lowest_of_a_column_and_of_those_around_it() -> None:
    across = np.array([[0.5, 0.5], [0.6, 0.4], [1.5, 0.5], [3.5, 0.5]])
    height = np.array([1.0, 3.0, 0.5, -4.0])
    found = point_shapes._in_columns(across, height, 1.0)
    # Above the lowest of nine columns, above the own lowest, below the own highest.
    assert found.tolist() == [[0.5, 0, 2], [2.5, 2, 0], [0, 0, 0], [0, 0, 0]]
