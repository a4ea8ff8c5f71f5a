"""The head of affinity features: gates, scales, what it refuses, and its JSON."""

import math
from dataclasses import replace

import pytest
import torch

from splatseg.core import Features, LayerInfo
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.lift.affinity import AffinityHead, project_features, projector_start
from splatseg.lift.label_maps import ClassifierHead, has_classifier


def head(**changes) -> AffinityHead:
    values = {
        "channels": 2,
        "unit": True,
        "gate_weight": torch.tensor([0.0, -40.0]),
        "gate_bias": torch.tensor([40.0, 20.0]),
        "scale_quantiles": torch.linspace(1.0, 3.0, 101, dtype=torch.float64),
        "levels": (0.9, 0.5, 0.2),
    }
    return AffinityHead(**values | changes)


def layer(json) -> Features:
    return Features(values=torch.zeros(3, 2), weights=None, info=LayerInfo(head=json))


def test_the_gate_closes_channels_by_scale() -> None:
    """The second channel counts below the scale 0.5 and not above."""
    one, other = torch.tensor([1.0, 0.0]), torch.tensor([1.0, 3.0])
    found = [
        float(head().directions(one, scale) @ head().directions(other, scale))
        for scale in (0.0, 1.0)
    ]
    assert found == pytest.approx([1 / math.sqrt(10), 1.0], abs=1e-4)
    plain = head(gate_weight=None, gate_bias=None)
    assert not plain.gated
    assert plain.gate(0.3).tolist() == [1, 1]
    assert head().directions(torch.zeros(2), 0.0).tolist() == [0, 0]


def test_scales_of_granularities() -> None:
    assert [head().scale(g) for g in (0.0, 0.25, 0.5, 1.0)] == pytest.approx([0.9, 0.7, 0.5, 0.2])
    for call in (lambda: head().scale(1.5), lambda: head().gate(-0.1)):
        with pytest.raises(RangeError, match="expected"):
            call()


def test_the_projector_is_equation_4(rng) -> None:
    """Against the layers of torch.nn."""
    arrays = projector_start(6, 2, rng)
    generator = torch.Generator().manual_seed(0)
    arrays = {name: torch.randn(value.shape, generator=generator) for name, value in arrays.items()}
    layers = []
    for i, inputs in ((0, 6), (1, 64)):
        linear, norm = torch.nn.Linear(inputs, 64), torch.nn.LayerNorm(64)
        linear.load_state_dict({"weight": arrays[f"weight{i}"], "bias": arrays[f"bias{i}"]})
        norm.load_state_dict({"weight": arrays[f"gain{i}"], "bias": arrays[f"shift{i}"]})
        layers += [linear, norm, torch.nn.LeakyReLU()]
    last = torch.nn.Linear(64, 2)
    last.load_state_dict({"weight": arrays["weight2"], "bias": arrays["bias2"]})
    features = torch.randn(3, 4, 6, generator=generator)
    expected = torch.nn.Sequential(*layers, last)(features).detach()
    torch.testing.assert_close(project_features(arrays, features), expected)
    projecting = head(projector=arrays)
    torch.testing.assert_close(projecting.project(features), expected)
    with pytest.raises(ShapeError, match="expected 6 channels, got 5"):
        projecting.project(torch.zeros(1, 5))
    start = projector_start(6, 2, rng)
    assert float(start["weight0"].abs().max()) <= 1 / math.sqrt(6)
    assert start["gain1"].tolist() == [1] * 64
    assert start["shift1"].tolist() == [0] * 64


def test_the_head_goes_through_json(rng) -> None:
    made = head(projector=projector_start(3, 2, rng))
    found = AffinityHead.of(layer(made.to_json()))
    assert found.to_json() == made.to_json()
    assert torch.equal(found.gate(0.4), made.gate(0.4))
    bare = head(gate_weight=None, gate_bias=None, scale_quantiles=None)
    assert AffinityHead.of(layer(bare.to_json())).to_json() == bare.to_json()


def test_heads_of_other_kinds_are_refused() -> None:
    affinity = layer(head().to_json())
    assert not has_classifier(affinity)
    with pytest.raises(InputError, match="expected a layer with a classifier head"):
        ClassifierHead.of(affinity)
    classifier = ClassifierHead(ids=torch.tensor([1, 2]), weight=None, bias=None, blend="features")
    assert has_classifier(layer(classifier.to_json()))
    for json in (None, classifier.to_json()):
        with pytest.raises(InputError, match="expected a layer of affinity features"):
            AffinityHead.of(layer(json))
    broken = dict(head().to_json())
    del broken["levels"]
    with pytest.raises(InputError, match="cannot be read"):
        AffinityHead.of(layer(broken))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"channels": 0}, RangeError, "channels: expected at least 1"),
        ({"gate_bias": None}, InputError, "expected both or none"),
        ({"gate_weight": torch.zeros(3)}, ShapeError, r"gate_bias: expected shape \(3\), got"),
        ({"scale_quantiles": torch.zeros(5, dtype=torch.float64)}, ShapeError, "scale_quantiles"),
        (
            {"scale_quantiles": torch.linspace(1, 0, 101, dtype=torch.float64)},
            RangeError,
            "expected ascending",
        ),
        ({"levels": (0.5, 2.0, 0.1)}, RangeError, "levels"),
        ({"projector": {"weight0": torch.zeros(64, 3)}}, InputError, "projector: expected"),
    ],
)
def test_what_is_no_head_is_refused(change, error, message) -> None:
    with pytest.raises(error, match=message):
        replace(head(), **change)
