"""Exposure: gain and bias of each view, by hand and by a fit of unequally bright photographs."""

import math
from dataclasses import replace

import pytest
import torch

from splatseg.evaluate import evaluate_photographs
from splatseg.fit import FitOptions, _views, fit
from splatseg.fit._views import Exposures
from splatseg.lift import GaussianField


@pytest.fixture(autouse=True)
def fast(monkeypatch) -> None:
    """A tenth a step, and no prior."""
    monkeypatch.setattr(_views, "_EXPOSURE_RATE", 0.1)
    monkeypatch.setattr(_views, "_EXPOSURE_PRIOR", 0.0)


def _one_step(exposures: Exposures, index: int, gradient: torch.Tensor) -> None:
    """A step along the loss <gradient, image> of an image of 0.5 with an alpha of 0.25."""
    image = torch.full((2, 3, 3), 0.5)
    rendered = exposures.applied(index, image, torch.full((2, 3), 0.25))
    rendered.backward(gradient)
    exposures.update(index, progress=0.0)


def test_nothing_is_changed_at_the_start() -> None:
    image, alpha = torch.rand(4, 5, 3), torch.rand(4, 5)
    assert torch.equal(Exposures(3).applied(1, image, alpha), image)


def test_a_step_by_hand() -> None:
    """Adam's first step is the rate times the sign; what one view gains, all give up a third."""
    exposures = Exposures(3)
    gradient = torch.zeros(2, 3, 3)
    gradient[..., 0], gradient[..., 1] = 1.0, -1.0
    _one_step(exposures, 1, gradient)
    step = 0.1
    log_gains = exposures.gains.log()
    expected = torch.tensor([[step / 3] * 3, [-2 * step / 3] * 3, [step / 3] * 3]).double()
    expected[:, 1] *= -1
    expected[:, 2] = 0
    assert torch.allclose(log_gains, expected, atol=1e-9)
    assert torch.allclose(exposures.biases, 0.1 * expected, atol=1e-9)
    image, alpha = torch.full((1, 1, 3), 0.5), torch.full((1, 1), 0.25)
    shown = exposures.applied(1, image, alpha).detach()
    red = 0.5 * math.exp(-2 * step / 3) - 0.25 * 0.1 * 2 * step / 3
    assert float(shown[0, 0, 0]) == pytest.approx(red, rel=1e-6)
    assert float(shown[0, 0, 2]) == 0.5


def test_gradients_reach_picture_alpha_and_exposure() -> None:
    exposures = Exposures(2)
    _one_step(exposures, 0, torch.rand(2, 3, 3))
    gain, bias = exposures.gains[0], exposures.biases[0]
    image = torch.rand(2, 3, 3, dtype=torch.float64).requires_grad_()
    alpha = torch.rand(2, 3, dtype=torch.float64).requires_grad_()
    gradient = torch.rand(2, 3, 3, dtype=torch.float64)
    exposures.applied(0, image, alpha).backward(gradient)
    assert torch.allclose(image.grad, gradient * gain, rtol=1e-6)
    assert torch.allclose(alpha.grad, (gradient * bias).sum(dim=2))
    found = exposures._leaf.grad
    assert torch.allclose(found[:3], (gradient * image.detach()).sum((0, 1)) * gain)
    assert torch.allclose(found[3:], (gradient * alpha.detach()[..., None]).sum((0, 1)))


def test_a_single_view_has_no_exposure_of_its_own() -> None:
    exposures = Exposures(1)
    _one_step(exposures, 0, torch.ones(2, 3, 3))
    assert torch.equal(exposures.gains, torch.ones(1, 3).double())


def test_the_prior_pulls_back(monkeypatch) -> None:
    """Where the image has no gradient, the exposure decays to the identity."""
    monkeypatch.setattr(_views, "_EXPOSURE_RATE", 0.01)
    monkeypatch.setattr(_views, "_EXPOSURE_PRIOR", 1.0)
    exposures = Exposures(2)
    exposures._values = torch.tensor([[0.2] * 6, [-0.2] * 6]).double()
    for _ in range(30):
        for index in (0, 1):
            _one_step(exposures, index, torch.zeros(2, 3, 3))
    assert float(exposures.gains.log().abs().max()) < 0.05


def test_a_restored_one_goes_on_as_if_nothing_had_been(rng) -> None:
    gradients = [torch.from_numpy(rng.normal(size=(2, 3, 3))).float() for _ in range(6)]
    one, other = Exposures(3), Exposures(3)
    for i, gradient in enumerate(gradients[:3]):
        _one_step(one, i, gradient)
    other.restore({name: tensor.clone() for name, tensor in one.state().items()})
    for i, gradient in enumerate(gradients[3:]):
        _one_step(one, i, gradient)
        _one_step(other, i, gradient)
    assert torch.equal(one.gains, other.gains)
    assert torch.equal(one.biases, other.biases)


def test_unequally_bright_photographs(photograph, monkeypatch) -> None:
    """Every second photograph is half as bright again as the others; test views are in between."""
    monkeypatch.undo()
    gains = [1.25 if i % 2 else 0.8 for i in range(14)]
    capture = photograph(gains=[1.0 if i % 5 == 2 else g for i, g in enumerate(gains)])
    options = FitOptions(minutes=None, steps=700, max_gaussians=200, background="black")
    plain = fit(capture, options=options)
    freed = fit(capture, options=replace(options, exposure=True))
    scores = [
        evaluate_photographs(GaussianField(r.gaussians), capture.test_views).psnr
        for r in (plain, freed)
    ]
    assert scores[1] > scores[0] + 4.0, scores
    assert not any(note.startswith("Exposure") for note in plain.notes)
    (note,) = (note for note in freed.notes if note.startswith("Exposure"))
    least, most = (float(word) for word in note.split()[3:6:2])
    # The geometric mean of the training views' gains counts as 1.
    train = [g for i, g in enumerate(gains) if i % 5 != 2]
    mean = math.exp(sum(math.log(g) for g in train) / len(train))
    assert least == pytest.approx(0.8 / mean, abs=0.05)
    assert most == pytest.approx(1.25 / mean, abs=0.05)
