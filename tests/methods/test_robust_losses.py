"""What labels cost, by hand."""

import math

import pytest
import torch

from splatseg.methods._robust_losses import LABEL_LOSSES, label_loss

PROBABILITIES = torch.tensor([[0.7, 0.2, 0.1], [0.25, 0.25, 0.5]])
LABEL = torch.tensor([0, 1])


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("cross_entropy", lambda p, q: -math.log(p)),
        ("generalised", lambda p, q: (1 - p**0.7) / 0.7),
        ("symmetric", lambda p, q: -0.1 * math.log(p) + 4 * (1 - p)),
        (
            "bootstrap",
            lambda p, q: -0.95 * math.log(p) - 0.05 * sum(x * math.log(x) for x in q),
        ),
    ],
)
def test_by_hand(kind, expected) -> None:
    found = label_loss(PROBABILITIES, LABEL, kind)
    wanted = [expected(float(q[c]), q.tolist()) for q, c in zip(PROBABILITIES, LABEL, strict=True)]
    torch.testing.assert_close(found, torch.tensor(wanted))


@pytest.mark.parametrize("kind", LABEL_LOSSES)
def test_a_label_that_nothing_speaks_for_has_a_finite_gradient(kind) -> None:
    given = torch.tensor([[0.0, 1.0]], requires_grad=True)
    label_loss(given, torch.tensor([0]), kind).sum().backward()
    assert given.grad is not None
    assert bool(torch.isfinite(given.grad).all())
    assert float(given.grad[0, 0]) < 0
