"""Descriptions of sets of Gaussians: each condition against a row by row count, and as JSON."""

import json
import math

import numpy as np
import pytest
import torch

from splatseg.core import Gaussians, Labels, Selection
from splatseg.edit.document import where_from_json
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.selection import Where, select_where


@pytest.fixture
def gaussians(rng: np.random.Generator) -> Gaussians:
    def uniform(low: float, high: float, *shape: int) -> torch.Tensor:
        return torch.from_numpy(rng.uniform(low, high, shape).astype(np.float32))

    return Gaussians(
        means=uniform(-1, 1, 200, 3),
        rotations=torch.nn.functional.normalize(uniform(-1, 1, 200, 4), dim=1),
        scales=uniform(0.01, 0.3, 200, 3),
        opacities=uniform(0, 1, 200),
        sh=uniform(-1, 1, 200, 4, 3),
    )


@pytest.fixture
def layers(rng: np.random.Generator) -> dict[str, Labels | Selection]:
    ids = torch.from_numpy(rng.integers(1, 4, 200)).int()
    return {
        "objects": Labels(ids=ids, confidence=torch.ones(200)),
        "picked": Selection(mask=torch.from_numpy(rng.random(200) < 0.5)),
    }


def row_by_row(gaussians: Gaussians, fits) -> list[bool]:
    return [bool(fits(i)) for i in range(len(gaussians))]


def test_each_condition(gaussians, layers) -> None:
    g, ids = gaussians, layers["objects"].ids.tolist()
    means, colours = g.means.double().tolist(), g.colours.double().tolist()
    scales, opacities = g.scales.tolist(), g.opacities.tolist()
    conditions = {
        Where(layer="objects", ids=(1, 3)): lambda i: ids[i] in (1, 3),
        Where(layer="picked"): lambda i: bool(layers["picked"].mask[i]),
        Where(sphere=(0.2, 0, -0.1, 0.7)): lambda i: math.dist(means[i], (0.2, 0, -0.1)) <= 0.7,
        Where(opacity=(0.25, 0.5)): lambda i: 0.25 <= opacities[i] <= 0.5,
        Where(size=(0.2, math.inf)): lambda i: max(scales[i]) >= 0.2,
        Where(colour_near=(0.5, 0.4, 0.6, 0.2)): lambda i: (
            math.dist(colours[i], (0.5, 0.4, 0.6)) <= 0.2
        ),
        Where(box=(-1, -1, -1, 0, 0.5, 1)): lambda i: means[i][0] <= 0 and means[i][1] <= 0.5,
    }
    for where, fits in conditions.items():
        expected = row_by_row(g, fits)
        assert 0 < sum(expected) < 200, where
        assert select_where(g, layers, where).mask.tolist() == expected, where
        assert where_from_json(json.loads(json.dumps(where.to_json(), allow_nan=False))) == where


def test_combinations(gaussians, layers) -> None:
    """(1 or within the ball) and not faint, and all others instead; to JSON and back."""
    one, ball = Where(layer="objects", ids=(1,)), Where(sphere=(0, 0, 0, 0.5))
    solid, faint = Where(opacity=(0.5, 1)), Where(opacity=(0, 0.2), invert=True)
    found = {w: select_where(gaussians, layers, w).mask for w in (one, ball, solid, faint)}
    both = Where(any_of=(one, ball), opacity=(0.5, 1))
    expected = (found[one] | found[ball]) & found[solid]
    assert 0 < int(expected.sum()) < 200
    assert torch.equal(select_where(gaussians, layers, both).mask, expected)
    nested = Where(any_of=(Where(any_of=(both, faint)),), layer="picked", invert=True)
    expected = ~((expected | found[faint]) & layers["picked"].mask)
    assert torch.equal(select_where(gaussians, layers, nested).mask, expected)
    assert where_from_json(json.loads(json.dumps(nested.to_json()))) == nested
    some = Selection(mask=torch.arange(200) < 100)
    assert torch.equal(
        select_where(gaussians, layers, ball, among=some).mask, found[ball] & some.mask
    )


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({}, InputError, "expected a layer, a box or another condition"),
        ({"invert": True}, InputError, "expected a layer, a box or another condition"),
        ({"ids": (1,), "opacity": (0, 1)}, InputError, "a layer that the ids are of"),
        ({"sphere": (0, 0, 0, 0)}, RangeError, "sphere: expected a point and a positive distance"),
        ({"sphere": (0, math.nan, 0, 1)}, RangeError, "sphere: expected a point"),
        ({"colour_near": (0, 0, 0, -1)}, RangeError, "colour_near: expected a point"),
        ({"opacity": (0.5, 0.2)}, RangeError, "opacity: expected a least and a greatest"),
        ({"size": (math.nan, 1)}, RangeError, "size: expected a least and a greatest"),
        ({"component_at": (0, 0, math.inf)}, InputError, "component_at: expected finite"),
        (
            {"component_at": (0, 0, 0), "largest_component": True},
            InputError,
            "one of largest_component, component_at",
        ),
    ],
)
def test_bad_descriptions(options, error, message) -> None:
    with pytest.raises(error, match=message):
        Where(**options)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"sphere": [0, 0, 0]}, "sphere: expected a list of length 4, got a list of 3"),
        ({"opacity": [0, True]}, r"opacity\[1\]: expected a number, got True"),
        ({"size": "large"}, "size: expected .*, got 'large'"),
        ({"layer": "a", "invert": 1}, "invert: expected true or false, got 1"),
        ({"any_of": {"layer": "a"}}, "any_of: expected a list"),
        ({"any_of": [3]}, r"any_of\[0\]: expected an object, got 3"),
        ({"any_of": [{"colour": [0, 0, 0, 1]}]}, "got 'colour'"),
    ],
)
def test_hostile_json(content, message) -> None:
    with pytest.raises(InputError, match=message):
        where_from_json(content)


def test_layers_of_other_gaussians(gaussians) -> None:
    layers = {"few": Selection(mask=torch.ones(3).bool())}
    with pytest.raises(ShapeError, match="expected 200 rows, got 3"):
        select_where(gaussians, layers, Where(layer="few"))
