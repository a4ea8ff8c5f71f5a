"""Checks at the public boundary: one sentence each, naming the argument."""

import math
from collections.abc import Iterable, Sequence, Sized

import torch
from torch import Tensor

from splatseg.errors import InputError, RangeError, ShapeError


def check_shape(name: str, tensor: Tensor, shape: Sequence[int | None]) -> None:
    """Raise `ShapeError` unless `tensor` has this shape; None stands for any length."""
    actual = tuple(tensor.shape)
    if len(actual) == len(shape) and all(
        want is None or want == got for want, got in zip(shape, actual, strict=True)
    ):
        return
    expected = ", ".join("any" if want is None else str(want) for want in shape)
    raise ShapeError(f"{name}: expected shape ({expected}), got {actual}.")


def check_rows(name: str, rows: Sized, count: int) -> None:
    """Raise `ShapeError` unless there is one row a Gaussian."""
    if len(rows) != count:
        raise ShapeError(f"{name}: expected {count} rows, one a Gaussian, got {len(rows)}.")


def check_finite(name: str, tensor: Tensor) -> None:
    """Raise `RangeError` if any value is NaN or infinite, naming the first."""
    # A sum is finite only if all its terms are, and is the cheaper to ask for.
    if tensor.is_floating_point() and math.isfinite(float(tensor.detach().sum())):
        return
    finite = torch.isfinite(tensor)
    if bool(finite.all()):
        return
    bad = torch.nonzero(~finite)
    first = tuple(int(i) for i in bad[0])
    raise RangeError(
        f"{name}: {len(bad)} of {tensor.numel()} values are not finite; "
        f"the first is {float(tensor[first])} at {first}."
    )


def check_range(name: str, value: float, low: float, high: float) -> None:
    """Raise `RangeError` unless low <= value <= high (NaN never is)."""
    if not low <= value <= high:
        raise RangeError(f"{name}: expected a value in [{low:g}, {high:g}], got {value:g}.")


def check_values(name: str, tensor: Tensor, low: float, high: float) -> None:
    """Raise `RangeError` unless every value is finite and in [low, high]."""
    check_finite(name, tensor)
    outside = (tensor < low) | (tensor > high)
    if not bool(outside.any()):
        return
    bad = torch.nonzero(outside)
    first = tuple(int(i) for i in bad[0])
    raise RangeError(
        f"{name}: expected values in [{low:g}, {high:g}], got {float(tensor[first]):g} "
        f"at {first} ({len(bad)} of {tensor.numel()} are outside)."
    )


def check_choice(name: str, value: str, choices: Iterable[str]) -> None:
    """Raise `InputError` unless `value` is one of `choices`."""
    known = list(choices)
    if value not in known:
        raise InputError(f"{name}: expected one of {', '.join(known)}, got {value!r}.")
