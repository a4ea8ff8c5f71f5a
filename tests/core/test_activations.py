"""Scales and opacities from logs and logits: exact to half a unit, and the same everywhere."""

import math

import numpy as np
import pytest

from splatseg.core.gaussians import exponential, sigmoid

FUNCTIONS = {
    exponential: math.exp,
    sigmoid: lambda x: 1 / (1 + math.exp(-x)),
}


@pytest.mark.parametrize("function", FUNCTIONS)
def test_every_value_is_the_nearest_float(function, rng: np.random.Generator) -> None:
    values = rng.uniform(-30, 30, 2000).astype(np.float32)
    expected = [np.float32(FUNCTIONS[function](float(value))) for value in values]
    found = function(values)
    assert found.dtype == np.float32
    off = np.abs(found.view(np.int32) - np.array(expected, np.float32).view(np.int32))
    assert int(off.max()) <= 1
    assert float((off > 0).mean()) < 1e-3


@pytest.mark.parametrize("function", FUNCTIONS)
def test_a_value_alone_is_a_value_among_others(function, rng: np.random.Generator) -> None:
    """Over the border of a block, from any start, in any shape and order of memory."""
    values = rng.normal(scale=4, size=33_000).astype(np.float32)
    whole = function(values)
    for start in (1, 5, 31, 32_760):
        assert np.array_equal(function(values[start : start + 13]), whole[start : start + 13])
    assert np.array_equal(function(values[::-3]), whole[::-3])
    assert np.array_equal(function(values.reshape(-1, 3)), whole.reshape(-1, 3))
    assert np.array_equal(function(values.reshape(-1, 3).T), whole.reshape(-1, 3).T)
    assert function(values[:0]).shape == (0,)


def test_limits() -> None:
    values = np.array([-np.inf, -110.0, 20.0, np.inf, np.nan, 200.0], np.float32)
    exponentials = [0.0, 0.0, float(np.float32(math.exp(20))), np.inf, np.nan, np.inf]
    assert np.array_equal(exponential(values), np.array(exponentials, np.float32), equal_nan=True)
    assert np.array_equal(
        sigmoid(values), np.array([0, 0, 1, 1, np.nan, 1], np.float32), equal_nan=True
    )
