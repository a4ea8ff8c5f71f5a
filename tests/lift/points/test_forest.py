"""Samples of samples, and trees that tell shapes apart."""

import pytest
import torch

from splatseg.lift.points.forest import ShapeForest, ShapeSamples, drawn


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
    monkeypatch.setattr("splatseg.lift.points.forest._ROWS", 7)
    assert torch.equal(one, ShapeForest(given, trees=8, seed=4).shares(asked))
    assert not torch.equal(one, ShapeForest(given, trees=8, seed=5).shares(asked))
