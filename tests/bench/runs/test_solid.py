"""Scores on Gaussians and points, by hand and against the independent scorer."""

import math

import pytest
import torch

from splatseg.core import Gaussians
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.evaluate.metrics import Confusion
from splatseg_bench.measures import gaussian_score, gaussian_weights, labels_from_points


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
