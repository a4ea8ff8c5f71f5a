"""What objects answer to the names and colours of referring expressions."""

from collections.abc import Callable, Collection, Mapping

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.errors import InputError
from splatseg.lift.phrases import colour_distances, colour_of, colour_words, vocabulary_names
from splatseg.lift.referring.geometry import NO, PERHAPS, YES, Array
from splatseg.lift.referring.grammar import NounPhrase, parse_referring
from splatseg.lift.referring.resolve import NameMatch
from splatseg.lift.vocabulary import Vocabulary

_PERHAPS_NAMED = 0.03
"""Probability of a name below which an object has another: in doubt, a phrase is ambiguous."""


class ObjectNames:
    """Names of objects, the longest end of a noun phrase that is one.

    Args:
        names: Names that can be asked for; None where any can, of a model that encodes words.
        ask: Probabilities (k,) of objects by a name; raises an `InputError` where it is unknown.
        colours: Mean colours of objects, CIELAB.
        min_probability: From which on an object answers to its name.
    """

    def __init__(
        self,
        names: Collection[str] | None,
        ask: Callable[[str], Float[Tensor, "k"]],
        colours: Callable[[], Float[Tensor, "k 3"]],
        *,
        min_probability: float,
    ) -> None:
        self._names: Mapping[str, str] | None = None
        if names is not None:
            self._names = {name.lower(): name for name in sorted(names)}
        self._ask, self._colours, self._least = ask, colours, min_probability
        self._found: dict[str, NameMatch] = {}

    def is_name(self, words: str) -> bool:
        """Whether words were recorded as a name."""
        return self._names is not None and words.lower() in self._names

    def match(self, noun: str) -> NameMatch:
        """What objects answer to a noun, with its colour; to "" all of them do.

        Raises:
            InputError: If nothing is known of it.
        """
        if noun not in self._found:
            self._found[noun] = self._matched(noun)
        return self._found[noun]

    def unread(self, noun: str) -> tuple[str, ...] | None:
        """Words before the name of a noun that are no colours; None where it has no name."""
        words = noun.split()
        if self._names is None:
            return ()
        before = next(
            (words[:at] for at in range(len(words)) if " ".join(words[at:]) in self._names), None
        )
        if before is None:
            return None if not all(colour_words(words)) else ()
        read = colour_words(before)
        return tuple(word for word, known in zip(before, read, strict=True) if not known)

    def colour(self, words: str) -> Array | None:
        """Distances of objects to a named colour; None where words are none."""
        colour = colour_of(f"{words} thing") if all(colour_words(words.split())) else None
        if colour is None:
            return None
        return colour_distances(self._colours(), colour).double().numpy()

    def _matched(self, noun: str) -> NameMatch:
        if not noun or (not self.is_name(noun) and all(colour_words(noun.split()))):
            count = len(self._colours())
            return NameMatch(
                name="thing",
                grades=np.full(count, YES),
                probabilities=np.ones(count),
                colour=self.colour(noun) if noun else None,
            )
        words = noun.split()
        read = colour_words(words)
        starts: range | tuple[int, ...] = range(len(words))
        if self._names is None:
            # A model encodes all but the colours before a name.
            first = next((at for at, known in enumerate(read) if not known), len(words) - 1)
            starts = (first,)
        for at in starts:
            called = " ".join(words[at:])
            if self._names is not None and called not in self._names:
                continue
            name = called if self._names is None else self._names[called]
            probabilities = self._ask(name).double().numpy()
            before = words[:at]
            colours = " ".join(word for word in before if colour_words([word])[0])
            return NameMatch(
                name=name,
                grades=np.where(
                    probabilities >= self._least,
                    YES,
                    np.where(probabilities >= min(_PERHAPS_NAMED, self._least), PERHAPS, NO),
                ),
                probabilities=probabilities,
                colour=self.colour(colours) if colours else None,
                unread=tuple(word for word in before if not colour_words([word])[0]),
            )
        self._ask(noun)  # says which names are near
        raise InputError(f"words: expected a name at the end of {noun!r}.")


def referring_readings(text: str, vocabulary: Vocabulary) -> tuple[NounPhrase, ...] | None:
    """The readings of a phrase that refers by relations, orders or counts.

    Names, and phrases that were recorded with a vector of their own, are asked for as they stand.
    So are those of a model that encodes any words, unless they have something of the grammar.

    Returns:
        None where a phrase is asked for as a word.

    Raises:
        InputError: If it has no vector and does not follow the grammar.
    """
    said = text.strip()
    recorded = vocabulary.recorded
    if not said or (recorded is not None and said in recorded.labels):
        return None
    names = name_list(vocabulary)
    lowered = None if names is None else {name.lower() for name in names}
    try:
        readings = parse_referring(said, is_name=lambda words: words in (lowered or ()))
    except InputError:
        if vocabulary.known(said):
            return None
        raise
    if not all(reading.is_plain for reading in readings):
        return readings
    if vocabulary.known(said) or lowered is None:
        return None
    known = ObjectNames(lowered, lambda name: torch.zeros(0), lambda: torch.zeros(0, 3),
                        min_probability=1.0)  # fmt: skip
    # "the red mugs" has no vector, but each of its words is known.
    return readings if known.unread(readings[0].noun) == () else None


def name_list(vocabulary: Vocabulary) -> frozenset[str] | None:
    """Names of a vocabulary, classes and synonyms; None where a model encodes any."""
    return None if vocabulary.encoder is not None else vocabulary_names(vocabulary)
