"""Labels of points, by hand and against the independent scorer."""

import math

import numpy as np
import pytest
import torch

from splatseg.core import Features, Gaussians
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.evaluate.metrics import Confusion, semantic_score
from splatseg.lift import PointLabelOptions, labels_of_points, point_labels
from splatseg.lift.label_maps import ClassifierHead
from splatseg.lift.point_labels import classified_points


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


def test_points_equal_the_scorers(rng, score, tmp_path) -> None:
    scene = gaussians_at(rng.normal(size=(60, 3)).tolist(), scales=0.3)
    ids = torch.from_numpy(rng.integers(-1, 5, 60))
    points = torch.from_numpy(rng.normal(size=(300, 3)))
    given = labels_of_points(scene, torch.where(ids == 0, -1, ids), points).ids
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


def at(scene, ids, points, **options) -> list[int]:
    found = labels_of_points(scene, torch.tensor(ids), points, options=PointLabelOptions(**options))
    return found.ids.tolist()


def test_density_decides_where_the_centre_would_not(monkeypatch) -> None:
    """A long Gaussian covers the point; a small one, whose centre is nearer, does not."""
    turn = torch.tensor([[1.0, 0, 0, 0], [math.sqrt(0.5), 0, 0, math.sqrt(0.5)]])
    # The second is long along its x, which the quarter turn about z lays along the world's y.
    scene = gaussians_at(
        [[0.3, 0, 0], [0, 1, 0]], scales=[[0.05, 0.05, 0.05], [2, 0.1, 0.1]], rotations=turn
    )
    ids, point = [3, 8], torch.tensor([[0.0, 0, 0]])
    assert at(scene, ids, point, rule="nearest") == [3]
    assert at(scene, ids, point) == [8]
    monkeypatch.setattr("splatseg.lift.point_labels.NEIGHBOURS", 1)
    assert at(scene, ids, point) == [3]


def test_votes_add_up_and_ties_are_settled() -> None:
    scene = gaussians_at([[0, 0, 0]] * 3, opacities=[0.5, 0.3, 0.3])
    point = torch.zeros(1, 3)
    assert at(scene, [1, 2, 2], point) == [2]
    assert at(scene, [1, -1, -1], point) == [-1]
    pair = scene[1:]
    assert at(pair, [9, 4], point) == [4]
    assert at(pair, [-1, 4], point) == [4]
    # Nothing reaches a point this far: the nearest centre decides.
    far = torch.tensor([[1e4, 0.0, 0.0]])
    assert at(gaussians_at([[0, 0, 0], [9, 0, 0]]), [1, 2], far) == [2]


def test_confidence_is_the_share_of_the_density() -> None:
    scene = gaussians_at([[0, 0, 0]] * 3, opacities=[0.5, 0.3, 0.3])
    points = torch.tensor([[0.0, 0, 0], [1e4, 0, 0]])
    found = labels_of_points(scene, torch.tensor([1, 2, 2]), points)
    assert found.confidence.tolist() == pytest.approx([0.6 / 1.1, 0.0])
    nearest = PointLabelOptions(rule="nearest")
    found = labels_of_points(scene, torch.tensor([1, 2, 2]), points, options=nearest)
    assert found.confidence.tolist() == [1, 1]
    # The offset along x is two standard deviations: the density is that of the formula.
    pair = gaussians_at([[0, 0, 0], [0.2, 0, 0]], opacities=[0.9, 0.8])
    found = labels_of_points(pair, torch.tensor([5, 6]), points[:1])
    far = 0.8 * math.exp(-2)
    assert found.confidence.tolist() == pytest.approx([0.9 / (0.9 + far)], abs=1e-6)


def test_faint_gaussians_are_not_there() -> None:
    scene = gaussians_at([[0, 0, 0], [1, 0, 0]], opacities=[0.05, 0.9])
    point = torch.zeros(1, 3)
    for rule in ("nearest", "weighted"):
        assert at(scene, [1, 2], point, rule=rule) == [2]
    assert at(scene, [1, 2], point, rule="nearest", min_opacity=0) == [1]
    with pytest.raises(InputError, match=r"opacity of 0\.95"):
        at(scene, [1, 2], point, min_opacity=0.95)


def test_blocks_of_points_are_one_answer(rng, monkeypatch) -> None:
    scene = gaussians_at(rng.normal(size=(20, 3)).tolist(), scales=0.5)
    ids = torch.from_numpy(rng.integers(-1, 4, 20))
    points = torch.from_numpy(rng.normal(size=(50, 3)))
    whole = labels_of_points(scene, ids, points)
    monkeypatch.setattr(point_labels, "_POINTS", 7)
    parts = labels_of_points(scene, ids, points)
    assert torch.equal(whole.ids, parts.ids)
    assert torch.equal(whole.confidence, parts.confidence)
    assert labels_of_points(scene, ids, points[:0]).ids.tolist() == []


# Two Gaussians at one point, with densities 0.6 and 0.2 there: shares of 3/4 and 1/4.
PAIR = gaussians_at([[0, 0, 0]] * 2, opacities=[0.6, 0.2])
LOGITS = torch.tensor([[0.0, 1.0], [8.0, 0.0]])
HERE = torch.zeros(1, 3)


def head(blend: str, *, bias=None) -> ClassifierHead:
    return ClassifierHead(ids=torch.tensor([4, 9]), weight=None, bias=bias, blend=blend)


def test_classified_points_by_hand() -> None:
    """One sure Gaussian outvotes in the mean of logits, and not in that of probabilities."""
    features = Features(values=LOGITS)
    logits = classified_points(PAIR, features, head("features"), HERE)
    mean = 0.75 * LOGITS[0] + 0.25 * LOGITS[1]
    assert logits.ids.tolist() == [4]
    assert logits.confidence.item() == pytest.approx(mean.softmax(0)[0].item(), abs=1e-6)
    probable = classified_points(PAIR, features, head("probabilities"), HERE)
    mean = 0.75 * LOGITS[0].softmax(0) + 0.25 * LOGITS[1].softmax(0)
    assert probable.ids.tolist() == [9]
    assert probable.confidence.item() == pytest.approx(mean[1].item(), abs=1e-6)
    bias = torch.tensor([0.0, 3.0])
    biased = classified_points(PAIR, features, head("features", bias=bias), HERE)
    assert biased.ids.tolist() == [9]


def test_classified_points_without_weight_or_density() -> None:
    # The first Gaussian was never seen: its three quarters stand for no label.
    unseen = Features(values=LOGITS, weights=torch.tensor([0.0, 1.0]))
    found = classified_points(PAIR, unseen, head("probabilities"), HERE)
    assert found.ids.tolist() == [-1]
    assert found.confidence.item() == pytest.approx(0.75, abs=1e-6)
    # Where no density reaches, the nearest centre counts alone.
    apart = gaussians_at([[0, 0, 0], [9, 0, 0]])
    far = torch.tensor([[1e4, 0.0, 0]])
    for blend in ("features", "probabilities"):
        found = classified_points(apart, Features(values=LOGITS), head(blend), far)
        assert found.ids.tolist() == [4]
        assert found.confidence.item() == pytest.approx(LOGITS[1].softmax(0)[0].item(), abs=1e-6)


def test_rows_are_those_of_all_gaussians() -> None:
    """A faint Gaussian in front of the others in the file shifts no row."""
    scene = gaussians_at([[0, 0, 0], [0, 0, 0]], opacities=[0.05, 0.9])
    sure = Features(values=torch.tensor([[9.0, 0], [0, 9.0]]))
    assert classified_points(scene, sure, head("probabilities"), HERE).ids.tolist() == [9]
    assert at(scene, [1, 2], HERE) == [2]


def test_bad_points_are_refused() -> None:
    scene, ids = gaussians_at([[0, 0, 0]]), torch.tensor([1])
    for words, error in (
        ({"points": torch.full((1, 3), math.nan)}, RangeError),
        ({"points": torch.zeros(1, 2)}, ShapeError),
        ({"ids": torch.tensor([1, 2])}, ShapeError),
    ):
        given = {"ids": ids, "points": torch.zeros(1, 3), **words}
        with pytest.raises(error):
            labels_of_points(scene, given["ids"], given["points"])
    for options, error in (
        ({"min_opacity": 2}, RangeError),
        ({"rule": "best"}, InputError),
    ):
        with pytest.raises(error):
            PointLabelOptions(**options)
    two = Features(values=torch.zeros(2, 2))
    with pytest.raises(ShapeError, match="features: expected 1 rows"):
        classified_points(scene, two, head("features"), HERE)
    with pytest.raises(ShapeError, match="points"):
        classified_points(PAIR, two, head("features"), torch.zeros(1, 2))


def test_points_that_no_gaussian_reaches_may_stay_without_a_label() -> None:
    scene = gaussians_at([[0, 0, 0], [1, 0, 0]], scales=0.1)
    # Two and four standard deviations from the first, and far from both.
    points = torch.tensor([[-0.2, 0.0, 0], [-0.4, 0.0, 0], [0.0, 50, 0]])
    ids = [1, 2]
    assert at(scene, ids, points) == [1, 1, 1]
    assert at(scene, ids, points, max_mahalanobis=3.0) == [1, -1, -1]
    assert at(scene, ids, points, max_mahalanobis=5.0) == [1, 1, -1]
    given = PointLabelOptions(max_mahalanobis=3.0)
    found = classified_points(
        scene, Features(values=LOGITS), head("features"), points, options=given
    )
    assert found.ids.tolist()[1:] == [-1, -1]
    with pytest.raises(RangeError, match="max_mahalanobis: expected more than 0"):
        PointLabelOptions(max_mahalanobis=0.0)
