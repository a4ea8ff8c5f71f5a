"""Scores on Gaussians and points, by hand and against the independent scorer."""

import math

import numpy as np
import pytest
import torch

from splatseg.core import Gaussians
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.evaluate.metrics import Confusion, semantic_score
from splatseg.evaluate.solid import (
    gaussian_score,
    gaussian_weights,
    labels_from_points,
    labels_of_points,
)


def gaussians_at(means, *, scales=0.1, opacities=0.9, rotations=None) -> Gaussians:
    means = torch.tensor(means, dtype=torch.float32)
    n = len(means)
    scales = torch.as_tensor(scales, dtype=torch.float32).expand(n, 3).clone()
    return Gaussians(
        means=means,
        rotations=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1) if rotations is None else rotations,
        scales=scales,
        opacities=torch.as_tensor(opacities, dtype=torch.float32).expand(n).clone(),
        sh=torch.zeros(n, 1, 3),
    )


def test_weights_by_hand() -> None:
    one = gaussians_at([[0, 0, 0]], scales=[[0.5, 1, 2]], opacities=0.25)
    assert gaussian_weights(one, by="count").tolist() == [1]
    assert gaussian_weights(one, by="opacity").tolist() == [0.25]
    assert gaussian_weights(one, by="volume").item() == pytest.approx(0.25 * 4 / 3 * math.pi)
    with pytest.raises(InputError, match="by"):
        gaussian_weights(one, by="mass")


def test_weighted_score_by_hand() -> None:
    truth = torch.tensor([1, 1, 2, -1])
    predicted = torch.tensor([1, 2, 2, 1])
    score = gaussian_score(predicted, truth, weights=torch.tensor([3.0, 1.0, 2.0, 100.0]))
    assert dict(score.per_class) == pytest.approx({1: 3 / 4, 2: 2 / 3})
    assert score.accuracy == pytest.approx(5 / 6)
    assert score.fwiou == pytest.approx(4 / 6 * 3 / 4 + 2 / 6 * 2 / 3)
    plain = gaussian_score(predicted, truth)
    assert dict(plain.per_class) == pytest.approx({1: 1 / 2, 2: 1 / 2})
    ones = gaussian_score(predicted, truth, weights=torch.ones(4))
    assert ones == plain
    with pytest.raises(RangeError, match="weights"):
        gaussian_score(predicted, truth, weights=torch.tensor([1.0, -1, 0, 0]))
    with pytest.raises(ShapeError, match="weights"):
        gaussian_score(predicted, truth, weights=torch.ones(3))
    with pytest.raises(InputError, match="void"):
        gaussian_score(predicted, truth, weights=torch.zeros(4))


def test_weighted_counts_add_to_plain_ones() -> None:
    ids = torch.tensor([[0, 2]])
    total = Confusion.of(ids, ids) + Confusion.of(ids, ids, torch.tensor([[0.5, 0.25]]))
    assert total.counts.diagonal().tolist() == [0, 1.5, 0, 1.25]


def test_points_equal_the_scorers(rng, score, tmp_path) -> None:
    scene = gaussians_at(rng.normal(size=(60, 3)).tolist(), scales=0.3)
    ids = torch.from_numpy(rng.integers(-1, 5, 60))
    points = torch.from_numpy(rng.normal(size=(300, 3)))
    given = labels_of_points(scene, torch.where(ids == 0, -1, ids), points)
    truth = np.where(rng.random(300) < 0.7, given.numpy(), rng.integers(0, 5, 300))
    truth = np.where(truth < 0, 0, truth)
    np.savez(tmp_path / "p.npz", semantic=given.numpy())
    np.savez(tmp_path / "t.npz", semantic=truth)
    theirs = score("points", "--pred", tmp_path / "p.npz", "--truth", tmp_path / "t.npz")
    memory = torch.from_numpy(np.where(truth == 0, -1, truth))
    ours = semantic_score(Confusion.of(given, memory))
    for key, value in (
        ("mIoU", ours.miou), ("fwIoU", ours.fwiou), ("accuracy", ours.accuracy),
        ("mAcc", ours.mean_accuracy),
    ):  # fmt: skip
        assert value == pytest.approx(theirs[key], abs=1e-12)


def test_density_decides_where_the_centre_would_not() -> None:
    """A long Gaussian covers the point; a small one, whose centre is nearer, does not."""
    turn = torch.tensor([[1.0, 0, 0, 0], [math.sqrt(0.5), 0, 0, math.sqrt(0.5)]])
    # The second is long along its x, which the quarter turn about z lays along the world's y.
    scene = gaussians_at(
        [[0.3, 0, 0], [0, 1, 0]], scales=[[0.05, 0.05, 0.05], [2, 0.1, 0.1]], rotations=turn
    )
    ids, point = torch.tensor([3, 8]), torch.tensor([[0.0, 0, 0]])
    assert labels_of_points(scene, ids, point, rule="nearest").tolist() == [3]
    assert labels_of_points(scene, ids, point).tolist() == [8]
    assert labels_of_points(scene, ids, point, neighbours=1).tolist() == [3]


def test_votes_add_up_and_ties_are_settled() -> None:
    scene = gaussians_at([[0, 0, 0]] * 3, opacities=[0.5, 0.3, 0.3])
    point = torch.zeros(1, 3)
    assert labels_of_points(scene, torch.tensor([1, 2, 2]), point).tolist() == [2]
    assert labels_of_points(scene, torch.tensor([1, -1, -1]), point).tolist() == [-1]
    pair = scene[1:]
    assert labels_of_points(pair, torch.tensor([9, 4]), point).tolist() == [4]
    assert labels_of_points(pair, torch.tensor([-1, 4]), point).tolist() == [4]
    # Nothing reaches a point this far: the nearest centre decides.
    far = torch.tensor([[1e4, 0.0, 0.0]])
    assert labels_of_points(gaussians_at([[0, 0, 0], [9, 0, 0]]), torch.tensor([1, 2]), far) == 2


def test_faint_gaussians_are_not_there() -> None:
    scene = gaussians_at([[0, 0, 0], [1, 0, 0]], opacities=[0.05, 0.9])
    ids, point = torch.tensor([1, 2]), torch.zeros(1, 3)
    for rule in ("nearest", "weighted"):
        assert labels_of_points(scene, ids, point, rule=rule).tolist() == [2]
    assert labels_of_points(scene, ids, point, rule="nearest", min_opacity=0).tolist() == [1]
    with pytest.raises(InputError, match=r"opacity of 0\.95"):
        labels_of_points(scene, ids, point, min_opacity=0.95)


def test_truth_of_gaussians_from_points() -> None:
    scene = gaussians_at([[0, 0, 0], [1, 0, 0], [5, 0, 0]])
    points = torch.tensor([[0.1, 0, 0], [0.8, 0, 0]])
    given = labels_from_points(scene, points, torch.tensor([4, 6]), reach=0.2)
    assert given.tolist() == [4, 6, -1]
    assert labels_from_points(scene, points, torch.tensor([4, 6]), reach=0.15).tolist() == [
        4, -1, -1,
    ]  # fmt: skip
    for bad, reach, error in (
        (points, 0, RangeError), (points[:0], 1, InputError), (points * math.nan, 1, RangeError),
    ):  # fmt: skip
        with pytest.raises(error):
            labels_from_points(scene, bad, torch.arange(len(bad)), reach=reach)


def test_bad_points_are_refused() -> None:
    scene, ids = gaussians_at([[0, 0, 0]]), torch.tensor([1])
    for words, error in (
        ({"points": torch.full((1, 3), math.nan)}, RangeError),
        ({"points": torch.zeros(1, 2)}, ShapeError),
        ({"ids": torch.tensor([1, 2])}, ShapeError),
        ({"neighbours": 0}, RangeError),
        ({"min_opacity": 2}, RangeError),
        ({"rule": "best"}, InputError),
    ):
        given = {"ids": ids, "points": torch.zeros(1, 3), **words}
        with pytest.raises(error):
            labels_of_points(scene, given.pop("ids"), given.pop("points"), **given)
