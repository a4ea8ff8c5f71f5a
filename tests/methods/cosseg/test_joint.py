"""Gaussians and decoder trained together, on the wall of two halves."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import LabelMap
from splatseg.errors import InputError
from splatseg.methods._trained import linear_start, logit_loss, probability_loss
from splatseg.methods.cosseg.decoder import FusionShape, decode_all
from splatseg.methods.cosseg.features import distilled_features
from splatseg.methods.cosseg.joint import LabelLoss, train_jointly
from splatseg.methods.cosseg.points import PointSource
from splatseg.render import render

from .conftest import Maps

DRAWN_BY = "auto"  # training is the same on all; what renders is tested in lift
IDS = torch.tensor([3, 8])


@pytest.fixture(scope="module")
def photographed(halves, tmp_path_factory):
    """The views, each with a photograph of the wall a little brighter than it is."""
    folder = tmp_path_factory.mktemp("photographs")
    found = []
    for view in halves.views:
        image = render(halves.gaussians, view.camera, backend=DRAWN_BY).image.clamp(0, 1)
        pixels = (image.numpy() * 0.8 + 0.15) * 255
        path = folder / f"{view.name}.png"
        Image.fromarray(pixels.astype(np.uint8)).save(path)
        found.append(replace(view, image=path))
    return found


def label_loss(halves, evidence=None, **changes) -> LabelLoss:
    distilled = distilled_features(halves.gaussians, halves.views, halves.blocks, backend=DRAWN_BY)
    source = PointSource(
        gaussians=halves.gaussians, scales=distilled.scales, spatial="none", up=None, seed=0,
    )  # fmt: skip
    raw = source.raw(torch.arange(len(halves.gaussians)))
    points = raw.scaled(raw.scalings(), len(halves.gaussians))
    rng = np.random.default_rng(1)
    shape = FusionShape(inputs=points.inputs.widths, decoded=(6,), head=(4,))
    weight, bias = linear_start(4, 2, rng)
    weights = shape.start(rng) | {"classifier.weight": weight, "classifier.bias": bias}
    given = {
        "ids": IDS, "rate": 0.02, "dropout": 0.0, "backend": DRAWN_BY,
        "rng": np.random.default_rng(2),
    } | changes  # fmt: skip
    return LabelLoss(points, weights, evidence or halves.evidence, **given)


@pytest.mark.parametrize("classes", [2, 5])
def test_a_loss_of_even_odds_is_one(classes: int) -> None:
    label, sure = torch.tensor([0, 1]), torch.ones(2)
    assert float(logit_loss(torch.zeros(2, classes), label, sure)) == pytest.approx(1)
    alpha = torch.tensor([0.9, 0.3])
    assert float(probability_loss(alpha / classes, alpha, sure, classes)) == pytest.approx(1)
    half = torch.tensor([1.0, 0.0])  # confidence weighs, and does not normalise
    assert float(probability_loss(alpha / classes, alpha, half, classes)) == pytest.approx(0.5)
    assert float(probability_loss(alpha, alpha, sure, 1)) == 0


def test_the_loss_by_hand(halves) -> None:
    loss = label_loss(halves)
    view, rows = halves.views[1], torch.arange(len(halves.gaussians))
    found = loss(view, halves.gaussians, rows).detach()
    # In the first step running statistics are those of the view, but for n / (n - 1) of variances.
    decoded = decode_all(loss._points.inputs, loss.weights)
    image = render(halves.gaussians, view.camera, decoded, backend=DRAWN_BY, warp="nearest").image
    shown = image.reshape(-1, 4)
    weights = loss.weights
    logits = (shown @ weights["classifier.weight"].T + weights["classifier.bias"]).detach()
    label = (halves.ids(view).reshape(-1) == 8).long()
    each = -torch.log_softmax(logits, dim=1)[torch.arange(len(label)), label]
    assert float(found) == pytest.approx(0.1 * float(each.mean()) / math.log(2), rel=1e-3)
    assert loss.losses == [pytest.approx(float(found) / 0.1)]


def test_drop_out_is_drawn(halves) -> None:
    view, rows = halves.views[0], torch.arange(len(halves.gaussians))

    def first(seed: int, **changes) -> float:
        loss = label_loss(halves, rng=np.random.default_rng(seed), **changes)
        return float(loss(view, halves.gaussians, rows).detach())

    assert first(2, dropout=0.5) == first(2, dropout=0.5)
    assert len({first(2), first(2, dropout=0.5), first(3, dropout=0.5)}) == 3


def test_pixels_without_a_label_say_nothing(halves) -> None:
    view, rows = halves.views[0], torch.arange(len(halves.gaussians))
    nothing = Maps({view.name: LabelMap(ids=torch.full((24, 32), -1, dtype=torch.int32))})
    assert float(label_loss(halves, nothing)(view, halves.gaussians, rows)) == 0.0
    half = halves.ids(view).clone()
    half[:12] = -1
    some = label_loss(halves, Maps({view.name: LabelMap(ids=half)}))
    whole = label_loss(halves)
    first, second = (one(view, halves.gaussians, rows).detach() for one in (some, whole))
    assert float(first) != float(second)


def trained(halves, photographed, *, steps=24):
    loss = label_loss(halves)
    return loss, train_jointly(
        halves.gaussians, photographed, loss, steps=steps, backend=DRAWN_BY, seed=0
    )


def test_both_are_learnt(halves, photographed) -> None:
    told: list[tuple[int, int]] = []
    loss = label_loss(halves)
    found = train_jointly(
        halves.gaussians, photographed, loss, steps=60,
        backend=DRAWN_BY, seed=0, progress=lambda *step: told.append(step),
    )  # fmt: skip
    assert told[-1] == (60, 60)
    assert np.mean(loss.losses[-8:]) < 0.5 * np.mean(loss.losses[:8])
    assert len(found) == len(halves.gaussians)
    assert not torch.equal(found.sh, halves.gaussians.sh)
    with Image.open(photographed[0].image) as photograph:
        wanted = torch.from_numpy(np.array(photograph)).float() / 255
    before, after = (
        float((render(g, photographed[0].camera, backend=DRAWN_BY).image - wanted).abs().mean())
        for g in (halves.gaussians, found)
    )
    assert after < 0.8 * before


@pytest.mark.parametrize(
    ("name", "value"), [("RGB_WEIGHT", 0.8), ("LABEL_WEIGHT", 0.0), ("PROGRESS", 0.1)]
)
def test_each_constant_counts(halves, photographed, monkeypatch, name, value) -> None:
    _, usual = trained(halves, photographed)
    monkeypatch.setattr(f"splatseg.methods.cosseg.joint.{name}", value)
    _, changed = trained(halves, photographed)
    assert not torch.equal(usual.means, changed.means)


@pytest.mark.bits
def test_bits_repeat(halves, photographed) -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        first, one = trained(halves, photographed)
        torch.set_num_threads(2)
        second, two = trained(halves, photographed)
    finally:
        torch.set_num_threads(before)
    assert torch.equal(one.means, two.means)
    assert all(torch.equal(first.weights[name], second.weights[name]) for name in first.weights)


def test_what_cannot_be_is_refused(halves, photographed) -> None:
    with pytest.raises(InputError, match="photographs of all of them, 4 of 4 have none, .* v0"):
        train_jointly(
            halves.gaussians, halves.views, label_loss(halves), steps=2, backend=DRAWN_BY, seed=0
        )
