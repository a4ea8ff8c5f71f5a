"""Places and ranges of values, checked."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from splatseg.errors import RangeError, ShapeError


def box_corners(low: Sequence[float], high: Sequence[float]) -> tuple[Tensor, Tensor]:
    """Corners of a box as float64, after a check that there is something between them.

    Raises:
        ShapeError: If they are no two points.
        RangeError: If a number is not finite, or the box is empty.
    """
    lower = torch.tensor([float(v) for v in low], dtype=torch.float64)
    upper = torch.tensor([float(v) for v in high], dtype=torch.float64)
    if lower.shape != (3,) or upper.shape != (3,):
        raise ShapeError(f"box: expected two points, got {len(lower)} and {len(upper)} numbers.")
    if not bool(torch.isfinite(lower).all() and torch.isfinite(upper).all()):
        raise RangeError(f"box: expected finite numbers, got {lower.tolist()}, {upper.tolist()}.")
    if not bool((lower < upper).all()):
        raise RangeError(
            "box: expected a first corner below the second along every axis, got "
            f"{lower.tolist()} and {upper.tolist()}."
        )
    return lower, upper


def check_ball(name: str, values: Sequence[float]) -> None:
    """A point and how far from it, finite and positive.

    Raises:
        RangeError: If it is not.
    """
    if not all(math.isfinite(v) for v in values) or values[-1] <= 0:
        raise RangeError(f"{name}: expected a point and a positive distance, got {list(values)}.")


def check_interval(name: str, values: Sequence[float]) -> None:
    """A least and a greatest number, the greatest possibly infinite.

    Raises:
        RangeError: If it is not.
    """
    low, high = values
    if not (math.isfinite(low) and low <= high):
        raise RangeError(f"{name}: expected a least and a greatest number, got {low}, {high}.")
