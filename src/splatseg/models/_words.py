"""Words as models take them: checked, in a sentence, as a class table, as vectors in a file."""

from collections.abc import Sequence

import torch

from splatseg.core import ClassInfo, ClassTable
from splatseg.core.models import CANONICAL_PHRASES, TextFeaturesWithWords
from splatseg.errors import InputError
from splatseg.io.evidence import TextEmbeddings

_PLACE = "{}"


def checked_words(words: Sequence[str], *, needed: str | None = None) -> tuple[str, ...]:
    """Words without spaces around them.

    Args:
        words: Words or phrases.
        needed: Who needs at least one; None where there may be none.

    Raises:
        InputError: If one is empty or stands there twice, or there is none where one is needed.
    """
    found = tuple(word.strip() for word in words)
    if needed is not None and not found:
        raise InputError(
            f"words: {needed} looks for what words name, so expected at least one word "
            "(--words chair table), got none."
        )
    if "" in found:
        raise InputError("words: expected words or phrases, got an empty one.")
    for word in found:
        if found.count(word) > 1:
            raise InputError(f"words: expected distinct words, got {word!r} more than once.")
    return found


def checked_template(template: str) -> None:
    """Raise `InputError` unless a sentence has one place for a word."""
    if template.count(_PLACE) != 1:
        raise InputError(
            f"template: expected a sentence with {{}} once, where the word stands, "
            f"got {template!r:.80}."
        )


def in_sentences(words: Sequence[str], template: str) -> list[str]:
    """Words, each in its sentence."""
    return [template.replace(_PLACE, word) for word in words]


def word_classes(words: Sequence[str]) -> ClassTable:
    """Words as classes of things: the ids 1, 2, ... in the order of the words."""
    return ClassTable(
        rows=tuple(ClassInfo(id=i, name=word) for i, word in enumerate(words, start=1))
    )


def word_vectors(model: TextFeaturesWithWords) -> TextEmbeddings:
    """The vectors of a model's words, and of the phrases that words are compared with.

    A phrase that is one of the words itself is left out: nothing is more relevant than itself.
    """
    words = model.words
    phrases = tuple(phrase for phrase in CANONICAL_PHRASES if phrase not in words)
    labels = (*words, *phrases)
    return TextEmbeddings(
        labels=labels,
        vectors=torch.nn.functional.normalize(model.encode_text(labels).cpu().float(), dim=-1),
        kinds=("class",) * len(words) + ("negative",) * len(phrases),
        target_ids=(-1,) * len(labels),
    )
