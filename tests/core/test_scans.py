"""Scans: what they refuse, and the order of their file."""

import math

import pytest
import torch

from splatseg.core import Scan
from splatseg.errors import RangeError, ShapeError

POINTS = torch.eye(3)


def test_positions_are_double_and_labels_have_32_bits() -> None:
    scan = Scan(
        name="a",
        points=POINTS,
        origin=torch.zeros(3),
        intensity=torch.ones(3, dtype=torch.float64),
        labels={"semantic": torch.tensor([1, -1, 2])},
    )
    assert scan.points.dtype == torch.float64
    assert scan.origin is not None
    assert scan.origin.dtype == torch.float64
    assert scan.intensity is not None
    assert scan.intensity.dtype == torch.float32
    assert scan.labels["semantic"].dtype == torch.int32
    assert repr(scan) == "Scan('a', 3 points, labels: semantic)"


def test_labels_go_back_into_the_order_of_the_file() -> None:
    scan = Scan(name="a", points=POINTS, rows=torch.tensor([1, 2, 4]), recorded=6)
    assert scan.recorded_labels(torch.tensor([7, 8, 9])).tolist() == [-1, 7, 8, -1, 9, -1]
    assert scan.recorded_labels(torch.tensor([7, 8, 9]), missing=0).tolist() == [0, 7, 8, 0, 9, 0]
    whole = Scan(name="a", points=POINTS)
    assert whole.recorded_labels(torch.tensor([7, 8, 9])).tolist() == [7, 8, 9]
    with pytest.raises(ShapeError, match="ids"):
        scan.recorded_labels(torch.tensor([7]))


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"points": POINTS * math.nan}, RangeError, "points: .* not finite"),
        ({"points": POINTS[:, :2]}, ShapeError, "points: expected shape"),
        ({"origin": torch.zeros(2)}, ShapeError, "origin"),
        ({"origin": torch.full((3,), math.inf)}, RangeError, "origin"),
        ({"intensity": torch.zeros(2)}, ShapeError, "intensity"),
        ({"rows": torch.zeros(2)}, ShapeError, "rows"),
        ({"labels": {"a": torch.tensor([1, 2])}}, ShapeError, r"labels\['a'\]"),
        ({"labels": {"a": torch.tensor([1, 2, -2])}}, RangeError, "ids from -1"),
    ],
)
def test_refusals(change, error, words) -> None:
    with pytest.raises(error, match=words):
        Scan(**{"name": "a", "points": POINTS, **change})
