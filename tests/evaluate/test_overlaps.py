"""Sparse counts and the matching of instances, by hand and against the independent scorer."""

import numpy as np
import pytest
import torch

from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.evaluate.overlaps import Overlaps, best_pairs, instance_score


def in_memory(array: np.ndarray) -> torch.Tensor:
    """Ids of files (0 none) as those of memory (-1 none)."""
    ids = torch.from_numpy(array.astype(np.int64))
    return torch.where(ids == 0, -1, ids)


def blocks(rng: np.random.Generator, ids: int) -> np.ndarray:
    """Squares of equal ids, so that segments have a size."""
    return np.kron(rng.integers(0, ids, (5, 7)), np.ones((6, 6), np.int64))


def mixed(rng: np.random.Generator, truth: np.ndarray, *, shift: int) -> np.ndarray:
    """Mostly the truth under other ids, with holes and splits."""
    renamed = np.where(truth > 0, (truth * 7) % 11 + shift, 0)
    renamed = np.where(rng.random(truth.shape) < 0.15, 0, renamed)
    split = (renamed == renamed.max()) & (np.arange(truth.shape[1]) % 2 == 0)
    return np.where(split, 300 + renamed, renamed)


@pytest.mark.parametrize("case", range(4))
def test_instances_equal_the_scorers(rng, score, maps_in, case) -> None:
    rng = np.random.default_rng(case)
    truth = [blocks(rng, 9) for _ in range(3)]
    predicted = [mixed(rng, t, shift=case) for t in truth]
    if case == 3:  # nothing at all is right, and most of it is missing
        predicted = [np.where(rng.random(t.shape) < 0.1, 5, 0) for t in truth]
    theirs = score("instances", "--pred", maps_in("p", predicted), "--truth", maps_in("t", truth))
    total = Overlaps.none()
    for p, t in zip(predicted, truth, strict=True):
        total = total + Overlaps.of(in_memory(p), in_memory(t))
    ours = instance_score(total)
    assert ours.miou == pytest.approx(theirs["mIoU"], abs=1e-12)
    assert ours.recall50 == pytest.approx(theirs["recall50"], abs=1e-12)
    assert ours.precision50 == pytest.approx(theirs["precision50"], abs=1e-12)
    assert ours.truth_instances == theirs["truth_instances"]
    assert ours.predicted_instances == theirs["predicted_instances"]


def test_instance_score_by_hand() -> None:
    """Best for the sum, not the best for each: instance 1 gives up the larger half of 5."""
    truth = torch.tensor([[1] * 6 + [2] * 4 + [3] * 2 + [-1] * 3])
    predicted = torch.tensor([[5] * 4 + [6] * 2 + [5] * 4 + [-1] * 2 + [7] * 3])
    score = instance_score(Overlaps.of(predicted, truth))
    # 1-5: 4 of 6 + 8 - 4 = 10; 1-6: 2 of 6; 2-5: 4 of 8. Sums: 1-5 alone .4, 1-6 and 2-5 .8333.
    assert score.matches == {1: (6, pytest.approx(1 / 3)), 2: (5, pytest.approx(1 / 2))}
    assert score.miou == pytest.approx((1 / 3 + 1 / 2 + 0) / 3)
    # 0.5 is not above 0.5; the instance 7 lies on void only and is not counted.
    assert (score.recall50, score.precision50) == (0, 0)
    assert (score.truth_instances, score.predicted_instances) == (3, 2)


def test_no_prediction_scores_zero_and_no_truth_is_refused() -> None:
    nothing = torch.full((2, 3), -1)
    score = instance_score(Overlaps.of(nothing, torch.ones(2, 3, dtype=torch.int64)))
    assert (score.miou, score.predicted_instances, dict(score.matches)) == (0, 0, {})
    with pytest.raises(InputError, match="at least one instance"):
        instance_score(Overlaps.of(torch.ones(2, 3, dtype=torch.int64), nothing))
    with pytest.raises(InputError, match="at least one instance"):
        instance_score(Overlaps.none())


def test_sums_do_not_depend_on_the_order_of_views(rng) -> None:
    views = [
        Overlaps.of(
            torch.from_numpy(rng.integers(-1, 9, (6, 8))),
            torch.from_numpy(rng.integers(-1, 9, (6, 8))),
        )
        for _ in range(4)
    ]
    forward = sum(views, start=Overlaps.none())
    backward = sum(reversed(views), start=Overlaps.none())
    assert torch.equal(forward.pairs, backward.pairs)
    assert torch.equal(forward.counts, backward.counts)
    assert int(forward.counts.sum()) == sum(int(v.counts.sum()) for v in views)


def test_ids_have_no_limit() -> None:
    """Ids far apart cost nothing, and ids that share their low bits are not confused."""
    big = 2**45
    truth = torch.tensor([[big, big, 0, big + 2**32]])
    found = Overlaps.of(torch.tensor([[2**44, 7, 7, -1]]), truth)
    assert found.pairs.tolist() == [[0, 7], [big, 7], [big, 2**44], [big + 2**32, -1]]
    assert found.counts.tolist() == [1, 1, 1, 1]


def test_sparse_matching_reaches_the_sum_of_the_dense_one(rng) -> None:
    for _ in range(20):
        rows, columns = np.nonzero(rng.random((9, 14)) < 0.3)
        values = rng.random(len(rows))
        values[: min(2, len(values))] = 1.0  # a cost of zero must stay an edge
        dense = best_pairs(rows, columns, values, shape=(9, 14))
        sparse = best_pairs(rows, columns, values, shape=(9, 14), dense_cells=0)
        assert sum(v for *_, v in sparse) == pytest.approx(sum(v for *_, v in dense), abs=1e-12)
        assert len({r for r, *_ in sparse}) == len({c for _, c, _ in sparse}) == len(sparse)


def test_bad_input_is_named() -> None:
    with pytest.raises(ShapeError, match="predicted"):
        Overlaps.of(torch.zeros(2, 2), torch.zeros(2, 3))
    with pytest.raises(RangeError, match="truth"):
        Overlaps.of(torch.zeros(1, 1), torch.full((1, 1), -2))
    with pytest.raises(ShapeError, match="counts"):
        Overlaps(pairs=torch.zeros(2, 2).long(), counts=torch.zeros(3).long())
    with pytest.raises(ShapeError, match="values"):
        best_pairs(np.zeros(2, np.int64), np.zeros(2, np.int64), np.zeros(1), shape=(1, 1))
