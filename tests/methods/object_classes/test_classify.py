"""Objects get the class of their votes and of what they look like."""

import numpy as np
import pytest
import torch

from splatseg.core import Labels
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.methods.object_classes import classify
from splatseg.methods.object_classes.classify import (
    PooledObjects,
    classify_objects,
    heterogeneity,
    pool_objects,
    with_categories,
)

from .reference import classified


def pooled(votes, features, known=None) -> PooledObjects:
    votes = torch.as_tensor(votes, dtype=torch.float64)
    count = len(votes)
    return PooledObjects(
        ids=torch.arange(1, count + 1),
        classes=torch.arange(10, 10 + votes.shape[1]),
        votes=votes,
        features=torch.as_tensor(features, dtype=torch.float64),
        known=torch.ones(count, dtype=torch.bool) if known is None else torch.tensor(known),
    )


def classified_with(objects: PooledObjects, **constants) -> torch.Tensor:
    with pytest.MonkeyPatch.context() as patch:
        for name, value in constants.items():
            patch.setattr(classify, name, value)
        return classify_objects(objects)


def categories_after(rounds: int, pooled: PooledObjects, taken) -> PooledObjects:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(classify, "CATEGORY_ROUNDS", rounds)
        return with_categories(pooled, taken)


def random_objects(count=14, classes=4, channels=6, seed=2) -> PooledObjects:
    rng = np.random.default_rng(seed)
    true = rng.integers(classes, size=count)
    features = rng.normal(size=(classes, channels))[true] * 2 + rng.normal(size=(count, channels))
    votes = rng.random((count, classes)) * 500
    votes[np.arange(count), true] += 800
    known = np.ones(count, dtype=bool)
    known[3] = False
    return pooled(votes, features, known.tolist())


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"VOTE_EXPONENT": 4.0},
        {"FEATURE_EXPONENT": 0.6},
        {"VOTE_FLOOR": 0.2},
        {"FEATURE_COMPONENTS": 2},
        {"SHRINKAGE": 0.6},
        {"FULL_VOTES": 300.0},
        {"ROUNDS": 1},
    ],
)
def test_as_the_equations_say(change, monkeypatch) -> None:
    """Against loops; each constant makes a difference."""
    objects, constants = random_objects(), {"ROUNDS": 3, "FEATURE_EXPONENT": 0.3}
    usual = classified_with(objects, **constants)
    constants |= change
    found = classified_with(objects, **constants)
    for name, value in constants.items():
        monkeypatch.setattr(classify, name, value)
    expected = classified(
        objects.votes.numpy(), objects.features.numpy(), known=objects.known.numpy()
    )
    np.testing.assert_allclose(found.numpy(), expected, rtol=0, atol=1e-9)
    if change:
        assert not torch.allclose(found, usual, atol=1e-6)


def alike(seed=0):
    """Twelve objects of class 0 about one point and twelve of class 1 about another."""
    rng = np.random.default_rng(seed)
    centres = np.repeat([[3.0, 0, 0, 0], [-3.0, 0, 0, 0]], 12, axis=0)
    features = centres + 0.3 * rng.normal(size=(24, 4))
    votes = np.tile([[2000.0, 500, 0]], (24, 1))
    votes[12:] = [500, 2000, 0]
    return votes, features


def test_most_views_may_be_wrong_about_an_object_that_looks_like_others() -> None:
    votes, features = alike()
    votes[5] = [1100, 1400, 0]
    assert int(votes[5].argmax()) == 1
    found = classify_objects(pooled(votes, features))
    assert found.argmax(dim=1).tolist() == [0] * 12 + [1] * 12
    alone = classified_with(pooled(votes, features), FEATURE_EXPONENT=0.0)
    assert int(alone[5].argmax()) == 1


def test_the_only_one_of_its_class_is_not_drawn_to_another() -> None:
    """It has some votes for a class that no other is of, and looks like none of the others."""
    votes, features = alike()
    votes = np.vstack((votes, [1400, 0, 1200]))
    features = np.vstack((features, [0, 9.0, 0, 0]))
    found = classify_objects(pooled(votes, features))
    assert int(found[-1].argmax()) == 2
    assert found[:-1].argmax(dim=1).tolist() == [0] * 12 + [1] * 12


def test_without_votes_there_is_no_answer_and_without_features_votes_decide() -> None:
    votes, features = alike()
    votes[0] = 0
    votes[1] = [900, 1600, 0]
    found = classify_objects(pooled(votes, features, [True, False] + [True] * 22))
    assert not found[0].any()
    shares = torch.tensor([900, 1600, 0.0], dtype=torch.float64) / 2500
    expected = torch.softmax(2 * torch.log(shares + 0.01), dim=0)
    torch.testing.assert_close(found[1], expected)
    nothing = classify_objects(pooled(np.zeros((3, 2)), np.zeros((3, 4))))
    assert not nothing.any()


def test_features_that_say_nothing_change_nothing() -> None:
    votes, _ = alike()
    found = classify_objects(pooled(votes, np.ones((24, 4))))
    alone = classified_with(pooled(votes, np.ones((24, 4))), FEATURE_EXPONENT=0.0)
    assert torch.equal(found, alone)
    one = classify_objects(pooled([[3.0, 1.0]], [[1.0, 2.0]]))
    assert int(one[0].argmax()) == 0


@pytest.mark.bits
def test_bits_do_not_depend_on_threads() -> None:
    objects = random_objects(60, 9, 40)
    before = torch.get_num_threads()
    try:
        found = []
        for threads in (1, 2):
            torch.set_num_threads(threads)
            found.append(classify_objects(objects))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(*found)


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
    found = categories_after(1, pooled, taken)
    assert found.classes.tolist() == [1, 5, 6]
    # Nothing is known of track 2: its vote for the second object is none.
    expected = [[1.5, 0, 0.5 + 3], [2.25, 0, 0.75 + 3]]
    torch.testing.assert_close(found.votes, torch.tensor(expected, dtype=torch.float64))
    assert torch.equal(found.features, pooled.features)


def test_a_second_round_by_hand() -> None:
    # Track 4 covers both objects alike and was taken for 1 and 6 alike; track 9 is of object 1
    # alone. After a round object 0 is (1/2, 1/2) and object 1 (1/4, 3/4).
    pooled = objects([[4, 0], [4, 4]], [4, 9])
    found = categories_after(2, pooled, {4: {1: 1.0, 6: 1.0}, 9: {6: 5.0}})
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
    once = categories_after(1, pooled, taken).votes
    found = with_categories(pooled, taken).votes
    assert once.argmax(dim=1).tolist() == [0, 0]
    assert found.argmax(dim=1).tolist() == [0, 1]
    many = categories_after(200, pooled, taken).votes
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
        votes = categories_after(rounds, pooled, taken).votes
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


def labels(ids, **more) -> Labels:
    return Labels(ids=torch.tensor(ids), confidence=torch.ones(len(ids)), **more)


def voted() -> Labels:
    return labels(
        [4, 9, 4, 9, -1],
        candidates=torch.tensor([[4, 9], [9, -1], [4, 2], [9, 4], [-1, -1]]),
        shares=torch.tensor([[0.75, 0.25], [1.0, 0.0], [0.5, 0.5], [0.6, 0.4], [0.0, 0.0]]),
        evidence=torch.tensor([4.0, 2.0, 10.0, 5.0, 0.0]),
    )


def test_by_hand_of_pooling() -> None:
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
