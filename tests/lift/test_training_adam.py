"""Row-wise Adam: against torch's on each row's own steps, its twin, and threads."""

import numpy as np
import pytest
import torch

from splatseg import _native
from splatseg.errors import ShapeError
from splatseg.lift.training import AdamConstants, RowAdam, RowMoments

CONSTANTS = AdamConstants(beta1=0.85, beta2=0.97, epsilon=1e-3)


def torch_adam(start: torch.Tensor, gradients: list[torch.Tensor], rate: float) -> torch.Tensor:
    """What torch's dense Adam makes of one row and the gradients it got."""
    value = start.clone().requires_grad_()
    adam = torch.optim.Adam(
        [value], lr=rate, betas=(CONSTANTS.beta1, CONSTANTS.beta2), eps=CONSTANTS.epsilon
    )
    for gradient in gradients:
        value.grad = gradient.clone()
        adam.step()
    return value.detach()


@pytest.mark.parametrize("twin", [False, True])
@pytest.mark.parametrize("channels", [1, 3, 16, 37])
def test_each_row_is_torch_adam_on_its_own_steps(rng, twin, channels) -> None:
    start = torch.from_numpy(rng.normal(size=(9, channels)).astype(np.float32))
    value, moments = start.clone(), RowMoments.zeros(start)
    adam = RowAdam(CONSTANTS, max_steps=40)
    given: list[list[torch.Tensor]] = [[] for _ in range(9)]
    for _ in range(30):
        rows = torch.from_numpy(np.sort(rng.choice(8, rng.integers(0, 9), replace=False)))
        gradient = torch.from_numpy(rng.normal(size=(len(rows), channels)).astype(np.float32))
        step = adam.step_torch if twin else adam.step
        step(value, moments, rows=rows, gradient=gradient, rate=0.02)
        for j, row in enumerate(rows.tolist()):
            given[row].append(gradient[j])
    for row in range(9):
        expected = torch_adam(start[row], given[row], 0.02)
        torch.testing.assert_close(value[row], expected, rtol=1e-5, atol=1e-6)
    assert moments.steps.tolist() == [len(steps) for steps in given]
    assert torch.equal(value[8], start[8])  # never touched: not moved


def test_first_step_is_one_rate_however_late() -> None:
    """By hand: m / (1 - b1) = g and v / (1 - b2) = g^2, so the step is rate * g / (|g| + eps)."""
    value = torch.zeros(2, 1)
    moments = RowMoments.zeros(value)
    adam = RowAdam(CONSTANTS, max_steps=100)
    one, other = torch.tensor([0]), torch.tensor([1])
    for _ in range(50):
        adam.step(value, moments, rows=one, gradient=torch.tensor([[1.0]]), rate=0.1)
    adam.step(value, moments, rows=other, gradient=torch.tensor([[-0.5]]), rate=0.1)
    assert float(value[1]) == pytest.approx(0.1 * 0.5 / (0.5 + 1e-3), rel=1e-5)


def test_steps_beyond_the_last_take_its_corrections() -> None:
    values = []
    for max_steps in (3, 1000):
        value = torch.zeros(1, 1)
        moments = RowMoments.zeros(value)
        adam = RowAdam(AdamConstants(beta1=0.1, beta2=0.1), max_steps=max_steps)
        for _ in range(6):
            adam.step(value, moments, rows=torch.tensor([0]), gradient=torch.ones(1, 1), rate=1.0)
        values.append(float(value))
    assert values[0] == pytest.approx(values[1], rel=1e-2)


@pytest.mark.bits
def test_threads_change_nothing(rng) -> None:
    start = torch.from_numpy(rng.normal(size=(5000, 16)).astype(np.float32))
    rows = torch.from_numpy(np.sort(rng.choice(5000, 4000, replace=False)))
    gradient = torch.from_numpy(rng.normal(size=(4000, 16)).astype(np.float32))
    before, found = _native.threads(), []
    try:
        for threads in (1, 2, 5):
            _native.set_threads(threads)
            value, moments = start.clone(), RowMoments.zeros(start)
            for _ in range(3):
                RowAdam(CONSTANTS, max_steps=3).step(
                    value, moments, rows=rows, gradient=gradient, rate=0.1
                )
            found.append(value)
    finally:
        _native.set_threads(before)
    assert torch.equal(found[0], found[1])
    assert torch.equal(found[0], found[2])


def test_bad_input_is_refused() -> None:
    value = torch.zeros(3, 2)
    adam, moments = RowAdam(AdamConstants(), max_steps=1), RowMoments.zeros(value)
    with pytest.raises(ShapeError, match=r"gradient: expected shape \(2, 2\), got \(1, 2\)"):
        adam.step(value, moments, rows=torch.tensor([0, 1]), gradient=torch.zeros(1, 2), rate=0.1)
    with pytest.raises(ValueError, match="adam_rows"):
        adam.step(value, moments, rows=torch.tensor([3]), gradient=torch.zeros(1, 2), rate=0.1)
