"""Objects get the class of their votes and of what they look like."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from splatseg.errors import RangeError, ShapeError
from splatseg.lift.object_classes import ObjectClassOptions, PooledObjects, classify_objects

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
        {"vote_exponent": 4.0},
        {"feature_exponent": 0.6},
        {"vote_floor": 0.2},
        {"feature_components": 2},
        {"shrinkage": 0.6},
        {"full_votes": 300.0},
        {"rounds": 1},
    ],
)
def test_as_the_equations_say(change) -> None:
    """Against loops; each option makes a difference."""
    objects, usual = random_objects(), ObjectClassOptions(rounds=3, feature_exponent=0.3)
    options = replace(usual, **change)
    found = classify_objects(objects, options=options)
    expected = classified(
        objects.votes.numpy(), objects.features.numpy(), options, known=objects.known.numpy()
    )
    np.testing.assert_allclose(found.numpy(), expected, rtol=0, atol=1e-9)
    if change:
        assert not torch.allclose(found, classify_objects(objects, options=usual), atol=1e-6)


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
    by_votes = ObjectClassOptions(feature_exponent=0)
    alone = classify_objects(pooled(votes, features), options=by_votes)
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
    alone = classify_objects(
        pooled(votes, np.ones((24, 4))), options=ObjectClassOptions(feature_exponent=0)
    )
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


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vote_exponent": -1.0}, "vote_exponent: expected 0 or more"),
        ({"feature_exponent": float("nan")}, "feature_exponent: expected 0 or more"),
        ({"full_votes": -1.0}, "full_votes: expected 0 or more"),
        ({"vote_floor": 0.0}, "vote_floor: expected above 0"),
        ({"shrinkage": 1.5}, "shrinkage"),
        ({"feature_components": 0}, "feature_components: expected at least 1"),
        ({"rounds": 0}, "rounds: expected at least 1"),
        ({"category_rounds": 0}, "category_rounds: expected at least 1"),
    ],
)
def test_options_out_of_range_are_refused(change, message) -> None:
    with pytest.raises(RangeError, match=message):
        ObjectClassOptions(**change)


def test_rows_must_be_of_the_same_objects() -> None:
    with pytest.raises(ShapeError, match="expected 2 rows of 2 votes"):
        replace(pooled(np.ones((2, 2)), np.ones((2, 3))), features=torch.ones(3, 3).double())
