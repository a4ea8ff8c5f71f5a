r"""Words asked of features: compared where the features of a scene differ, and calibrated.

Features of images and words stand apart (the modality gap), and features vary in few directions:
those in which things of the scene differ, less what a network or a compression left out. What a
word has outside of them is the same for every feature, but makes its cosines small: rare words lose
to those of large things. So both are compared in the span of features, `WordSpan`:

.. math:: \cos_V(f, t) = \frac{\langle V f, V t \rangle}{\| V f \| \, \| V t \|}

with the rows of V the first right singular vectors of the unit features of objects, each counted by
the cells that show it, up to a limit, so that walls do not decide alone. Means are not subtracted:
first vectors are the mean.

A cosine says nothing by itself: words differ in how near they are to anything. So each word is held
against what else a thing could be, the words of a context that do not mean the same:

.. math:: p_{kw} = \frac{e^{\tau s_{kw}}}{e^{\tau s_{kw}} +
          \sum_{c:\, \cos(t_c, t_w) < \gamma} e^{\tau s_{kc}}}

with s the cosines in the span, less those of words that the scene can hardly show. A word that no
object answers to with at least a half is unknown: the context explains every object better.

References:
    Liang et al., Mind the Gap: Understanding the Modality Gap in Multi-modal Contrastive
    Representation Learning (2022), on the gap.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64, Shaped
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core import UNLABELLED, Features
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.lift.vocabulary import TextSpace, Vocabulary

TEMPERATURE = 30.0
"""Tau."""

SAME_MEANING = 0.75
"""Gamma: words of the context whose cosine with a word is larger mean the same, and are not held
against it."""

MIN_ENERGY = 0.2
"""Length of a word in the span at which its s is 0.7 of its cosine."""

FULL_WEIGHT = 500.0
"""Cells from which on an object counts fully in the span."""

_TINY = 1e-12

_CONSTANT = 1e-5
"""Singular value, as a share of the largest, below which a direction is rounding."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WordSpan:
    """Directions in which words and features are compared."""

    directions: Float[Tensor, "directions width"]
    """V: orthonormal rows in the space of words."""

    space: TextSpace
    """How features stand for vectors in it."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_shape("directions", self.directions, (None, self.space.width))

    @boundary
    def inside(self, words: Float[Tensor, "k width"]) -> Float[Tensor, "k width"]:
        r"""Unit vectors of what of words lies in the span, zeros where nothing does.

        Dot products with any vector in the space of words, :math:`f \cdot V^T V t / \|V t\|`, order
        words as cosines in the span do.

        Raises:
            ShapeError: If widths do not fit.
        """
        check_shape("words", words, (None, self.space.width))
        return _unit(words.float() @ self.directions.T) @ self.directions

    @boundary
    def cosines(
        self,
        values: Float[Tensor, "n channels"],
        words: Float[Tensor, "k width"],
        *,
        min_energy: float = 0.0,
    ) -> Float[Tensor, "n k"]:
        r"""Cosine of each value with each word in the span; 0 where one has no length there.

        Args:
            values: Features, in the channels of the feature maps.
            words: Vectors of words.
            min_energy: A: cosines are times :math:`e / \sqrt{e^2 + a^2}` with e the energy of the
                word, so that what the scene can hardly show is no match for anything.

        Raises:
            ShapeError: If widths do not fit.
        """
        check_shape("words", words, (None, self.space.width))
        features = _unit(self.space.expand(values.float()) @ self.directions.T)
        inside = _unit(words.float()) @ self.directions.T
        energy = inside.norm(dim=1)
        kept = energy / (energy.square() + min_energy**2).sqrt().clamp_min(_TINY)
        return features @ (_unit(inside) * kept[:, None]).T


def _unit(vectors: Tensor) -> Tensor:
    lengths = vectors.norm(dim=-1, keepdim=True)
    return torch.where(lengths > _TINY, vectors / lengths.clamp_min(_TINY), 0.0)


@boundary
def word_span(
    values: Float[Tensor, "n channels"],
    weights: Float[Tensor, "n"],
    space: TextSpace,
    *,
    components: int = 32,
) -> WordSpan:
    """The directions in which features of objects differ.

    Args:
        values: Features of objects, in the channels of the feature maps.
        weights: How many cells show each, at least 0.
        space: How features stand for vectors in the space of words.
        components: Directions at most.

    Raises:
        ShapeError: If widths do not fit.
        RangeError: If numbers are not finite or out of range, or no feature has a weight.
    """
    if components < 1:
        raise RangeError(f"components: expected at least 1, got {components}.")
    if values.shape[:1] != weights.shape:
        raise ShapeError(f"weights: expected {len(values)}, got {tuple(weights.shape)}.")
    check_finite("values", values)
    check_finite("weights", weights)
    if not bool((weights > 0).any()) or bool((weights < 0).any()):
        raise RangeError("weights: expected at least 0, and one above 0.")
    counted = weights.double().clamp_max(FULL_WEIGHT)
    full = _unit(space.expand(values.float()).double())
    moment = (full * counted[:, None]).T @ full
    found, axes = torch.linalg.eigh(moment)
    found, axes = found.flip(0)[:components], axes.flip(1)[:, :components]
    # Signs are the solver's own; the largest entry of each is positive.
    largest = axes.abs().argmax(dim=0)
    axes = axes * torch.sign(axes[largest, torch.arange(axes.shape[1])])
    kept = found > (_CONSTANT**2) * found[0]
    return WordSpan(directions=axes[:, kept].T.float().contiguous(), space=space)


_AT_ONCE = 65_536
"""Features whose cosines with all words are held at a time."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WordMatches:
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
def match_words(
    values: Float[Tensor, "n channels"],
    words: Sequence[str],
    vocabulary: Vocabulary,
    span: WordSpan,
) -> WordMatches:
    """Ask features, of objects or of Gaussians, for words.

    The result does not depend on the number of threads.

    Args:
        values: Features, in the channels of the feature maps.
        words: Words or phrases.
        vocabulary: Their vectors.
        span: Where they are compared.

    Raises:
        InputError: If there are no words, or nothing is known of one.
        ShapeError: If widths do not fit.
    """
    others = context_of(vocabulary)
    asked = vocabulary.vectors(words)
    rivals = vocabulary.vectors(others) if others else asked[:0]
    held = (rivals @ asked.T) < SAME_MEANING
    parts = [
        _answered(part, asked=asked, rivals=rivals, held=held, span=span)
        for part in values.split(_AT_ONCE)
    ]
    cosines = torch.cat([part[0] for part in parts])
    return WordMatches(
        words=tuple(word.strip() for word in words),
        cosines=cosines,
        probabilities=torch.cat([part[1] for part in parts]),
    )


def _answered(
    values: Tensor, *, asked: Tensor, rivals: Tensor, held: Tensor, span: WordSpan
) -> tuple[Tensor, Tensor]:
    """Cosines of some features with the words, and p."""
    cosines = span.cosines(values, asked)
    own = TEMPERATURE * span.cosines(values, asked, min_energy=MIN_ENERGY)
    against = TEMPERATURE * span.cosines(values, rivals, min_energy=MIN_ENERGY)
    found = torch.empty_like(cosines)
    for column in range(cosines.shape[1]):
        total = torch.logsumexp(
            torch.cat((own[:, column, None], against[:, held[:, column]]), dim=1), dim=1
        )
        found[:, column] = torch.exp(own[:, column] - total)
    found[values.abs().amax(dim=1) <= 0] = 0
    return cosines, found


class WordIndex:
    """The distinct vectors of a layer: of its objects, of voxels, or of each Gaussian.

    Args:
        features: Features in the space of words.
        vocabulary: Vectors of words there.
        components: Directions in which words are compared, at most (`WordSpan`).

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
        self.values = values[rows]
        """The vectors, in the channels of the features."""
        # A row of zeros after the last stands for Gaussians without a vector: one gather is enough.
        self._padded = torch.where(self._rows < 0, len(rows), self._rows)
        counted = torch.ones(len(values)) if weights is None else weights.cpu().float()
        self.weights = torch.zeros(len(rows), dtype=torch.float64)
        """What each vector rests on, summed over its Gaussians."""
        self.weights.index_add_(0, self._rows[known], counted[known].double())
        self.vocabulary: Vocabulary = vocabulary
        """Words that can be asked for."""
        self.span: WordSpan = word_span(
            self.values, self.weights, vocabulary.space, components=components
        )
        """Where words are compared."""

    def __len__(self) -> int:
        """How many distinct vectors there are."""
        return len(self.values)

    @property
    def rows(self) -> Int64[Tensor, "n"]:
        """Of each Gaussian the row of its vector, -1 where it has none."""
        return self._rows

    @boundary
    def ask(self, words: Sequence[str]) -> WordMatches:
        """What each vector answers, see `match_words`."""
        return match_words(self.values, words, self.vocabulary, self.span)

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


# Chosen by hand from the vocabularies of indoor and street data sets (ScanNet, ADE20K, COCO,
# Cityscapes), one word a kind of thing; for models that encode any words.


_TEXT = """
    wall; floor; ceiling; window; door; curtain; blinds; rug; stairs; column; railing; radiator;
    bed; nightstand; wardrobe; cabinet; shelf; desk; table; chair; armchair; sofa; stool; bench;
    cushion; blanket; towel; lamp; mirror; picture; poster; clock; board; plant; flower; vase; tree;
    computer monitor; television; keyboard; computer mouse; laptop; printer; telephone; speaker;
    cable; remote control; camera; headphones; book; paper; magazine; pen; scissors; stapler; box;
    basket; bin; bag; backpack; suitcase; umbrella; shoe; hat; shirt; jacket; glasses; watch;
    bottle; cup; glass; plate; bowl; pan; kettle; knife; fork; spoon; jar; can; tray; candle;
    refrigerator; oven; stove; microwave; toaster; sink; tap; toilet; bathtub; shower; soap;
    washing machine; fan; heater; air conditioner; apple; banana; orange; bread; cake; sandwich;
    pizza; meat; vegetable; egg; cheese; toy; doll; toy car; teddy bear; ball; dice; game; guitar;
    piano; drum; bicycle; motorcycle; car; truck; bus; train; boat; airplane; wheel; road; sidewalk;
    crosswalk; building; house; roof; fence; bridge; pole; traffic light; traffic sign; street lamp;
    fire hydrant; statue; fountain; person; child; face; hand; dog; cat; bird; horse; cow; sheep;
    fish; insect; sky; cloud; grass; bush; leaf; soil; sand; rock; mountain; water; snow
"""

CONTEXT_WORDS: tuple[str, ...] = tuple(" ".join(word.split()) for word in _TEXT.split(";"))
"""About two hundred."""
