"""How surely objects answer to words."""

import math

import pytest
import torch

from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.io.evidence import TextEmbeddings
from splatseg.lift import TextSpace
from splatseg.lift.vocabulary import Vocabulary
from splatseg.lift.words import CONTEXT_WORDS, context_of, match_words, word_span

WORDS = TextEmbeddings(
    labels=("mug", "cup", "desk", "lamp", "object"),
    vectors=torch.nn.functional.normalize(
        torch.tensor([[1.0, 0, 0, 0], [0.9, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 1, 1, 0]]),
        dim=1,
    ),
    kinds=("class", "synonym", "class", "class", "negative"),
    target_ids=(1, 1, 2, 3, -1),
)
SPACE = TextSpace(width=4)
VOCABULARY = Vocabulary(space=SPACE, recorded=WORDS)
VALUES = torch.tensor([[2.0, 0, 0, 0], [0, 3, 0, 0], [0.0, 0, 0, 0]])


def asked(words, **constants):
    span = word_span(torch.eye(4)[:3], torch.ones(3), SPACE)
    with pytest.MonkeyPatch.context() as patch:
        for name, value in constants.items():
            patch.setattr(f"splatseg.lift.words.{name.upper()}", value)
        return match_words(VALUES, words, VOCABULARY, span)


def test_by_hand() -> None:
    found = asked([" mug", "lamp"], temperature=2.0, same_meaning=0.7, min_energy=0.0)
    assert found.words == ("mug", "lamp")
    torch.testing.assert_close(found.cosines, torch.tensor([[1.0, 0], [0, 0], [0, 0]]))
    # Against desk, lamp and object (0.577); mug itself means the same.
    third = math.exp(2 / 3**0.5)
    mug = math.e**2 / (math.e**2 + 1 + 1 + third)
    # A desk: against desk, lamp and object; the last, of length 0, is nothing.
    not_mug = 1 / (1 + math.e**2 + 1 + third)
    torch.testing.assert_close(found.probabilities[:, 0], torch.tensor([mug, not_mug, 0.0]))


def test_words_of_one_meaning_are_not_held_against_each_other() -> None:
    same, apart = asked(["cup"], same_meaning=0.9), asked(["cup"], same_meaning=0.999)
    assert float(same.probabilities[0, 0]) > 0.99
    assert float(apart.probabilities[0, 0]) < 0.6


def test_words_that_the_scene_can_hardly_show_count_less() -> None:
    span = word_span(torch.eye(4)[:3], torch.ones(3), SPACE)
    faint = torch.tensor([[0.3, 0, 0, 0.91**0.5]])
    torch.testing.assert_close(span.cosines(VALUES[:1], faint), torch.ones(1, 1))
    less = span.cosines(VALUES[:1], faint, min_energy=0.4)
    torch.testing.assert_close(less, torch.tensor([[0.6]]))
    usual, never = asked(["mug"], min_energy=0.0), asked(["mug"], min_energy=1.0)
    assert float(never.probabilities[0, 0]) < float(usual.probabilities[0, 0])
    assert torch.equal(never.cosines, usual.cosines)


def test_a_word_that_nothing_answers_to_is_unknown() -> None:
    assert float(asked(["lamp"]).probabilities.max()) < 0.01


def test_the_context_is_of_recorded_classes_or_of_common_words() -> None:
    assert context_of(VOCABULARY) == ("mug", "desk", "lamp", "object")

    class Encoder:
        name, note, settings = "any", "", {}

        def text_features(self, image):
            raise NotImplementedError

        def encode_text(self, words):
            return torch.ones(len(words), 4)

    found = context_of(Vocabulary(space=SPACE, encoder=Encoder()))
    assert found[: len(CONTEXT_WORDS)] == CONTEXT_WORDS
    assert found[len(CONTEXT_WORDS) :] == ("object", "things", "stuff", "texture")
    assert len(set(CONTEXT_WORDS)) == len(CONTEXT_WORDS) > 150
    assert all(word and word == word.strip() for word in CONTEXT_WORDS)


def test_what_is_wrong_is_refused() -> None:
    with pytest.raises(InputError, match="words: expected"):
        asked([])
    with pytest.raises(InputError, match="got 'cap'; near are 'cup'"):
        asked(["cap"])


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


def test_components_are_the_strongest_by_weight(monkeypatch) -> None:
    values = torch.eye(4)[:3]
    weights = torch.tensor([1.0, 5.0, 900.0])
    one = word_span(values, weights, SPACE, components=1)
    torch.testing.assert_close(one.directions, torch.eye(4)[2:3])
    # With a limit below all they count alike, and the first by the solver's order is one of them.
    monkeypatch.setattr("splatseg.lift.words.FULL_WEIGHT", 5.0)
    two = word_span(values, torch.tensor([1.0, 5.0, 0.0]), SPACE, components=2)
    torch.testing.assert_close(two.directions, torch.eye(4)[[1, 0]])
    monkeypatch.setattr("splatseg.lift.words.FULL_WEIGHT", 3.0)
    values = torch.eye(4)[[0, 1, 1]]
    limited = word_span(values, torch.tensor([900.0, 2, 2]), SPACE, components=1)
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


def test_spans_that_are_wrong_are_refused() -> None:
    values = torch.ones(2, 4)
    with pytest.raises(RangeError, match="components: expected at least 1"):
        word_span(values, torch.ones(2), SPACE, components=0)
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
