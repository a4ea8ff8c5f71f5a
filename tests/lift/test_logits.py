"""Logits and probabilities of each Gaussian's own."""

import math

import numpy as np
import pytest
import torch

from splatseg.core import LabelMap, View
from splatseg.errors import InputError, RangeError
from splatseg.lift.heads import ClassifierHead
from splatseg.lift.training import LabelTargets, RowSampler
from splatseg.methods import _own_probability
from splatseg.methods._label_losses import LabelCounts, logit_loss, probability_loss
from splatseg.methods._own_probability import linear_own_probability, own_probability
from splatseg.methods.logits import LogitOptions, TrainingContext, train_logits
from splatseg.methods.probabilities import train_probabilities

from .conftest import BACKEND, Maps, camera_at, gaussians_at, random_gaussians, random_maps


def here() -> TrainingContext:
    return TrainingContext(backend=BACKEND)


QUICK = {"steps": 200, "batch": 150, "pixels": 100, "held_out": 0.0, "patience": 0}


def test_losses_by_hand() -> None:
    """Even logits and probabilities cost log C / log C = 1, times the mean confidence."""
    label, sure = torch.arange(7) % 5, torch.ones(7)
    half = torch.tensor([1.0, 0, 1, 0, 1, 0, 0.5])
    assert float(logit_loss(torch.zeros(7, 5), label, sure)) == pytest.approx(1.0)
    assert float(logit_loss(torch.zeros(7, 5), label, half)) == pytest.approx(0.5)
    assert float(logit_loss(torch.zeros(7, 1), label * 0, sure)) == 0.0
    alpha, even = torch.full((7,), 0.4), torch.full((7,), 0.4 / 5)
    assert float(probability_loss(even, alpha, sure, 5)) == pytest.approx(1.0)
    assert float(probability_loss(even, alpha, half, 5)) == pytest.approx(0.5)
    loss = probability_loss(torch.tensor([0.1]), torch.tensor([0.4]), torch.ones(1), 2)
    assert float(loss) == pytest.approx(math.log(4) / math.log(2))
    nothing = probability_loss(torch.zeros(1), torch.zeros(1), torch.ones(1), 2)
    assert float(nothing) == 0.0


def test_the_own_probability_is_that_of_all(rng, views) -> None:
    """Value and gradients, against softmax and the product of all classes, over many blocks."""
    gaussians, maps = random_gaussians(rng, 40), random_maps(rng, views, (3, 8, 900))
    source = LabelTargets(maps, [view.name for view in views])
    with RowSampler(gaussians, views, source, backend=BACKEND).draw(rng, batch=999) as drawn:
        batch = drawn.batch(0)
    label = batch.target("label")
    shapes = ((len(batch.weights.touched), 5), (3, 5), (3,))
    start = [torch.from_numpy(rng.normal(size=shape).astype(np.float32)) for shape in shapes]
    image = torch.from_numpy(rng.normal(size=len(batch)).astype(np.float32))

    def gradients(own) -> list[torch.Tensor]:
        leaves = [value.clone().requires_grad_() for value in start]
        result = own(*leaves)
        (result * image).sum().backward()
        return [result.detach(), *(leaf.grad for leaf in leaves)]

    def of_all(features, weight, bias) -> torch.Tensor:
        each = torch.softmax(features @ weight.T + bias, dim=1)
        return batch.weights.product(each)[torch.arange(len(batch)), label]

    expected = gradients(of_all)
    before = _own_probability._ROWS
    try:
        _own_probability._ROWS = 7
        linear = gradients(lambda *given: linear_own_probability(batch, label, *given))
    finally:
        _own_probability._ROWS = before
    logits = gradients(lambda f, w, b: own_probability(batch, label, f @ w.T + b))
    for mine, other, reference in zip(linear, logits, expected, strict=True):
        torch.testing.assert_close(mine, reference, rtol=1e-3, atol=1e-5)
        torch.testing.assert_close(other, reference, rtol=1e-3, atol=1e-5)


def test_mean_iou_by_hand() -> None:
    counts = LabelCounts(4)
    assert counts.mean_iou == 0.0
    label, answer = torch.tensor([0, 0, 0, 1, 1]), torch.tensor([0, 0, 1, 1, 2])
    counts.add(label, answer, torch.ones(5))
    # 0: 2 of 3. 1: 1 of 3. 2 is answered only and 3 neither: not counted.
    assert counts.mean_iou == pytest.approx((2 / 3 + 1 / 3) / 2)
    counts.add(torch.tensor([1]), torch.tensor([1]), torch.tensor([3.0]))
    assert counts.mean_iou == pytest.approx((2 / 3 + 4 / 6) / 2)


def wall_of(votes: dict[int, int]):
    """One wall that so many views call by an id each."""
    gaussians = gaussians_at(
        [[x, y, 2.0] for x in (-0.4, 0.0, 0.4) for y in (-0.4, 0.0, 0.4)], opacity=0.95
    )
    ids = [id for id, count in votes.items() for _ in range(count)]
    views = [View(name=f"v{i}", camera=camera_at(0.02 * i)) for i in range(len(ids))]
    maps = Maps(
        {
            view.name: LabelMap(ids=torch.full((12, 16), id))
            for view, id in zip(views, ids, strict=True)
        }
    )
    return gaussians, views, maps


@pytest.mark.parametrize("train", [train_logits, train_probabilities])
def test_contradictions_are_settled_by_majority(train) -> None:
    gaussians, views, maps = wall_of({40: 3, 7: 1})
    layer = train(gaussians, views, maps, options=LogitOptions(**QUICK), context=here())
    head = ClassifierHead.of(layer)
    assert (head.weight, head.bias, head.ids.tolist()) == (None, None, [7, 40])
    labels = head.labels(layer)
    assert labels.ids.tolist() == [40] * 9
    shown = head.label_map(gaussians, views[3].camera, layer, backend=BACKEND)
    assert int(shown.ids[6, 8]) == 40
    name = "logits" if train is train_logits else "probabilities"
    assert layer.info.method == name
    assert head.blend == ("features" if train is train_logits else "probabilities")
    if train is train_probabilities:
        assert float(labels.confidence[4]) == pytest.approx(0.75, abs=0.05)


def test_options_are_heeded(rng, views) -> None:
    gaussians, maps = random_gaussians(rng), random_maps(rng, views, (3, 8))
    base = train_logits(gaussians, views, maps, options=LogitOptions(**QUICK), context=here())
    fast = LogitOptions(**QUICK, rate=0.5)
    other = train_logits(gaussians, views, maps, options=fast, context=here())
    assert not torch.equal(base.values, other.values)
    size = 14 * 2 * 16
    tight = LogitOptions(**QUICK, max_bytes=size)
    again = train_logits(gaussians, views, maps, options=tight, context=here())
    assert torch.equal(base.values, again.values)
    with pytest.raises(InputError, match=f"at least {size} for 14 Gaussians and 2 ids"):
        train_logits(
            gaussians, views, maps, options=LogitOptions(max_bytes=size - 1), context=here()
        )
    for wrong in ({"rate": -1.0}, {"max_bytes": 0}, {"steps": 0}):
        with pytest.raises(RangeError, match=next(iter(wrong))):
            LogitOptions(**wrong)
