"""Which photographs are compared, on descriptors made for it."""

import numpy as np
import pytest

from splatseg.pose._pairs import (
    all_pairs,
    connected_groups,
    likeness,
    linking_pairs,
    selected_pairs,
)


def places_on_a_ring(rng: np.random.Generator, count: int, shared: int = 60) -> list[np.ndarray]:
    """Descriptors of photographs around a ring: each shares some with the next, the last with
    the first, seen with a little noise."""
    landmarks = rng.integers(0, 256, (count, shared, 128))
    seen = []
    for i in range(count):
        both = np.concatenate([landmarks[i], landmarks[(i + 1) % count]])
        seen.append(np.clip(both + rng.integers(-4, 5, both.shape), 0, 255).astype(np.uint8))
    return seen


def test_photographs_that_share_most_look_most_alike_in_any_order(rng: np.random.Generator) -> None:
    count = 24
    ring = places_on_a_ring(rng, count)
    order = rng.permutation(count)
    alike = likeness([ring[i] for i in order], seed=0)
    assert np.allclose(np.diag(alike), 1)
    assert np.allclose(alike, alike.T, atol=1e-6)
    found = 0
    for i in range(count):
        nearest = [int(j) for j in np.argsort(-alike[i]) if j != i][:2]
        neighbours = {(order[i] + 1) % count, (order[i] - 1) % count}
        found += len(neighbours & {int(order[j]) for j in nearest})
    assert found == 2 * count


def test_likeness_depends_on_its_seed_alone(rng: np.random.Generator) -> None:
    ring = places_on_a_ring(rng, 5)
    assert np.array_equal(likeness(ring, seed=3), likeness(ring, seed=3))


def test_a_photograph_without_features_looks_like_none(rng: np.random.Generator) -> None:
    empty = np.zeros((0, 128), np.uint8)
    alike = likeness([*places_on_a_ring(rng, 4), empty], seed=0)
    assert np.isfinite(alike).all()
    assert not alike[4, :4].any()
    assert np.array_equal(likeness([empty, empty], seed=0), np.eye(2))
    # It is compared with those that follow by name, and never chosen for its looks.
    assert (0, 4) not in selected_pairs(alike, overlap=1, neighbours=4)
    assert (3, 4) in selected_pairs(alike, overlap=1, neighbours=4)


def test_every_pair_once() -> None:
    assert all_pairs(3) == [(0, 1), (0, 2), (1, 2)]
    assert len(set(all_pairs(60))) == 60 * 59 // 2


def test_a_loop_is_closed_by_looks() -> None:
    alike = np.full((10, 10), 0.1, np.float32)
    alike[0, 9] = alike[9, 0] = 0.9
    pairs = selected_pairs(alike, overlap=2, neighbours=1)
    assert (0, 9) in pairs
    assert all(i < j for i, j in pairs)
    assert {(i, j) for i, j in pairs if j - i <= 2} == {
        (i, j) for i in range(10) for j in (i + 1, i + 2) if j < 10
    }


def test_groups_are_what_chains_join() -> None:
    groups = connected_groups(6, [(4, 5), (0, 1), (1, 2)])
    assert groups[0] == groups[1] == groups[2]
    assert groups[4] == groups[5]
    assert len(set(groups)) == 3
    assert connected_groups(0, []) == []


@pytest.mark.parametrize("neighbours", [1, 2])
def test_what_is_not_joined_is_compared_with_the_rest(neighbours: int) -> None:
    alike = np.eye(5, dtype=np.float32)
    alike[3, 1] = alike[1, 3] = 0.7
    alike[3, 4] = alike[4, 3] = 0.9  # of the same group: no new pair
    alike[4, 0] = alike[0, 4] = 0.3
    pairs = linking_pairs(alike, [0, 0, 0, 3, 3], neighbours=neighbours)
    assert {(1, 3), (0, 4)} <= set(pairs)
    assert (3, 4) not in pairs
    assert all((i < 3) != (j < 3) for i, j in pairs)
    assert len(pairs) == 2 * neighbours
