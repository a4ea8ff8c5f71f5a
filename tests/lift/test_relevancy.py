"""Cosines with words, of vectors and of principal components, and relevancy."""

import pytest
import torch

from splatseg.errors import InputError, ShapeError
from splatseg.lift import TextSpace, relevancy


def space(rng) -> TextSpace:
    basis = torch.from_numpy(rng.normal(size=(5, 20))).float()
    return TextSpace(width=20, basis=basis, mean=torch.from_numpy(rng.normal(size=20)).float())


def test_cosines_of_components_are_those_of_the_full_vectors(rng) -> None:
    components = torch.from_numpy(rng.normal(size=(3, 4, 5))).float()
    words = torch.from_numpy(rng.normal(size=(6, 20))).float()
    one = space(rng)
    full = components @ one.basis + one.mean
    wanted = torch.nn.functional.cosine_similarity(full[..., None, :], words, dim=-1)
    torch.testing.assert_close(one.cosines(components, words), wanted, rtol=0, atol=1e-5)
    plain = TextSpace(width=20)
    torch.testing.assert_close(plain.cosines(full, words), wanted, rtol=0, atol=1e-5)
    assert plain.cosines(torch.zeros(2, 20), words).abs().max() == 0


def test_the_linear_classifier_takes_the_word_of_the_largest_cosine(rng) -> None:
    words = torch.from_numpy(rng.normal(size=(6, 20))).float()
    for one, values in (
        (space(rng), torch.from_numpy(rng.normal(size=(50, 5))).float()),
        (TextSpace(width=20), torch.from_numpy(rng.normal(size=(50, 20))).float()),
    ):
        weight, bias = one.linear(words)
        found = (values @ weight.T + bias).argmax(1)
        assert torch.equal(found, one.cosines(values, words).argmax(1))


def test_relevancy_is_the_least_softmax_against_a_canonical_word(rng) -> None:
    cosines = torch.from_numpy(rng.uniform(-1, 1, (7, 2)))
    negatives = torch.from_numpy(rng.uniform(-1, 1, (7, 3)))
    pairs = torch.stack(
        [
            torch.exp(8 * cosines)
            / (torch.exp(8 * cosines) + torch.exp(8 * negatives[:, n : n + 1]))
            for n in range(3)
        ]
    )
    found = relevancy(cosines, negatives, temperature=8)
    torch.testing.assert_close(found, pairs.amin(0), rtol=0, atol=1e-12)


def test_what_is_refused() -> None:
    with pytest.raises(InputError, match="negatives: expected at least one"):
        relevancy(torch.zeros(2, 1), torch.zeros(2, 0))
    with pytest.raises(InputError, match="basis, mean: expected both"):
        TextSpace(width=3, mean=torch.zeros(3))
    with pytest.raises(ShapeError, match="words"):
        TextSpace(width=3).cosines(torch.zeros(2, 3), torch.zeros(1, 4))
