"""Checks of values, where the fast way must not change the answer."""

import numpy as np
import pytest
import torch

from splatseg._check import check_finite
from splatseg.core.coerce import as_tensor
from splatseg.errors import RangeError

LARGEST = torch.finfo(torch.float32).max


@pytest.mark.parametrize(
    "values",
    [
        torch.full((4,), LARGEST),
        torch.tensor([65504.0, 65504.0], dtype=torch.float16),
        torch.zeros(0),
        torch.arange(5),
    ],
)
def test_finite_values_whose_sum_overflows_are_finite(values) -> None:
    check_finite("values", values)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
def test_one_value_that_is_not_finite_is_found(bad) -> None:
    values = torch.ones(3, 4)
    values[1, 2] = bad
    with pytest.raises(RangeError, match=r"values: 1 of 12 .* at \(1, 2\)"):
        check_finite("values", values)
    values[2, 3] = -bad
    with pytest.raises(RangeError, match="values: 2 of 12"):
        check_finite("values", values)


@pytest.mark.parametrize(
    ("value", "dtype"),
    [
        ([0.1, 0.2], torch.float32),
        ((0.1, np.float64(0.2)), torch.float32),
        (0.1, torch.float64),
        (np.float64(0.1), torch.float64),
        (np.array([0.1]), torch.float64),
    ],
)
def test_floats_in_lists_become_32_bits_and_others_keep_theirs(value, dtype) -> None:
    assert as_tensor("values", value, "float").dtype == dtype
