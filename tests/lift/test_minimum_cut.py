"""Minimum cuts against all labellings of small graphs."""

import itertools

import numpy as np
import pytest

from splatseg.lift.minimum_cut import minimum_cut


def cut_energy(x, unary, first, second, weights) -> float:
    return float(-(unary * x).sum() + (weights * (x[first] != x[second])).sum())


def all_labellings(count: int):
    return (np.array(bits, dtype=bool) for bits in itertools.product((False, True), repeat=count))


@pytest.mark.parametrize("scale", [1.0, 1e9, 1e-9])
@pytest.mark.parametrize("seed", range(5))
def test_no_labelling_of_a_graph_has_less_energy(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    count = 9
    pairs = np.array([p for p in itertools.combinations(range(count), 2) if rng.random() < 0.4])
    first, second = pairs.T
    unary = rng.normal(size=count) * scale
    weights = rng.uniform(0, 1, len(pairs)) * scale
    found = minimum_cut(unary, first, second, weights)
    least = min(cut_energy(x, unary, first, second, weights) for x in all_labellings(count))
    assert cut_energy(found, unary, first, second, weights) == pytest.approx(
        least, abs=1e-3 * scale
    )


def test_of_equals_the_one_with_the_fewest_in() -> None:
    """Two nodes, one gains what the other loses, and the edge costs it too: all is 0 or more."""
    none = minimum_cut(np.array([1.0, -1.0]), np.array([0]), np.array([1]), np.array([1.0]))
    assert none.tolist() == [False, False]


def test_nothing_to_gain_and_nothing_at_all() -> None:
    empty = np.zeros(0, dtype=np.int64)
    assert minimum_cut(np.zeros(0), empty, empty, np.zeros(0)).tolist() == []
    assert minimum_cut(-np.ones(3), empty, empty, np.zeros(0)).tolist() == [False] * 3
    assert minimum_cut(np.ones(2), empty, empty, np.zeros(0)).tolist() == [True, True]


def test_many_strong_nodes_do_not_overflow() -> None:
    """The sum of all capacities is far beyond 32 bits in the finest unit."""
    count = 5000
    unary = np.where(np.arange(count) % 2 == 0, 500.0, -400.0)
    first = np.arange(0, count, 2)
    found = minimum_cut(unary, first, first + 1, np.full(count // 2, 450.0))
    assert found.all()
