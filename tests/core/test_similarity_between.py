"""The similarity that brings points nearest to others (Umeyama)."""

import pytest
import torch

from splatseg.core import Similarity
from splatseg.core.rigid import best_similarity, rotation_from_quaternion, similarity_between

QUATERNION = torch.tensor([0.9, 0.1, -0.3, 0.2], dtype=torch.float64)


def random_points(count: int = 20) -> torch.Tensor:
    return torch.randn(count, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


@pytest.mark.parametrize(("scale", "with_scale"), [(2.5, True), (0.01, True), (1.0, False)])
def test_a_known_similarity_is_found(scale: float, with_scale: bool) -> None:
    true = Similarity(
        rotation=rotation_from_quaternion(QUATERNION / QUATERNION.norm()),
        translation=torch.tensor([1.0, -2.0, 5.0], dtype=torch.float64),
        scale=scale,
    )
    points = random_points()
    found = similarity_between(points, true.apply(points), with_scale=with_scale)
    assert found is not None
    assert torch.allclose(found.rotation, true.rotation, atol=1e-12)
    assert torch.allclose(found.translation, true.translation, atol=1e-12)
    assert found.scale == pytest.approx(scale, rel=1e-12)


def test_without_scale_middles_meet() -> None:
    """Twice as large: the rotation is the same, and weighted middles fall on each other."""
    points, weights = random_points(), torch.rand(20, dtype=torch.float64) + 0.1
    target = 2 * points + torch.tensor([3.0, 0.0, 0.0], dtype=torch.float64)
    found = similarity_between(points, target, weights=weights, with_scale=False)
    assert found is not None
    assert found.scale == 1
    assert torch.allclose(found.rotation, torch.eye(3, dtype=torch.float64), atol=1e-12)
    share = weights[:, None] / weights.sum()
    middle = (share * found.apply(points)).sum(dim=0)
    assert torch.allclose(middle, (share * target).sum(dim=0), atol=1e-12)


def test_points_without_weight_do_not_count() -> None:
    points = random_points()
    target = points.clone()
    target[0] += 100
    weights = torch.ones(20)
    weights[0] = 0
    found = similarity_between(points, target, weights=weights)
    assert found is not None
    assert torch.allclose(found.apply(points[1:]), target[1:], atol=1e-12)


def test_mirrored_points_are_turned_not_mirrored() -> None:
    points = random_points()
    found = similarity_between(points, points * torch.tensor([-1.0, 1.0, 1.0]))
    assert found is None or float(torch.linalg.det(found.rotation)) == pytest.approx(1)


def test_one_place_has_no_similarity() -> None:
    assert similarity_between(torch.ones(4, 3), torch.ones(4, 3)) is None


def test_many_at_once_are_as_one_by_one() -> None:
    source, target = random_points(30).view(3, 10, 3), random_points(30).flip(0).view(3, 10, 3)
    weights = torch.rand(3, 10, dtype=torch.float64)
    together = best_similarity(source, target, weights)
    for i in range(3):
        alone = best_similarity(source[i], target[i], weights[i])
        for one, other in zip(alone, together, strict=True):
            assert torch.allclose(one, other[i], atol=1e-12)
