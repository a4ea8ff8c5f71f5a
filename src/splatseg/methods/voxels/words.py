"""Features of voxels stored in few bytes, and words asked of them as they are stored.

Product quantisation cuts a row into parts and keeps for each the number of the nearest of 256
vectors, which k-means finds for that part; a product with a query is then a sum of as many entries
of a table.

The paper's score of a voxel for a label is the cosine of its feature with the text embedding
(section 3.5.1). In the span of the scene's features words that are rare compare as fairly as common
ones; there the answers are those of `lift.words`, with what the context of words needs computed
once.

References:
    Jegou, Douze and Schmid, Product Quantization for Nearest Neighbor Search (2011).
"""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float, Float32
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg._native import code_sums, row_products
from splatseg.core.boundary import boundary
from splatseg.core.voxels import CODES, StoredPrecision, StoredTable, VoxelFeatures
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.lift.vocabulary import TextSpace, Vocabulary
from splatseg.lift.words import (
    MIN_ENERGY,
    SAME_MEANING,
    TEMPERATURE,
    WordMatches,
    WordSpan,
    context_of,
    word_span,
)

_HALF_MAX = 65504.0
_BYTE_MAX = 127.0
_TRAINING_ROWS = 8192
_ROUNDS = 12
_AT_ONCE = 8192
"""Rows that are widened, or held against means, at a time."""

_SPAN_ROWS = 20_000
"""Rows, evenly among all, that the span is found from."""

_TINY = 1e-12
_MAX_EXPONENT = 80.0
"""Of e, in float32: beyond it a probability is 1 to the last digit."""

LastLayers = Callable[[Tensor], Tensor]
"""The last layers of an image encoder: features before them -> vectors in the space of words."""


@boundary
def store(
    values: Float[Tensor, "m channels"],
    *,
    precision: StoredPrecision = "float16",
    parts: int = 64,
    seed: int = 0,
) -> StoredTable:
    """Rows of numbers as a table of a precision.

    Args:
        values: Features, one row a voxel.
        precision: How numbers are kept: 4, 2 or 1 bytes each, or with product a byte for each part
            of a row.
        parts: With product: parts of a row at most; the most that divide the channels are taken.
        seed: With product: of the rows that k-means begins with.

    Raises:
        RangeError: If a value is not finite, or beyond 65504 and to be kept in float16, or `parts`
            is below 1.
    """
    check_finite("values", values)
    if parts < 1:
        raise RangeError(f"parts: expected at least 1, got {parts}.")
    values = values.detach().cpu().float().contiguous()
    if precision == "product":
        return _quantised(values, parts, seed)
    if precision == "int8":
        largest = values.abs().amax(dim=1) if values.shape[1] else torch.zeros(len(values))
        scales = torch.where(largest > 0, largest / _BYTE_MAX, 1.0)
        codes = (values / scales[:, None]).round().clamp(-_BYTE_MAX, _BYTE_MAX).to(torch.int8)
        return StoredTable(codes=codes, scales=scales)
    if precision == "float32":
        return StoredTable(codes=values)
    largest = float(values.abs().max()) if values.numel() else 0.0
    if largest > _HALF_MAX:
        raise RangeError(
            f"values: expected magnitudes of at most {_HALF_MAX:g} for float16, got {largest:g}; "
            "take float32."
        )
    return StoredTable(codes=values.half())


@boundary
def products(table: StoredTable, vectors: Float[Tensor, "k channels"]) -> Float32[Tensor, "m k"]:
    """Product of each row with each vector; rows are read as they are kept, and once.

    The result does not depend on the number of threads.

    Args:
        table: The rows.
        vectors: Any number of them.

    Raises:
        ShapeError: If widths do not fit.
    """
    check_shape("vectors", vectors, (None, table.channels))
    vectors = vectors.detach().cpu().float().contiguous()
    out = torch.empty(len(table), len(vectors))
    if table.codebooks is not None:
        parts, _, width = table.codebooks.shape
        cut = vectors.reshape(len(vectors), parts, width)
        tables = torch.einsum("psw,kpw->kps", table.codebooks.float(), cut).contiguous()
        code_sums(table.codes.contiguous(), tables, out)
        return out
    codes = table.codes.contiguous()
    row_products(codes.view(torch.int16) if codes.dtype == torch.float16 else codes, vectors, out)
    return out if table.scales is None else out * table.scales[:, None]


def _quantised(values: Tensor, parts: int, seed: int) -> StoredTable:
    """A table by product quantisation, of the most parts that divide the channels."""
    count, channels = values.shape
    parts = max(1, min(parts, channels))
    while channels % parts:
        parts -= 1
    width = channels // parts
    cut = values.reshape(count, parts, width)
    generator = torch.Generator().manual_seed(seed)
    chosen = torch.randperm(count, generator=generator)[:_TRAINING_ROWS]
    codebooks = torch.zeros(parts, CODES, width)
    codes = torch.zeros(count, parts, dtype=torch.uint8)
    for part in range(parts):
        rows = cut[:, part].contiguous()
        codebooks[part] = _means(rows[chosen])
        codes[:, part] = _nearest(rows, codebooks[part]).to(torch.uint8)
    return StoredTable(codes=codes, codebooks=codebooks)


def _means(rows: Float[Tensor, "n width"]) -> Float[Tensor, "codes width"]:
    """256 means of rows by k-means; it begins with the first rows, which are in random order."""
    centres = torch.zeros(CODES, rows.shape[1])
    if not len(rows):
        return centres
    centres[:] = rows[torch.arange(CODES) % len(rows)]
    for _ in range(_ROUNDS):
        nearest = _nearest(rows, centres)
        counts = torch.bincount(nearest, minlength=CODES)
        sums = torch.zeros(CODES, rows.shape[1], dtype=torch.float64)
        sums.index_add_(0, nearest, rows.double())
        # A mean that lost all its rows stays where it was.
        found = (sums / counts.clamp_min(1)[:, None]).float()
        centres = torch.where(counts[:, None] > 0, found, centres)
    return centres


def _nearest(rows: Tensor, centres: Tensor) -> Tensor:
    half = 0.5 * (centres * centres).sum(dim=1)
    return torch.cat([(part @ centres.T - half).argmax(dim=1) for part in rows.split(_AT_ONCE)])


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
        self.weights = weights.detach().cpu().float()
        """What the feature of each row rests on."""
        self.vocabulary: Vocabulary = vocabulary
        """Words that can be asked for."""
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
        self._context: tuple[StoredTable, Tensor] | None = None

    def __len__(self) -> int:
        """How many rows there are."""
        return len(self._table)

    @property
    def span(self) -> WordSpan | None:
        """Where words are compared; None is the whole space."""
        return self._span

    @boundary
    def cosines(
        self, vectors: Float[Tensor, "k width"], *, min_energy: float = 0.0
    ) -> Float32[Tensor, "m k"]:
        """Cosine of each row with each vector, 0 where one has no length.

        Args:
            vectors: Vectors of words, any number.
            min_energy: As in `WordSpan.cosines`; nothing in the whole space.
        """
        words = torch.nn.functional.normalize(vectors.float(), dim=1)
        if self._span is not None:
            inside = words @ self._span.directions.T
            energy = inside.norm(dim=1)
            kept = energy / (energy.square() + min_energy**2).sqrt().clamp_min(_TINY)
            scaled = torch.nn.functional.normalize(inside, dim=1) * kept[:, None]
            return products(self._inside, scaled)
        space = self.vocabulary.space
        if space.basis is None or space.mean is None:
            found = products(self._table, words)
        else:
            inside, constant = words @ space.basis.T.float(), words @ space.mean.float()
            found = products(self._table, inside) + constant
        inverse = torch.where(self._lengths > 0, 1 / self._lengths.clamp_min(_TINY), 0.0)
        return found * inverse[:, None]

    @boundary
    def ask(self, words: Sequence[str]) -> WordMatches:
        """What each row answers, see `lift.words.match_words`.

        The result does not depend on the number of threads.

        Raises:
            InputError: If there are no words, or nothing is known of one.
        """
        asked = self.vocabulary.vectors(words)
        others = context_of(self.vocabulary)
        rivals = self.vocabulary.vectors(others) if others else asked[:0]
        cosines = self.cosines(asked)
        against, largest = self._against(rivals)
        held = ((rivals @ asked.T) < SAME_MEANING).float()
        own = TEMPERATURE * self.cosines(asked, min_energy=MIN_ENERGY)
        own = torch.exp((own - largest[:, None]).clamp_max(_MAX_EXPONENT))
        found = own / (own + products(against, held.T.contiguous())).clamp_min(_TINY)
        found[self._lengths <= 0] = 0
        return WordMatches(
            words=tuple(word.strip() for word in words), cosines=cosines, probabilities=found
        )

    def _against(self, rivals: Tensor) -> tuple[StoredTable, Float32[Tensor, "m"]]:
        """E to tau times the cosines of the context, less the largest of each row, and these."""
        if self._context is None:
            scores = TEMPERATURE * self.cosines(rivals, min_energy=MIN_ENERGY)
            largest = scores.amax(dim=1) if len(rivals) else torch.zeros(len(self))
            scores.sub_(largest[:, None]).exp_()
            self._context = StoredTable(codes=scores), largest
        return self._context

    def _found_span(self, components: int) -> WordSpan:
        known = torch.nonzero(self._lengths > 0).squeeze(1)
        count = min(_SPAN_ROWS, len(known))
        # In whole numbers: rounding down what a processor rounded would choose others on another.
        chosen = known[torch.arange(count) * (len(known) - 1) // max(count - 1, 1)]
        weights = self.weights[chosen]
        return word_span(
            self._table.decode(chosen),
            torch.where(weights > 0, weights, _TINY),
            self.vocabulary.space,
            components=components,
        )

    def _projected(self, span: WordSpan) -> Float32[Tensor, "m directions"]:
        """Unit vectors of voxels in the span, 0 where one has no length there."""
        parts: list[Tensor] = []
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
