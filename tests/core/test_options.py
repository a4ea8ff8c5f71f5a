"""Declared ranges of options, and options that went."""

import math
import re
from typing import Annotated, Any

import pytest
from msgspec import Meta

from splatseg.core.options import (
    MAY_BE_INFINITE,
    Count,
    Natural,
    NonNegative,
    Positive,
    Share,
    options,
)
from splatseg.errors import InputError, RangeError


@options(removed={"momentum": "the rate alone is enough"})
class _Options:
    """One field of each kind."""

    share: Share = 0.5
    steps: Count = 3
    first: Natural = 0
    rate: Positive | None = None
    weight: NonNegative = 1.0
    half_open: Annotated[float, Meta(gt=0, le=1)] = 1.0
    below: Annotated[float, Meta(lt=3)] = 0.0
    reach: Annotated[float, Meta(gt=0, extra=MAY_BE_INFINITE)] = math.inf
    shares: tuple[Share, ...] = ()
    pair: tuple[float, float] = (0.0, 1.0)

    def __post_init__(self) -> None:
        if self.pair[0] > self.pair[1]:
            raise RangeError(f"pair: expected the smaller first, got {self.pair}.")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("share", 0.0),
        ("share", 1.0),
        ("steps", 1),
        ("first", 0),
        ("rate", 1e-9),
        ("rate", None),
        ("weight", 0.0),
        ("half_open", 1.0),
        ("below", 2.9),
        ("reach", math.inf),
        ("shares", (0.0, 1.0)),
    ],
)
def test_the_ends_of_a_range(name: str, value: Any) -> None:
    assert getattr(_Options(**{name: value}), name) == value


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("share", 1.1, "share: expected a value in [0, 1], got 1.1."),
        ("share", -0.1, "share: expected a value in [0, 1], got -0.1."),
        ("share", math.nan, "share: expected a value in [0, 1], got nan."),
        ("steps", 0, "steps: expected at least 1, got 0."),
        ("first", -1, "first: expected at least 0, got -1."),
        ("rate", 0.0, "rate: expected more than 0, got 0."),
        ("rate", math.inf, "rate: expected more than 0, got inf."),
        ("weight", -1.0, "weight: expected at least 0, got -1."),
        ("half_open", 0.0, "half_open: expected a value in (0, 1], got 0."),
        ("below", 3.0, "below: expected less than 3, got 3."),
        ("below", -math.inf, "below: expected less than 3, got -inf."),
        ("reach", math.nan, "reach: expected more than 0, got nan."),
        ("shares", (0.5, 2.0), "shares[1]: expected a value in [0, 1], got 2."),
        ("pair", (1.0, 0.0), "pair: expected the smaller first, got (1.0, 0.0)."),
    ],
)
def test_values_out_of_range(name: str, value: Any, message: str) -> None:
    with pytest.raises(RangeError, match=f"^{re.escape(message)}$"):
        _Options(**{name: value})


def test_values_are_converted_and_frozen() -> None:
    made = _Options(steps=2.0)  # pyright: ignore[reportArgumentType]
    assert type(made.steps) is int
    with pytest.raises(InputError, match="steps: expected a whole number"):
        _Options(steps=2.5)  # pyright: ignore[reportArgumentType]
    with pytest.raises(AttributeError):
        made.steps = 4  # pyright: ignore[reportAttributeAccessIssue]


def test_an_option_that_went_says_what_to_do() -> None:
    with pytest.raises(InputError, match=r"^momentum: this option was removed; the rate alone is"):
        _Options(momentum=0.9)  # pyright: ignore[reportCallIssue]
    with pytest.raises(TypeError, match="unknown"):
        _Options(unknown=0.9)  # pyright: ignore[reportCallIssue]
