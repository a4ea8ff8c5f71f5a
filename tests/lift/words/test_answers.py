"""How surely objects answer to words."""

import math

import pytest
import torch

from splatseg.errors import InputError, RangeError
from splatseg.io.evidence import TextEmbeddings
from splatseg.lift import TextSpace
from splatseg.lift.vocabulary import Vocabulary
from splatseg.lift.words import (
    CONTEXT_WORDS,
    AnswerOptions,
    answer_words,
    context_of,
    word_span,
)

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


def asked(words, **options):
    span = word_span(torch.eye(4)[:3], torch.ones(3), SPACE)
    return answer_words(VALUES, words, VOCABULARY, span, options=AnswerOptions(**options))


def test_by_hand() -> None:
    found = asked([" mug", "lamp"], temperature=2.0, same_meaning=0.7, least_energy=0.0)
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
    less = span.cosines(VALUES[:1], faint, least_energy=0.4)
    torch.testing.assert_close(less, torch.tensor([[0.6]]))
    usual, never = asked(["mug"], least_energy=0.0), asked(["mug"], least_energy=1.0)
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


def test_another_context_counts_instead() -> None:
    span = word_span(torch.eye(4)[:3], torch.ones(3), SPACE)
    alone = answer_words(VALUES, ["mug"], VOCABULARY, span, context=())
    torch.testing.assert_close(alone.probabilities[:, 0], torch.tensor([1.0, 1.0, 0.0]))


def test_what_is_wrong_is_refused() -> None:
    with pytest.raises(InputError, match="words: expected"):
        asked([])
    with pytest.raises(InputError, match="got 'cap'; near are 'cup'"):
        asked(["cap"])
    for change in ({"temperature": 0.0}, {"same_meaning": 2.0}, {"least_energy": -1.0}):
        with pytest.raises(RangeError, match=next(iter(change))):
            AnswerOptions(**change)
