"""Categories of tracks are told apart by object."""

import pytest
import torch

from splatseg.errors import RangeError
from splatseg.lift.object_classes import PooledObjects, with_categories


def objects(votes: list[list[float]], classes: list[int]) -> PooledObjects:
    count = len(votes)
    return PooledObjects(
        ids=torch.arange(count),
        classes=torch.tensor(classes),
        votes=torch.tensor(votes, dtype=torch.float64),
        features=torch.rand(count, 2, dtype=torch.float64),
        known=torch.ones(count, dtype=torch.bool),
    )


def test_one_round_gives_every_object_all_that_its_tracks_were_taken_for() -> None:
    pooled = objects([[0, 2, 3], [1, 3, 3]], [2, 4, 9])
    taken = {4: {1: 3.0, 6: 1.0}, 9: {6: 2.0}, 2: {1: 0.0}, 77: {5: 1.0}}
    found = with_categories(pooled, taken, rounds=1)
    assert found.classes.tolist() == [1, 5, 6]
    # Nothing is known of track 2: its vote for the second object is none.
    expected = [[1.5, 0, 0.5 + 3], [2.25, 0, 0.75 + 3]]
    torch.testing.assert_close(found.votes, torch.tensor(expected, dtype=torch.float64))
    assert torch.equal(found.features, pooled.features)


def test_a_second_round_by_hand() -> None:
    # Track 4 covers both objects alike and was taken for 1 and 6 alike; track 9 is of object 1
    # alone. After a round object 0 is (1/2, 1/2) and object 1 (1/4, 3/4).
    pooled = objects([[4, 0], [4, 4]], [4, 9])
    found = with_categories(pooled, {4: {1: 1.0, 6: 1.0}, 9: {6: 5.0}}, rounds=2)
    # Expected of track 4: 4 (1/2 + 1/4) = 3 and 5, taken 4 and 4; of track 9: 1 and 3, taken 0, 4.
    first = [1 / 2 * 4 * 4 / 3, 1 / 2 * 4 * 4 / 5]
    second = [1 / 4 * 4 * 4 / 3, 3 / 4 * (4 * 4 / 5 + 4 * 4 / 3)]
    expected = [[4 * x / sum(first) for x in first], [8 * x / sum(second) for x in second]]
    torch.testing.assert_close(found.votes, torch.tensor(expected, dtype=torch.float64))


def test_a_track_that_moved_on_is_told_apart_by_the_tracks_beside_it() -> None:
    # Track 0 is half of object 0, half of object 1; tracks 1 and 2 are of one each. Together
    # the tracks say that object 0 is 3 and object 1 is 8.
    pooled = objects([[50, 10, 0], [50, 0, 10]], [0, 1, 2])
    taken = {0: {3: 52.0, 8: 48.0}, 1: {3: 9.0, 8: 1.0}, 2: {8: 5.5, 3: 4.5}}
    once = with_categories(pooled, taken, rounds=1).votes
    found = with_categories(pooled, taken).votes
    assert once.argmax(dim=1).tolist() == [0, 0]
    assert found.argmax(dim=1).tolist() == [0, 1]
    many = with_categories(pooled, taken, rounds=200).votes
    assert many.amax(dim=1).tolist() > found.amax(dim=1).tolist()
    # Votes are only divided anew.
    torch.testing.assert_close(found.sum(dim=1), pooled.votes.sum(dim=1))


def test_likelihood_does_not_fall() -> None:
    generator = torch.Generator().manual_seed(3)
    pooled = objects((100 * torch.rand(6, 9, generator=generator) ** 4).tolist(), list(range(9)))
    share = torch.rand(9, 4, generator=generator, dtype=torch.float64) ** 3
    taken = {t: dict(enumerate(share[t].tolist())) for t in range(9)}
    mass = share / share.sum(dim=1, keepdim=True) * pooled.votes.sum(dim=0)[:, None]
    last = -float("inf")
    for rounds in (1, 2, 3, 10, 40):
        votes = with_categories(pooled, taken, rounds=rounds).votes
        answers = votes / votes.sum(dim=1, keepdim=True)
        now = float((mass * torch.log(pooled.votes.T @ answers)).sum())
        assert now > last
        last = now


def test_without_anything_known() -> None:
    pooled = objects([[2.0], [0.0]], [5])
    assert not with_categories(pooled, {5: {1: 0.0}}).votes.any()
    assert with_categories(pooled, {}).votes.shape == (2, 0)
    # An object without a vote is of no class.
    assert not with_categories(pooled, {5: {1: 2.0}}).votes[1].any()


def test_what_is_wrong_is_refused() -> None:
    pooled = objects([[2.0]], [4])
    with pytest.raises(RangeError, match="0 or more of id 4, got -1"):
        with_categories(pooled, {4: {1: -1.0}})
    with pytest.raises(RangeError, match="rounds: expected at least 1, got 0"):
        with_categories(pooled, {4: {1: 1.0}}, rounds=0)
