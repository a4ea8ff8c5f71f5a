"""Region voting, by hand and against a loop of ten lines."""

import pytest
import torch

from lift.test_point_labels import gaussians_at
from splatseg.errors import RangeError, ShapeError
from splatseg_bench import region_voting
from splatseg_bench.region_voting import region_labels

HERE = torch.zeros(1, 3)


def test_most_centres_in_the_ball_decide_whatever_their_opacity() -> None:
    scene = gaussians_at([[0, 0, 0], [0.3, 0, 0], [0, 0.3, 0], [5, 0, 0]], opacities=[0.9] * 4)
    ids = torch.tensor([1, 2, 2, 7])
    found = region_labels(scene, ids, torch.tensor([[0.0, 0, 0], [5.2, 0, 0], [9.0, 0, 0]]))
    assert found.ids.tolist() == [2, 7, -1]
    assert found.confidence.tolist() == pytest.approx([2 / 3, 1, 0])
    small = region_labels(scene, ids, HERE, radius=0.1)
    assert small.ids.tolist() == [1]


def test_weights_make_centres_count_for_what_was_seen_of_them() -> None:
    scene = gaussians_at([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]])
    ids = torch.tensor([1, 2, 2])
    weights = torch.tensor([9.0, 1.0, 1.0])
    assert region_labels(scene, ids, HERE).ids.tolist() == [2]
    assert region_labels(scene, ids, HERE, weights=weights).ids.tolist() == [1]
    assert region_labels(scene, ids, HERE, weights=0 * weights).ids.tolist() == [-1]


def test_centres_without_a_label_do_not_vote_and_ties_go_to_the_smaller_id() -> None:
    scene = gaussians_at([[0, 0, 0]] * 4)
    assert region_labels(scene, torch.tensor([-1, -1, 8, 4]), HERE).ids.tolist() == [4]
    assert region_labels(scene, torch.tensor([-1] * 4), HERE).ids.tolist() == [-1]


def test_it_is_the_loop(rng, monkeypatch) -> None:
    scene = gaussians_at(rng.normal(size=(80, 3)).tolist())
    ids = torch.from_numpy(rng.integers(-1, 4, 80))
    weights = torch.from_numpy(rng.random(80))
    points = torch.from_numpy(rng.normal(size=(60, 3)))
    expected = []
    for point in points:
        votes = dict.fromkeys(range(4), 0.0)
        for mean, id, weight in zip(scene.means.double(), ids.tolist(), weights, strict=True):
            if id >= 0 and float((mean - point).norm()) <= 0.5:
                votes[id] += float(weight)
        best = max(votes, key=lambda id: (votes[id], -id))
        expected.append(best if votes[best] > 0 else -1)
    monkeypatch.setattr(region_voting, "_POINTS", 7)
    found = region_labels(scene, ids, points, weights=weights)
    assert found.ids.tolist() == expected
    assert -1 in expected


def test_bad_input_is_refused() -> None:
    scene = gaussians_at([[0, 0, 0]])
    with pytest.raises(RangeError, match="radius: expected more than 0"):
        region_labels(scene, torch.tensor([1]), HERE, radius=0)
    with pytest.raises(ShapeError, match="ids"):
        region_labels(scene, torch.tensor([1, 2]), HERE)
    with pytest.raises(ShapeError, match="weights"):
        region_labels(scene, torch.tensor([1]), HERE, weights=torch.ones(3))
    with pytest.raises(RangeError, match="points"):
        region_labels(scene, torch.tensor([1]), torch.full((1, 3), float("nan")))
