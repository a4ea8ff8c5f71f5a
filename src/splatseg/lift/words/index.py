"""A layer of features, arranged to be asked for words again and again."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int64, Shaped
from torch import Tensor

from splatseg.core import UNLABELLED, Features
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.lift.vocabulary import Vocabulary
from splatseg.lift.words.answers import AnswerOptions, WordAnswers, answer_words
from splatseg.lift.words.span import WordSpan, word_span


class WordIndex:
    """The distinct vectors of a layer: of its objects, of voxels, or of each Gaussian.

    Args:
        features: Features in the space of words.
        vocabulary: Vectors of words there.
        components: Directions in which words are compared, at most (`lift.words.span`).

    Raises:
        InputError: If no Gaussian has a feature.
        ShapeError: If widths do not fit.
    """

    @boundary
    def __init__(self, features: Features, vocabulary: Vocabulary, *, components: int = 32) -> None:
        values = features.values.detach().cpu().float()
        weights = features.weights
        known = values.abs().amax(dim=1) > 0
        if weights is not None:
            known &= weights.cpu() > 0
        if not bool(known.any()):
            raise InputError("features: expected a feature of at least one Gaussian, got none.")
        rows, self._rows = _distinct(values, known)
        self._values = values[rows]
        # A row of zeros after the last stands for Gaussians without a vector: one gather is enough.
        self._padded = torch.where(self._rows < 0, len(rows), self._rows)
        counted = torch.ones(len(values)) if weights is None else weights.cpu().float()
        self._weights = torch.zeros(len(rows), dtype=torch.float64)
        self._weights.index_add_(0, self._rows[known], counted[known].double())
        self._vocabulary = vocabulary
        self._span = word_span(self._values, self._weights, vocabulary.space, components=components)

    def __len__(self) -> int:
        """How many distinct vectors there are."""
        return len(self._values)

    @property
    def rows(self) -> Int64[Tensor, "n"]:
        """Of each Gaussian the row of its vector, -1 where it has none."""
        return self._rows

    @property
    def weights(self) -> Float[Tensor, "k"]:
        """What each vector rests on, summed over its Gaussians."""
        return self._weights

    @property
    def values(self) -> Float[Tensor, "k channels"]:
        """The vectors, in the channels of the features."""
        return self._values

    @property
    def span(self) -> WordSpan:
        """Where words are compared."""
        return self._span

    @property
    def vocabulary(self) -> Vocabulary:
        """Words that can be asked for."""
        return self._vocabulary

    @boundary
    def ask(
        self,
        words: Sequence[str],
        *,
        context: Sequence[str] | None = None,
        options: AnswerOptions | None = None,
    ) -> WordAnswers:
        """What each vector answers, see `answer_words`."""
        return answer_words(
            self._values, words, self._vocabulary, self._span, context=context, options=options
        )

    @boundary
    def of_gaussians(self, found: Shaped[Tensor, "k words"]) -> Shaped[Tensor, "n words"]:
        """Numbers of vectors on their Gaussians, 0 where one has none.

        Args:
            found: One row a vector, such as the probabilities of `ask`.
        """
        padded = torch.cat((found, found.new_zeros(1, found.shape[1])))
        return padded.index_select(0, self._padded)


def _distinct(
    values: Float[Tensor, "n channels"], known: Bool[Tensor, "n"]
) -> tuple[Int64[Tensor, "k"], Int64[Tensor, "n"]]:
    """The first Gaussian of each vector, and of each Gaussian the vector.

    Vectors are equal if all their bits are: they are told apart by a sum of their bits with odd
    factors, and a sum that two different vectors have in common is told apart column by column.
    """
    bits = values.contiguous().view(torch.int32).long()
    factors = torch.arange(values.shape[1], dtype=torch.int64) * 2_654_435_761 + 0x9E37_79B9
    place = torch.where(known, (bits * (factors | 1)).sum(dim=1), torch.zeros(1, dtype=torch.int64))
    _, number = torch.unique(place[known], return_inverse=True)
    chosen = torch.nonzero(known).squeeze(1)
    first = _first_of_each(number, chosen)
    if not torch.equal(bits[first][number], bits[chosen]):
        _, number = torch.unique(bits[chosen], dim=0, return_inverse=True)
        first = _first_of_each(number, chosen)
    # In the order of their first Gaussians, which does not depend on bits.
    order = torch.argsort(first)
    renamed = torch.empty_like(order)
    renamed[order] = torch.arange(len(order))
    rows = torch.full((len(values),), UNLABELLED, dtype=torch.int64)
    rows[chosen] = renamed[number]
    return first[order], rows


def _first_of_each(number: Tensor, chosen: Tensor) -> Tensor:
    count = int(number.max()) + 1
    first = torch.full((count,), torch.iinfo(torch.int64).max, dtype=torch.int64)
    return first.scatter_reduce(0, number, chosen, reduce="amin")
