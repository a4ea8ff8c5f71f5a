"""Numbers of JSON files are finite, bounded and of the type that is meant."""

import json

import numpy as np
import pytest

from splatseg.core.json_values import MAX_INTEGER, json_integer, json_matrix, json_number
from splatseg.errors import FileFormatError


def str_of_kind(value: object) -> str:
    return type(value).__name__  # Python writes out no numbers of thousands of digits


NO_NUMBERS = [None, True, False, "3", [], {}, float("nan"), float("inf"), -float("inf"), 1e31]
HUGE = [10**400, -(10**5000), json.loads("1e999")]


@pytest.mark.parametrize("value", [*NO_NUMBERS, *HUGE], ids=str_of_kind)
def test_what_is_no_finite_number_is_refused(value) -> None:
    for read in (json_number, json_integer):
        with pytest.raises(FileFormatError, match=r"^file: x: expected a") as caught:
            read(value, where="file: x")
        assert len(str(caught.value)) < 200


def test_bounds() -> None:
    assert json_number(2, where="x", low=2, high=3) == 2.0
    assert json_integer(3, where="x", low=2, high=3) == 3
    assert json_integer(MAX_INTEGER, where="x") == MAX_INTEGER
    for value in (1.9, 3.5):
        with pytest.raises(FileFormatError, match=r"in \[2, 3\]"):
            json_number(value, where="x", low=2, high=3)
    for value in (1, 4, 2.5, MAX_INTEGER + 1, -1, 1e25):
        with pytest.raises(FileFormatError, match="whole number"):
            json_integer(value, where="x", low=2, high=3)
    with pytest.raises(FileFormatError, match="of at least 0"):
        json_integer(-1, where="x")


def test_whole_numbers_may_be_written_as_reals() -> None:
    assert json_integer(4.0, where="x") == 4


@pytest.mark.parametrize(
    "value",
    [
        None,
        [],
        [[1, 2]],
        [[1, 2], [3]],
        [[1, 2], [3, "4"]],
        [[1, 2], [3, float("nan")]],
        [[1, 2], [3, 10**400]],
        [[1, [2]], [3, 4]],
        [[[1]]] * 2,
        {"0": [1, 2]},
    ],
)
def test_what_is_no_matrix_is_refused(value) -> None:
    with pytest.raises(FileFormatError, match=r"^m: "):
        json_matrix(value, where="m", shapes=((2, 2),))


def test_a_matrix_of_either_shape() -> None:
    for rows in ([[1, 2.5], [3, 4]], [[1, 2.5]]):
        np.testing.assert_array_equal(json_matrix(rows, where="m", shapes=((2, 2), (1, 2))), rows)
