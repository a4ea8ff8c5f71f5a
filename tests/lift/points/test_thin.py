"""Points in cells: means, numbers of cells, and no order."""

import numpy as np
import torch

from splatseg.lift.points.thin import packed_keys, thin


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
