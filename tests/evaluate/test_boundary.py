"""Boundary IoU by hand, and its band against d erosions by 3 x 3 pixels."""

import math

import numpy as np
import pytest
import torch

from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.evaluate.boundary import (
    BoundaryCounts,
    boundary_band,
    boundary_overlap,
    boundary_score,
    boundary_width,
)


def eroded_band(mask: np.ndarray, distance: int) -> np.ndarray:
    """As the authors do it: the mask less d erosions by 3 x 3 pixels, with zeros around it."""
    inner = np.pad(mask, 1)
    for _ in range(distance):
        grown = np.pad(inner, 1)
        rows, columns = inner.shape
        inner = np.all(
            [grown[i : i + rows, j : j + columns] for i in range(3) for j in range(3)], axis=0
        )
    return mask & ~inner[1:-1, 1:-1]


@pytest.mark.parametrize("distance", [1, 2, 5, 40])
def test_the_band_is_that_of_erosions(rng, distance) -> None:
    ids = np.kron(rng.integers(0, 3, (4, 5)), np.ones((8, 9), np.int64))
    band = boundary_band(torch.from_numpy(ids), distance=distance).numpy()
    for id in range(3):
        assert np.array_equal(band & (ids == id), eroded_band(ids == id, distance))


def reference(pairs, id: int) -> float:
    both = either = 0
    for predicted, truth in pairs:
        distance = max(1, round(0.02 * math.hypot(*truth.shape)))
        p, t = eroded_band(predicted == id, distance), eroded_band(truth == id, distance)
        both, either = both + (p & t).sum(), either + (p | t).sum()
    return both / either


def test_scores_equal_those_of_single_masks(rng) -> None:
    pairs = []
    for _ in range(3):
        truth = np.kron(rng.integers(0, 4, (5, 6)), np.ones((18, 20), np.int64))
        predicted = np.where(rng.random(truth.shape) < 0.003, 5, np.roll(truth, 1, axis=1))
        pairs.append((predicted, truth))
    parts = [BoundaryCounts.of(torch.from_numpy(p), torch.from_numpy(t)) for p, t in pairs]
    score = boundary_score(parts[0] + parts[1] + parts[2])
    expected = {id: reference(pairs, id) for id in range(4)}
    assert dict(score.per_class) == pytest.approx(expected, abs=1e-12)
    assert score.mean == pytest.approx(sum(expected.values()) / 4, abs=1e-12)
    assert 0.1 < score.mean < 0.95


def test_two_squares_by_hand() -> None:
    """6 x 6 against the same one pixel to the right, in an image whose band is 1 pixel wide."""
    truth, predicted = torch.zeros(2, 20, 20, dtype=torch.bool)
    truth[5:11, 5:11] = True
    predicted[5:11, 6:12] = True
    assert boundary_width(20, 20) == 1
    # Bands of 20 pixels each; common are 5 in the top row and 5 in the bottom row.
    assert boundary_overlap(predicted, truth) == (10, 30)
    assert boundary_overlap(truth, truth) == (20, 20)
    assert boundary_overlap(truth & ~truth, truth & ~truth) == (0, 0)
    assert boundary_overlap(truth & ~truth, truth) == (0, 20)
    # A wider band takes in all of it: plain IoU.
    assert boundary_overlap(predicted, truth, ratio=0.2) == (30, 42)


def test_void_makes_no_boundary_of_the_predictions_own() -> None:
    truth = torch.ones(30, 30, dtype=torch.int64)
    truth[:, 20:] = -1
    counts = BoundaryCounts.of(torch.ones(30, 30, dtype=torch.int64), truth)
    assert counts.ids.tolist() == [1]
    both, in_truth, in_predicted = counts.counts[0].tolist()
    assert both == in_truth == in_predicted == 30 * 20 - 28 * 18
    # And what is predicted in the void does not count, nor does a prediction of nothing.
    elsewhere = torch.where(truth == -1, 2, -1)
    assert BoundaryCounts.of(elsewhere, truth).counts.tolist() == [[0, in_truth, 0]]


def test_a_class_only_predicted_is_no_member_of_the_mean() -> None:
    truth = torch.ones(12, 12, dtype=torch.int64)
    predicted = truth.clone()
    predicted[4, 4] = 8
    score = boundary_score(BoundaryCounts.of(predicted, truth))
    assert set(score.per_class) == {1}
    assert 0 < score.mean < 1


def test_bad_input_is_named() -> None:
    void = torch.full((4, 4), -1)
    with pytest.raises(InputError, match="all are void"):
        boundary_score(BoundaryCounts.of(torch.zeros(4, 4), void))
    with pytest.raises(RangeError, match="distance"):
        boundary_band(void, distance=0)
    with pytest.raises(RangeError, match="ratio"):
        boundary_width(3, 3, ratio=math.nan)
    with pytest.raises(ShapeError, match="predicted"):
        BoundaryCounts.of(void, void[1:])
    assert boundary_width(1, 1) == 1
