r"""Words asked of voxels: as the paper compares them, or calibrated as objects are asked.

The paper's score of a voxel for a label is the cosine of its feature with the text embedding
(section 3.5.1). In the span of the scene's features (`lift.words.span`) words that are rare compare
as fairly as common ones; there the answers are those of `lift.words.answers`, with what the
context of words needs computed once and kept.
"""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float, Float32
from torch import Tensor

from splatseg._check import check_shape
from splatseg.core.boundary import boundary
from splatseg.core.threads import one_torch_thread
from splatseg.core.voxel_features import StoredTable, VoxelFeatures
from splatseg.errors import InputError, ShapeError
from splatseg.lift.vocabulary import TextSpace, Vocabulary
from splatseg.lift.voxels.storage import products, store
from splatseg.lift.words import AnswerOptions, WordAnswers, WordSpan, context_of, word_span

_AT_ONCE = 8192
"""Rows that are widened at a time."""

_SPAN_ROWS = 20_000
"""Rows, evenly among all, that the span is found from."""

_TINY = 1e-12
_MAX_EXPONENT = 80.0
"""Of e, in float32: beyond it a probability is 1 to the last digit."""

LastLayers = Callable[[Tensor], Tensor]
"""The last layers of an image encoder: features before them -> vectors in the space of words."""


class TableWords:
    """Rows of features, arranged to be asked for words again and again.

    Args:
        table: Features, a row a thing.
        weights: What each row rests on, at least 0; the span is found with them.
        vocabulary: Vectors of words in the space of the features.
        components: Directions in which words are compared, at most; None compares plain cosines
            in the whole space, as the paper does.
        last_layers: Where features were kept before the last layers of the image encoder (section
            3.3): these, applied to each voxel now (section 3.5.1).

    Raises:
        InputError: If no row has a feature.
        ShapeError: If widths do not fit.
    """

    @boundary
    def __init__(
        self,
        table: StoredTable,
        weights: Float[Tensor, "m"],
        vocabulary: Vocabulary,
        *,
        components: int | None = 32,
        last_layers: LastLayers | None = None,
    ) -> None:
        check_shape("weights", weights, (len(table),))
        self._weights = weights.detach().cpu().float()
        self._vocabulary = vocabulary
        if last_layers is not None:
            table = _applied(table, last_layers)
        space = vocabulary.space
        expected = space.width if space.basis is None else len(space.basis)
        if table.channels != expected:
            raise ShapeError(
                f"features: expected {expected} channels, as those that words are compared with, "
                f"got {table.channels}."
            )
        self._lengths = _lengths(table, space)
        if not bool((self._lengths > 0).any()):
            raise InputError("features: expected a feature of at least one row, got none.")
        self._table = table
        self._span: WordSpan | None = None
        if components is not None:
            self._span = self._found_span(components)
            self._inside = store(self._projected(self._span), precision="float32")
        self._context: tuple[tuple[tuple[str, ...], AnswerOptions], StoredTable, Tensor] | None
        self._context = None

    def __len__(self) -> int:
        """How many rows there are."""
        return len(self._table)

    @property
    def vocabulary(self) -> Vocabulary:
        """Words that can be asked for."""
        return self._vocabulary

    @property
    def span(self) -> WordSpan | None:
        """Where words are compared; None is the whole space."""
        return self._span

    @property
    def weights(self) -> Float[Tensor, "m"]:
        """What the feature of each row rests on."""
        return self._weights

    @boundary
    def cosines(
        self, vectors: Float[Tensor, "k width"], *, least_energy: float = 0.0
    ) -> Float32[Tensor, "m k"]:
        """Cosine of each row with each vector, 0 where one has no length.

        Args:
            vectors: Vectors of words, any number.
            least_energy: As in `WordSpan.cosines`; nothing in the whole space.
        """
        words = torch.nn.functional.normalize(vectors.float(), dim=1)
        if self._span is not None:
            with one_torch_thread():
                inside = words @ self._span.directions.T
                energy = inside.norm(dim=1)
                kept = energy / (energy.square() + least_energy**2).sqrt().clamp_min(_TINY)
                scaled = torch.nn.functional.normalize(inside, dim=1) * kept[:, None]
            return products(self._inside, scaled)
        space = self._vocabulary.space
        if space.basis is None or space.mean is None:
            found = products(self._table, words)
        else:
            with one_torch_thread():
                inside, constant = words @ space.basis.T.float(), words @ space.mean.float()
            found = products(self._table, inside) + constant
        inverse = torch.where(self._lengths > 0, 1 / self._lengths.clamp_min(_TINY), 0.0)
        return found * inverse[:, None]

    @boundary
    def ask(
        self,
        words: Sequence[str],
        *,
        context: Sequence[str] | None = None,
        options: AnswerOptions | None = None,
    ) -> WordAnswers:
        """What each row answers, see `lift.words.answer_words`.

        The result does not depend on the number of threads.

        Raises:
            InputError: If there are no words, or nothing is known of one.
        """
        options = options or AnswerOptions()
        asked = self._vocabulary.vectors(words)
        others = context_of(self._vocabulary) if context is None else tuple(context)
        rivals = self._vocabulary.vectors(others) if others else asked[:0]
        cosines = self.cosines(asked)
        tau = options.temperature
        against, largest = self._against(others, rivals, options)
        with one_torch_thread():
            held = ((rivals @ asked.T) < options.same_meaning).float()
            own = tau * self.cosines(asked, least_energy=options.least_energy)
            own = torch.exp((own - largest[:, None]).clamp_max(_MAX_EXPONENT))
            found = own / (own + products(against, held.T.contiguous())).clamp_min(_TINY)
        found[self._lengths <= 0] = 0
        return WordAnswers(
            words=tuple(word.strip() for word in words), cosines=cosines, probabilities=found
        )

    def _against(
        self, others: tuple[str, ...], rivals: Tensor, options: AnswerOptions
    ) -> tuple[StoredTable, Float32[Tensor, "m"]]:
        """E to tau times the cosines of a context, less the largest of each voxel, and these."""
        if self._context is not None and self._context[0] == (others, options):
            return self._context[1:]
        largest = torch.zeros(len(self))
        scores = options.temperature * self.cosines(rivals, least_energy=options.least_energy)
        if len(rivals):
            largest = scores.amax(dim=1)
        scores.sub_(largest[:, None]).exp_()
        self._context = ((others, options), StoredTable(codes=scores), largest)
        return self._context[1:]

    def _found_span(self, components: int) -> WordSpan:
        known = torch.nonzero(self._lengths > 0).squeeze(1)
        count = min(_SPAN_ROWS, len(known))
        # In whole numbers: rounding down what a processor rounded would choose others on another.
        chosen = known[torch.arange(count) * (len(known) - 1) // max(count - 1, 1)]
        weights = self._weights[chosen]
        return word_span(
            self._table.decode(chosen),
            torch.where(weights > 0, weights, _TINY),
            self._vocabulary.space,
            components=components,
        )

    def _projected(self, span: WordSpan) -> Float32[Tensor, "m directions"]:
        """Unit vectors of voxels in the span, 0 where one has no length there."""
        parts: list[Tensor] = []
        with one_torch_thread():
            for start in range(0, len(self._table), _AT_ONCE):
                values = self._table.decode(slice(start, start + _AT_ONCE))
                inside = span.space.expand(values) @ span.directions.T
                parts.append(torch.nn.functional.normalize(inside, dim=1))
        found = torch.cat(parts)
        found[self._lengths <= 0] = 0
        return found


class VoxelWords(TableWords):
    """Features of voxels, arranged to be asked for words again and again.

    Args:
        layer: The voxels.
        vocabulary: Vectors of words in the space of their features.
        components: As in `TableWords`.
        last_layers: As in `TableWords`.

    Raises:
        InputError: If no voxel has a feature.
        ShapeError: If widths do not fit.
    """

    @boundary
    def __init__(
        self,
        layer: VoxelFeatures,
        vocabulary: Vocabulary,
        *,
        components: int | None = 32,
        last_layers: LastLayers | None = None,
    ) -> None:
        super().__init__(
            layer.table, layer.weights, vocabulary, components=components, last_layers=last_layers
        )
        self._layer = layer

    @boundary
    def of_gaussians(self, found: Float[Tensor, "m words"]) -> Float[Tensor, "n words"]:
        """Numbers of voxels as Gaussians read them, 0 where one reads none.

        Args:
            found: One row a voxel, such as the probabilities of `ask`.
        """
        return self._layer.of_gaussians(found)


def _lengths(table: StoredTable, space: TextSpace) -> Float32[Tensor, "m"]:
    """Lengths of the vectors that rows stand for; 0 for rows of zeros."""
    parts: list[Tensor] = []
    with one_torch_thread():
        for start in range(0, len(table), _AT_ONCE):
            values = table.decode(slice(start, start + _AT_ONCE))
            length = space.expand(values).norm(dim=1)
            parts.append(torch.where(values.abs().amax(dim=1) > 0, length, 0.0))
    return torch.cat(parts) if parts else torch.zeros(0)


def _applied(table: StoredTable, last_layers: LastLayers) -> StoredTable:
    """The last layers of every row, in float16; rows of zeros stay so."""
    parts: list[Tensor] = []
    for start in range(0, len(table), _AT_ONCE):
        values = table.decode(slice(start, start + _AT_ONCE))
        found = last_layers(values).float()
        parts.append(torch.where((values.abs().amax(dim=1) > 0)[:, None], found, 0.0).half())
    return StoredTable(codes=torch.cat(parts))
