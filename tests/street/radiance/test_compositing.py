"""Compositing: eq. 5 by hand, against its readable twin, and by finite differences."""

import pytest
import torch

from splatseg.street.radiance import composite, ray_weights
from street import reference


def test_two_samples_and_a_background_by_hand() -> None:
    """.5 of 1, then .25 of what is left of 10, then the rest of 100."""
    opacity = torch.tensor([[0.5, 0.25]])
    values = torch.tensor([[[1.0], [10.0]]])
    shown = composite(opacity, values, torch.tensor([[100.0]]))
    assert shown.item() == pytest.approx(0.5 * 1 + 0.5 * 0.25 * 10 + 0.5 * 0.75 * 100)


def test_nothing_shows_through_what_is_opaque() -> None:
    opacity = torch.tensor([[0.0, 1.0, 0.7]], requires_grad=True)
    values = torch.tensor([[[3.0], [5.0], [1e6]]])
    shown = composite(opacity, values, torch.tensor([[1e6]]))
    shown.sum().backward()
    assert shown.item() == 5.0
    assert opacity.grad is not None
    assert opacity.grad[0, 2].item() == 0.0
    assert opacity.grad[0, 0].item() == 3.0 - 5.0


def test_without_samples_it_is_the_background() -> None:
    shown = composite(torch.zeros(2, 3), torch.ones(2, 3, 4), torch.full((2, 4), 7.0))
    assert torch.equal(shown, torch.full((2, 4), 7.0))


@pytest.mark.parametrize("hits", [1, 2, 6])
def test_it_is_the_readable_twin(hits: int) -> None:
    rng = torch.Generator().manual_seed(hits)
    opacity = torch.rand(20, hits, generator=rng)
    values = torch.randn(20, hits, 5, generator=rng)
    behind = torch.randn(20, 5, generator=rng)
    fast = composite(opacity, values, behind)
    assert torch.allclose(fast.double(), reference.composite(opacity, values, behind), atol=1e-6)


def test_weights_and_what_passes_add_up_to_one() -> None:
    opacity = torch.rand(50, 6, generator=torch.Generator().manual_seed(0))
    weights, passed = ray_weights(opacity)
    assert torch.allclose(weights.sum(dim=1) + passed, torch.ones(50), atol=1e-6)


def test_gradients_are_finite_differences() -> None:
    rng = torch.Generator().manual_seed(1)

    def leaf(*shape: int) -> torch.Tensor:
        return torch.rand(shape, generator=rng, dtype=torch.float64).requires_grad_()

    assert torch.autograd.gradcheck(composite, (leaf(3, 4), leaf(3, 4, 2), leaf(3, 2)))
