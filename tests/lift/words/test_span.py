"""Words and features are compared in the directions that features have."""

import pytest
import torch

from splatseg.errors import RangeError, ShapeError
from splatseg.lift import TextSpace
from splatseg.lift.words import word_span

SPACE = TextSpace(width=4)


def test_what_a_word_has_outside_of_the_span_does_not_count() -> None:
    values = torch.tensor([[1.0, 0, 0, 0], [0, 2, 0, 0], [3, 3, 0, 0]])
    span = word_span(values, torch.ones(3), SPACE)
    assert span.directions.shape == (2, 4)
    torch.testing.assert_close(span.directions @ span.directions.T, torch.eye(2))
    words = torch.tensor([[0.1, 0, 0.9, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    found = span.cosines(values, words)
    root = 0.5**0.5
    # The last word has nothing there.
    expected = torch.tensor([[1.0, 0, 0], [0, 1, 0], [root, root, 0]])
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)
    energy = torch.tensor([0.1 / (0.1**2 + 0.9**2) ** 0.5, 1.0, 0.0])
    torch.testing.assert_close(span.energy(words), energy, rtol=0, atol=1e-6)


def test_components_are_the_strongest_by_weight() -> None:
    values = torch.eye(4)[:3]
    weights = torch.tensor([1.0, 5.0, 900.0])
    one = word_span(values, weights, SPACE, components=1)
    torch.testing.assert_close(one.directions, torch.eye(4)[2:3])
    # With a limit below all they count alike, and the first by the solver's order is one of them.
    two = word_span(values, torch.tensor([1.0, 5.0, 0.0]), SPACE, components=2, full_weight=5.0)
    torch.testing.assert_close(two.directions, torch.eye(4)[[1, 0]])
    limited = word_span(
        torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 1, 0, 0]]), torch.tensor([900.0, 2, 2]),
        SPACE, components=1, full_weight=3.0,
    )  # fmt: skip
    torch.testing.assert_close(limited.directions, torch.eye(4)[1:2])


def test_components_of_features_are_full_vectors_first() -> None:
    basis, mean = torch.eye(4)[:2], torch.tensor([0.0, 0, 0.5, 0])
    space = TextSpace(width=4, basis=basis, mean=mean)
    values = torch.tensor([[1.0, 0], [0, 1], [0, 0]])
    span = word_span(values, torch.ones(3), space)
    assert len(span.directions) == 3
    found = span.cosines(values, torch.eye(4)[:3])
    length = 1.25**0.5
    expected = torch.tensor(
        [[1 / length, 0, 0.5 / length], [0, 1 / length, 0.5 / length], [0, 0, 1]]
    )
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)


def test_what_is_wrong_is_refused() -> None:
    values = torch.ones(2, 4)
    with pytest.raises(RangeError, match="components, full_weight"):
        word_span(values, torch.ones(2), SPACE, components=0)
    with pytest.raises(RangeError, match="components, full_weight"):
        word_span(values, torch.ones(2), SPACE, full_weight=0.0)
    with pytest.raises(ShapeError, match="weights: expected 2"):
        word_span(values, torch.ones(3), SPACE)
    for weights in (torch.zeros(2), torch.tensor([-1.0, 2.0])):
        with pytest.raises(RangeError, match="weights: expected at least 0"):
            word_span(values, weights, SPACE)
    with pytest.raises(RangeError, match="values"):
        word_span(values * torch.nan, torch.ones(2), SPACE)
    with pytest.raises(ShapeError, match="words"):
        word_span(values, torch.ones(2), SPACE).cosines(values, torch.ones(1, 3))


def test_dot_products_with_what_is_inside_order_words_as_cosines_do(rng) -> None:
    values = torch.from_numpy(rng.normal(size=(6, 3))).float()
    basis = torch.linalg.qr(torch.from_numpy(rng.normal(size=(8, 3))).float()).Q.T
    mean = torch.from_numpy(rng.normal(size=8)).float()
    space = TextSpace(width=8, basis=basis, mean=mean)
    span = word_span(values, torch.ones(6), space)
    words = torch.from_numpy(rng.normal(size=(5, 8))).float()
    inside = span.inside(words)
    torch.testing.assert_close(inside.norm(dim=1), torch.ones(5))
    lengths = (space.expand(values) @ span.directions.T).norm(dim=1, keepdim=True)
    torch.testing.assert_close(
        space.expand(values) @ inside.T, lengths * span.cosines(values, words)
    )
    axes = word_span(torch.eye(4)[:2], torch.ones(2), SPACE)
    assert axes.inside(torch.eye(4)[2:]).abs().max() == 0, "a word with nothing in the span"
