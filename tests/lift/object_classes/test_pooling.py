"""Votes and features of objects are sums over their Gaussians."""

import pytest
import torch

from splatseg.core import Labels
from splatseg.errors import InputError, ShapeError
from splatseg.lift.object_classes import pool_objects


def labels(ids, **more) -> Labels:
    return Labels(ids=torch.tensor(ids), confidence=torch.ones(len(ids)), **more)


def voted() -> Labels:
    return labels(
        [4, 9, 4, 9, -1],
        candidates=torch.tensor([[4, 9], [9, -1], [4, 2], [9, 4], [-1, -1]]),
        shares=torch.tensor([[0.75, 0.25], [1.0, 0.0], [0.5, 0.5], [0.6, 0.4], [0.0, 0.0]]),
        evidence=torch.tensor([4.0, 2.0, 10.0, 5.0, 0.0]),
    )


def test_by_hand() -> None:
    scales = (torch.tensor([[1.0], [3.0], [10.0], [7.0], [9.0]]), torch.arange(10.0).view(5, 2))
    weights = torch.tensor([1.0, 3.0, 2.0, 0.0, 5.0])
    found = pool_objects(labels([7, 7, -1, 3, 7]), voted(), scales, weights)
    assert found.ids.tolist() == [3, 7]
    assert found.classes.tolist() == [2, 4, 9]
    # Object 3 is Gaussian 3; object 7 is Gaussians 0, 1 and 4, which nothing votes for.
    expected = [[0, 2, 3], [0, 3, 3]]
    torch.testing.assert_close(found.votes, torch.tensor(expected, dtype=torch.float64))
    assert found.known.tolist() == [False, True]
    mean = [(1 * 1 + 3 * 3 + 9 * 5) / 9, (0 + 2 * 3 + 8 * 5) / 9, (1 + 3 * 3 + 9 * 5) / 9]
    torch.testing.assert_close(found.features[1], torch.tensor(mean, dtype=torch.float64))
    assert not found.features[0].any()


def test_without_objects() -> None:
    found = pool_objects(labels([-1] * 5), voted(), (torch.ones(5, 1),), torch.ones(5))
    assert (len(found.ids), found.votes.shape) == (0, (0, 3))


def test_what_does_not_fit_is_refused() -> None:
    ones = torch.ones(5)
    with pytest.raises(InputError, match="shares of several ids"):
        pool_objects(labels([1] * 5), labels([1] * 5), (torch.ones(5, 1),), ones)
    with pytest.raises(InputError, match="expected features, got none"):
        pool_objects(labels([1] * 5), voted(), (), ones)
    with pytest.raises(ShapeError, match="same Gaussians"):
        pool_objects(labels([1] * 5), voted(), (torch.ones(4, 1),), ones)
