"""Instances matched by their mean IoU over views: solved by hand, and against a plain twin."""

import itertools

import numpy as np
import pytest
import torch

from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.evaluate import instance_score
from splatseg.evaluate.overlaps import Overlaps
from splatseg_bench.measures import matched_instance_score


def maps(*rows):
    return torch.tensor([list(row) for row in rows])


# Two views of 1 x 8 pixels. True instance 1 is large in a, small in b; 2 is in b alone.
TRUTH_A, TRUTH_B = maps([1, 1, 1, 1, 1, 1, -1, -1]), maps([1, 1, 2, 2, 2, 2, -1, -1])
DRAWN_A, DRAWN_B = maps([5, 5, 5, 5, 5, 5, 5, 5]), maps([5, 6, 6, 6, 6, 6, 6, -1])
VIEWS = [("a", DRAWN_A, TRUTH_A), ("b", DRAWN_B, TRUTH_B)]


def test_by_hand_where_no_id_is_no_object() -> None:
    """Void pixels are out: in a, 5 is 1; in b, 5 has one pixel of 1, and 6 all of 2 and one more.

    s(1, 5) = (1 + 1/2) / 2, s(1, 6) = (0 + 1/6) / 2, s(2, 6) = 4/5, s(2, 5) = 0.
    """
    score = matched_instance_score(VIEWS, none_is_object=False)
    assert dict(score.matches) == {1: (5, 0.75), 2: (6, 0.8)}
    assert score.miou == pytest.approx((0.75 + 0.8) / 2)
    assert (score.recall50, score.precision50) == (1, 1)
    assert (score.truth_instances, score.predicted_instances) == (2, 2)


def test_by_hand_where_no_id_is_an_object() -> None:
    """s(-1, -1) = (0 + 1/2) / 2 in b alone; s(1, 5) = (6/8 + 1/2) / 2; s(2, 6) = 4/6.

    s(-1, 5) = (2/8 + 0) / 2 and s(-1, 6) = (0 + 1/7) / 2 lose against these.
    """
    score = matched_instance_score(VIEWS)
    assert dict(score.matches) == {
        -1: (-1, 0.25), 1: (5, 0.625), 2: (6, pytest.approx(4 / 6)),
    }  # fmt: skip
    assert score.miou == pytest.approx((0.25 + 0.625 + 4 / 6) / 3)
    assert (score.truth_instances, score.predicted_instances) == (3, 3)
    assert score.recall50 == score.precision50 == pytest.approx(2 / 3)


def test_a_view_counts_alike_however_large_the_instance_is_there() -> None:
    """Right in 100 pixels of one view and wrong in 2 of another: half, and nearly all pooled."""
    large, small = torch.full((1, 100), 1), torch.full((1, 2), 1)
    views = [("a", large * 7, large), ("b", small * 8, small)]
    assert matched_instance_score(views).miou == 0.5
    assert matched_instance_score(views).recall50 == 0, "0.5 is not above 0.5"
    pooled = Overlaps.of(large * 7, large) + Overlaps.of(small * 8, small)
    assert instance_score(pooled).miou == pytest.approx(100 / 102)


def test_views_without_the_true_instance_do_not_count_against_its_match() -> None:
    one = maps([1, 1, 2, 2])
    views = [("a", maps([4, 4, 9, 9]), one), ("b", maps([4, 4, 4, 4]), maps([2, 2, 2, 2]))]
    score = matched_instance_score(views)
    assert score.matches[1] == (4, 1.0)
    assert score.matches[2] == (9, 0.5)


def test_the_sum_is_largest_of_all_ways_to_match() -> None:
    rng = np.random.default_rng(0)
    for _ in range(10):
        views = [
            (str(v), *(torch.tensor(rng.integers(-1, top, (6, 5))) for top in (4, 3)))
            for v in range(3)
        ]
        sums = np.zeros((4, 5))
        for t in range(-1, 3):
            seen = [(d, true) for _, d, true in views if bool((true == t).any())]
            for p in range(-1, 4):
                ious = [float(((d == p) & (x == t)).sum() / ((d == p) | (x == t)).sum())
                        for d, x in seen]  # fmt: skip
                sums[t + 1, p + 1] = np.mean(ious) if ious else 0
        best = max(
            sum(sums[i, j] for i, j in enumerate(order))
            for order in itertools.permutations(range(5), 4)
        )
        score = matched_instance_score(iter(views))
        assert score.miou == pytest.approx(best / 4)


def test_objects_without_a_partner() -> None:
    """More true than predicted: recall; more predicted than true: precision."""
    few, many = maps([1, 1, 1, 1]), maps([1, 2, 3, 4])
    score = matched_instance_score([("a", few, many)])
    assert (score.miou, score.recall50, score.precision50) == (0.25 / 4, 0, 0)
    score = matched_instance_score([("a", many, few)])
    assert (score.truth_instances, score.predicted_instances) == (1, 4)
    score = matched_instance_score([("a", few * -1, few)], none_is_object=False)
    assert (score.miou, score.precision50, score.predicted_instances) == (0, 0, 0)


def test_faults_are_named() -> None:
    with pytest.raises(InputError, match="each view once, got 'a' twice"):
        matched_instance_score([VIEWS[0], VIEWS[0]])
    with pytest.raises(InputError, match="at least one true instance"):
        matched_instance_score([])
    void = torch.full((1, 4), -1)
    with pytest.raises(InputError, match="at least one true instance"):
        matched_instance_score([("a", void, void)], none_is_object=False)
    assert matched_instance_score([("a", void, void)]).miou == 1
    with pytest.raises(ShapeError, match="truth's size"):
        matched_instance_score([("a", void, void[:, :3])])
    with pytest.raises(RangeError, match="-1 or more, got -2"):
        matched_instance_score([("a", void - 1, void)])
