"""Words are found by name or by an encoder, and what is not known is named."""

import numpy as np
import pytest
import torch

from splatseg.core.models import CANONICAL_PHRASES
from splatseg.errors import InputError, MissingFileError
from splatseg.io.evidence import FeatureEvidence, TextEmbeddings, save_text_embeddings
from splatseg.lift.vocabulary import vocabulary_of


class Encoder:
    """Each word by the length of its name."""

    name, note, settings = "lengths", "", {}

    def __init__(self, width: int = 3) -> None:
        self.width = width

    def text_features(self, image):
        raise NotImplementedError

    def encode_text(self, words):
        return torch.stack([torch.full((self.width,), float(len(word))) for word in words])


def recorded(width: int = 3) -> TextEmbeddings:
    vectors = torch.eye(4, width) * torch.tensor([[1.0], [2.0], [1.0], [1.0]])
    vectors[3] = 1.0
    return TextEmbeddings(
        labels=("Red mug", "chair", "lamp", "object"), vectors=vectors,
        kinds=("instance", "class", "class", "negative"), target_ids=(4, 1, 2, -1),
    )  # fmt: skip


@pytest.fixture
def evidence(tmp_path) -> FeatureEvidence:
    folder = tmp_path / "words"
    folder.mkdir()
    return FeatureEvidence(folder=folder, files={})


def test_recorded_words(evidence) -> None:
    save_text_embeddings(recorded(), evidence.folder)
    found = vocabulary_of(evidence)
    assert found.space.width == 3
    assert found.words == ("Red mug", "chair", "lamp")
    assert found.negatives == ("object",)
    torch.testing.assert_close(found.vectors([" chair", "Red mug"]), torch.eye(3)[[1, 0]])
    assert found.known("object")
    assert not found.known("mug")


def test_they_may_lie_beside_the_features_or_elsewhere(evidence, tmp_path) -> None:
    save_text_embeddings(recorded(), evidence.folder.parent)
    assert vocabulary_of(evidence).known("lamp")
    other = tmp_path / "other"
    other.mkdir()
    with pytest.raises(MissingFileError, match=r"expected text_embeddings\.npz"):
        vocabulary_of(evidence, words=other)
    save_text_embeddings(recorded(2), other)
    assert vocabulary_of(evidence, words=other).space.width == 2
    (evidence.folder.parent / "text_embeddings.npz").unlink()
    with pytest.raises(InputError, match="in it or beside it, or a model"):
        vocabulary_of(evidence)


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("chiar", "4 recorded words, got 'chiar'; near are 'chair'"),
        ("mug", "near are 'Red mug'"),
        ("zzz", "got 'zzz', such as 'Red mug', 'chair', 'lamp'"),
    ],
)
def test_a_word_that_is_not_known_is_answered_by_those_near(evidence, word, said) -> None:
    save_text_embeddings(recorded(), evidence.folder)
    with pytest.raises(InputError, match=said):
        vocabulary_of(evidence).vectors([word])


def test_an_encoder_takes_any_word(evidence) -> None:
    found = vocabulary_of(evidence, Encoder())
    assert found.known("anything")
    assert found.words == ()
    assert found.negatives == CANONICAL_PHRASES
    torch.testing.assert_close(found.vectors(["ab"]), torch.full((1, 3), 3**-0.5))
    # Recorded words of another width are of another model.
    save_text_embeddings(recorded(2), evidence.folder)
    assert vocabulary_of(evidence, Encoder()).recorded is None
    save_text_embeddings(recorded(), evidence.folder)
    assert vocabulary_of(evidence, Encoder()).words == ("Red mug", "chair", "lamp")


@pytest.mark.parametrize("words", [[], [" "], ["chair", ""]])
def test_empty_words_are_refused(evidence, words) -> None:
    save_text_embeddings(recorded(), evidence.folder)
    with pytest.raises(InputError, match="words: expected words or phrases, got"):
        vocabulary_of(evidence).vectors(words)


def test_widths_must_fit(evidence) -> None:
    from dataclasses import replace

    save_text_embeddings(recorded(), evidence.folder)
    reduced = replace(evidence, basis=np.zeros((2, 5), np.float32), mean=np.zeros(5, np.float32))
    with pytest.raises(InputError, match="of width 5, as the features, got 3"):
        vocabulary_of(reduced)
