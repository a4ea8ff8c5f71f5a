"""How far evidence agrees with itself, by hand."""

import pytest
import torch

from splatseg.core import Camera, Gaussians, Labels, View
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.evaluate.agreement import Rivals, agreement, contested, rivals, views_that_show


def soft(candidates, shares) -> Labels:
    candidates, shares = torch.tensor(candidates), torch.tensor(shares)
    return Labels(
        ids=candidates[:, 0], confidence=shares[:, 0], candidates=candidates, shares=shares
    )


def test_contested_and_rivals_by_hand() -> None:
    labels = soft(
        [[1, 2], [1, 2], [2, 1], [3, -1], [-1, -1], [4, 1]],
        [[0.6, 0.3], [0.5, 0.5], [0.6, 0.4], [1.0, 0.0], [0.0, 0.0], [0.9, 0.1]],
    )
    assert contested(labels, ratio=0.5).tolist() == [True, True, True, False, False, False]
    assert contested(labels, ratio=1.0).tolist() == [False, True, False, False, False, False]
    # Even at a ratio of zero, who has no second candidate is not contested.
    assert contested(labels, ratio=0.0).tolist() == [True, True, True, False, False, True]
    assert rivals(labels, ratio=0.5) == (
        Rivals(winner=1, second=2, count=2),
        Rivals(winner=2, second=1, count=1),
    )
    assert len(rivals(labels, ratio=0.5, max_pairs=1)) == 1
    assert rivals(labels[3:5], ratio=0.5) == ()


def test_a_second_share_without_an_id_is_nobody() -> None:
    assert not contested(soft([[3, -1]], [[0.5, 0.5]]), ratio=0.5).any()


def test_layers_without_a_second_candidate_are_refused() -> None:
    hard = Labels(ids=torch.tensor([1]), confidence=torch.ones(1))
    with pytest.raises(InputError, match="with candidates"):
        contested(hard, ratio=0.5)
    with pytest.raises(InputError, match="2 candidates"):
        contested(soft([[1]], [[1.0]]), ratio=0.5)
    with pytest.raises(RangeError, match="ratio"):
        contested(soft([[1, 2]], [[0.5, 0.5]]), ratio=1.5)


def test_agreement_by_hand() -> None:
    drawn = torch.tensor([[1, 1, 1, 2, 2, -1, 3, 3]])
    evidence = torch.tensor([[1, 1, 5, 5, 5, 5, -1, 3]])
    same = agreement(drawn, evidence, same_ids=True)
    assert (same.pixels, same.differ) == (6, pytest.approx(3 / 6))
    # Segment 5 lies on 1 once and on 2 twice: it stands for 2, and one pixel differs.
    own = agreement(drawn, evidence, same_ids=False)
    assert (own.pixels, own.differ) == (6, pytest.approx(1 / 6))
    none = agreement(drawn, torch.full_like(drawn, -1), same_ids=True)
    assert (none.pixels, none.differ) == (0, 0)
    with pytest.raises(ShapeError, match="predicted"):
        agreement(drawn, evidence[:, 1:], same_ids=True)


def test_views_that_show_a_gaussian() -> None:
    """One in front of both cameras, one in front of the first only, one hidden behind."""
    scene = Gaussians(
        means=torch.tensor([[0.0, 0, 2], [0.8, 0, 2], [0, 0, 3]]),
        rotations=torch.tensor([[1.0, 0, 0, 0]]).repeat(3, 1),
        scales=torch.tensor([[0.3] * 3, [0.1] * 3, [0.02] * 3]),
        opacities=torch.tensor([1.0, 1.0, 1.0]),
        sh=torch.zeros(3, 1, 3),
    )
    views = []
    for name, x in (("a", 0.0), ("b", 4.0)):
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3] = x
        camera = Camera(width=64, height=48, fx=40, fy=40, cx=32, cy=24, cam_from_world=pose)
        views.append(View(name=name, camera=camera))
    done = []
    counts = views_that_show(scene, views, backend="cpu", progress=lambda i, n: done.append((i, n)))
    assert counts.tolist() == [1, 1, 0]
    assert done == [(1, 2), (2, 2)]
    half = views[0].camera
    views[1] = View(name="b", camera=half)
    assert views_that_show(scene, views, backend="cpu").tolist() == [2, 2, 0]
    # The first covers some 200 pixels, and 4 where the image is a tenth as wide.
    assert views_that_show(scene, views, min_weight=50, backend="cpu").tolist() == [2, 0, 0]
    small = views_that_show(scene, views, min_weight=50, longest=6, backend="cpu")
    assert small.tolist() == [0, 0, 0]
    assert views_that_show(scene, views, min_weight=1e5, backend="cpu").tolist() == [0, 0, 0]
    assert views_that_show(scene, [], backend="cpu").tolist() == [0, 0, 0]
