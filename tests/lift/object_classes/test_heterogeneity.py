"""Disagreement of votes within objects and between their Gaussians, by hand."""

import pytest
import torch

from splatseg.core import Labels
from splatseg.errors import InputError, ShapeError
from splatseg.lift.object_classes import heterogeneity


def soft(candidates, shares, evidence) -> Labels:
    ids = torch.tensor(candidates)
    return Labels(
        ids=ids[:, 0], confidence=torch.ones(len(ids)), candidates=ids,
        shares=torch.tensor(shares), evidence=torch.tensor(evidence),
    )  # fmt: skip


def hard(ids) -> Labels:
    return Labels(ids=torch.tensor(ids), confidence=torch.ones(len(ids)))


def test_by_hand() -> None:
    """One object of masses 1 and 3, votes (1, 0) and (0.6, 0.4): mean (0.7, 0.3)."""
    votes = soft([[4, 9], [4, 9], [9, 4]], [[1.0, 0.0], [0.6, 0.4], [1.0, 0.0]], [1.0, 3.0, 2.0])
    total = 4 * (1 - 0.7**2 - 0.3**2)
    within = 3 * (1 - 0.6**2 - 0.4**2)
    # The third is of no object.
    assert heterogeneity(hard([1, 1, -1]), votes) == pytest.approx(1 - within / total)
    # Alone in an object it agrees with itself, and adds nothing.
    assert heterogeneity(hard([1, 1, 2]), votes) == pytest.approx(1 - within / total)
    # Each in an object of its own: nothing is between.
    assert heterogeneity(hard([1, 2, 3]), votes) == pytest.approx(0, abs=1e-12)


def test_what_fills_the_images_does_not_decide_alone() -> None:
    shares = [[1.0, 0.0], [1.0, 0.0]]
    votes = soft([[4, -1], [9, -1]], shares, [1e6, 20.0])
    assert heterogeneity(hard([1, 1]), votes) == 1
    mixed = soft([[4, 9], [4, 9]], [[0.5, 0.5], [1.0, 0.0]], [1e6, 20.0])
    even = soft([[4, 9], [4, 9]], [[0.5, 0.5], [1.0, 0.0]], [20.0, 20.0])
    assert heterogeneity(hard([1, 1]), mixed) == heterogeneity(hard([1, 1]), even)


def test_nothing_to_disagree_about() -> None:
    votes = soft([[4, 9], [4, 9]], [[1.0, 0.0], [1.0, 0.0]], [1.0, 1.0])
    assert heterogeneity(hard([1, 1]), votes) == 0
    assert heterogeneity(hard([-1, -1]), votes) == 0
    unseen = soft([[4, 9], [9, 4]], [[1.0, 0.0], [1.0, 0.0]], [0.0, 0.0])
    assert heterogeneity(hard([1, 1]), unseen) == 0


def test_what_cannot_be_compared_is_refused() -> None:
    votes = soft([[4, 9]], [[1.0, 0.0]], [1.0])
    with pytest.raises(ShapeError, match="votes: expected 2 rows, got 1"):
        heterogeneity(hard([1, 1]), votes)
    with pytest.raises(InputError, match="votes: expected a soft layer with evidence"):
        heterogeneity(hard([1]), hard([4]))
