r"""How surely objects answer to words.

A cosine says nothing by itself: words differ in how near they are to anything. So each word is held
against what else a thing could be, the words of a context that do not mean the same:

.. math:: p_{kw} = \frac{e^{\tau s_{kw}}}{e^{\tau s_{kw}} +
          \sum_{c:\, \cos(t_c, t_w) < \gamma} e^{\tau s_{kc}}}

with s the cosines in the span of the scene's features (`lift.words.span`), less those of words
that the scene can hardly show. A word that no object
answers to with at least a half is unknown: the context explains every object better.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg._check import check_range
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.threads import one_torch_thread
from splatseg.errors import RangeError
from splatseg.lift.vocabulary import Vocabulary
from splatseg.lift.words.context import CONTEXT_WORDS
from splatseg.lift.words.span import WordSpan

_AT_ONCE = 65_536
"""Features whose cosines with all words are held at a time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AnswerOptions:
    """How cosines become probabilities."""

    temperature: float = 30.0
    """Tau."""

    same_meaning: float = 0.75
    """Gamma: words of the context whose cosine with a word is larger mean the same, and are not
    held against it."""

    least_energy: float = 0.2
    """Length of a word in the span, in [0, 1], at which its s is 0.7 of its cosine."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_range("least_energy", self.least_energy, 0.0, 1.0)
        if not 0 < self.temperature < float("inf"):
            raise RangeError(f"temperature: expected above 0, got {self.temperature}.")
        check_range("same_meaning", self.same_meaning, -1.0, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WordAnswers:
    """What features answer to words."""

    words: tuple[str, ...]

    cosines: Float[Tensor, "n k"]
    """In the span."""

    probabilities: Float[Tensor, "n k"]
    """P; 0 for features of length 0."""


def context_of(vocabulary: Vocabulary) -> tuple[str, ...]:
    """What else a thing could be: recorded classes and negatives, or common words of an encoder."""
    recorded = vocabulary.recorded
    if vocabulary.encoder is not None or recorded is None:
        return (*CONTEXT_WORDS, *vocabulary.negatives)
    pairs = zip(recorded.labels, recorded.kinds, strict=True)
    return tuple(label for label, kind in pairs if kind in ("class", "negative"))


@boundary
def answer_words(
    values: Float[Tensor, "n channels"],
    words: Sequence[str],
    vocabulary: Vocabulary,
    span: WordSpan,
    *,
    context: Sequence[str] | None = None,
    options: AnswerOptions | None = None,
) -> WordAnswers:
    """Ask features, of objects or of Gaussians, for words.

    The result does not depend on the number of threads.

    Args:
        values: Features, in the channels of the feature maps.
        words: Words or phrases.
        vocabulary: Their vectors.
        span: Where they are compared.
        context: What else a thing could be; None takes `context_of` the vocabulary.
        options: How cosines become probabilities.

    Raises:
        InputError: If there are no words, or nothing is known of one.
        ShapeError: If widths do not fit.
    """
    options = options or AnswerOptions()
    others = context_of(vocabulary) if context is None else tuple(context)
    with one_torch_thread():
        asked = vocabulary.vectors(words)
        rivals = vocabulary.vectors(others) if others else asked[:0]
        held = (rivals @ asked.T) < options.same_meaning
        parts = [
            _answered(part, asked=asked, rivals=rivals, held=held, span=span, options=options)
            for part in values.split(_AT_ONCE)
        ]
    cosines = torch.cat([part[0] for part in parts])
    return WordAnswers(
        words=tuple(word.strip() for word in words),
        cosines=cosines,
        probabilities=torch.cat([part[1] for part in parts]),
    )


def _answered(
    values: Tensor,
    *,
    asked: Tensor,
    rivals: Tensor,
    held: Tensor,
    span: WordSpan,
    options: AnswerOptions,
) -> tuple[Tensor, Tensor]:
    """Cosines of some features with the words, and p."""
    cosines = span.cosines(values, asked)
    least, tau = options.least_energy, options.temperature
    own = tau * span.cosines(values, asked, least_energy=least)
    against = tau * span.cosines(values, rivals, least_energy=least)
    found = torch.empty_like(cosines)
    for column in range(cosines.shape[1]):
        total = torch.logsumexp(
            torch.cat((own[:, column, None], against[:, held[:, column]]), dim=1), dim=1
        )
        found[:, column] = torch.exp(own[:, column] - total)
    found[values.abs().amax(dim=1) <= 0] = 0
    return cosines, found
