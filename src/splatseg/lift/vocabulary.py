r"""Words for features: their space, cosines, relevancy, and vectors of words.

The relevancy of a word with the vector t for features f (Kerr et al. 2023, LERF, section 3.4) is
its softmax against each of some canonical words n, the least of them:

.. math:: r = \min_n \frac{e^{\tau \cos(f, t)}}{e^{\tau \cos(f, t)} + e^{\tau \cos(f, n)}}
            = \sigma\bigl(\tau (\cos(f, t) - \max_n \cos(f, n))\bigr)
"""

import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.models import CANONICAL_PHRASES, TextFeatures
from splatseg.errors import InputError, MissingFileError
from splatseg.io.evidence import TEXT_FILE, FeatureEvidence, TextEmbeddings, load_text_embeddings

_TINY = 1e-12


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TextSpace:
    """How a layer's values stand for vectors in the space of words."""

    width: int
    """Width of the vectors."""

    basis: Float[Tensor, "components width"] | None = None
    """Full vectors by principal component; None where values are the vectors."""

    mean: Float[Tensor, "width"] | None = None
    """The vector that components are added to; goes with `basis`."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if (self.basis is None) != (self.mean is None):
            raise InputError("basis, mean: expected both or none of them.")
        if self.basis is not None and self.mean is not None:
            check_shape("basis", self.basis, (None, self.width))
            check_shape("mean", self.mean, (self.width,))

    @boundary
    def expand(self, values: Float[Tensor, "*batch channels"]) -> Float[Tensor, "*batch width"]:
        """Full vectors, of the length that values give them.

        Args:
            values: Vectors, or components of them.

        Raises:
            ShapeError: If widths do not fit.
        """
        if self.basis is None or self.mean is None:
            check_shape("values", values, (*values.shape[:-1], self.width))
            return values
        check_shape("values", values, (*values.shape[:-1], len(self.basis)))
        return values @ self.basis.to(values) + self.mean.to(values)

    @boundary
    def cosines(
        self, values: Float[Tensor, "*batch channels"], words: Float[Tensor, "k width"]
    ) -> Float[Tensor, "*batch k"]:
        """Cosine of each value with each word; 0 where a value is of length 0.

        Args:
            values: Of Gaussians or of pixels: vectors, or components of them. Vectors need no
                unit length, so sums of blending weights times vectors will do; components must be
                means.
            words: Vectors of words.

        Raises:
            ShapeError: If widths do not fit.
        """
        check_shape("words", words, (None, self.width))
        if self.basis is None or self.mean is None:
            check_shape("values", values, (*values.shape[:-1], self.width))
            dots, squares = values @ words.T.to(values), (values * values).sum(-1)
        else:
            # Of full vectors, without making them: their width is twenty times the components'.
            check_shape("values", values, (*values.shape[:-1], len(self.basis)))
            basis, mean = self.basis.to(values), self.mean.to(values)
            dots = values @ (basis @ words.T.to(values)) + words.to(values) @ mean
            squares = ((values @ (basis @ basis.T)) * values).sum(-1)
            squares = squares + 2 * (values @ (basis @ mean)) + mean @ mean
        lengths = words.to(values).norm(dim=-1) * squares.clamp_min(0).sqrt()[..., None]
        return torch.where(lengths > _TINY, dots / lengths.clamp_min(_TINY), 0.0)

    @boundary
    def linear(
        self, words: Float[Tensor, "k width"]
    ) -> tuple[Float[Tensor, "k channels"], Float[Tensor, "k"]]:
        """Weight and bias of the classifier that takes the word of the largest cosine.

        A value's length scales all its cosines, and so decides nothing.
        """
        check_shape("words", words, (None, self.width))
        unit = torch.nn.functional.normalize(words, dim=-1)
        if self.basis is None or self.mean is None:
            return unit, torch.zeros(len(unit))
        return unit @ self.basis.T.to(unit), unit @ self.mean.to(unit)


@boundary
def relevancy(
    cosines: Float[Tensor, "*batch words"],
    negatives: Float[Tensor, "*batch negatives"],
    *,
    temperature: float = 10.0,
) -> Float[Tensor, "*batch words"]:
    """Relevancy of words in [0, 1]; above 0.5 a word fits better than every negative.

    Args:
        cosines: With the words that are asked for.
        negatives: With the canonical words.
        temperature: tau.

    Raises:
        InputError: If there is no negative.
        RangeError: If a cosine is NaN or infinite.

    Example:
        >>> relevancy(torch.tensor([[0.3, 0.1]]), torch.tensor([[0.1, 0.0]])).round(decimals=3)
        tensor([[0.8810, 0.5000]])
    """
    if not negatives.dim() or not negatives.shape[-1]:
        raise InputError("negatives: expected at least one, got none.")
    check_finite("cosines", cosines)
    check_finite("negatives", negatives)
    return torch.sigmoid(temperature * (cosines - negatives.amax(dim=-1, keepdim=True)))


_SUGGESTIONS = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Vocabulary:
    """Vectors of words in the space of a scene's features."""

    space: TextSpace
    """How the features stand for vectors in it."""

    recorded: TextEmbeddings | None = None
    """Words whose vectors are known; with an encoder, those that are asked for by name only."""

    encoder: TextFeatures | None = None
    """Makes vectors of any words."""

    @property
    def words(self) -> tuple[str, ...]:
        """Words that were recorded, phrases to compare with left out."""
        if self.recorded is None:
            return ()
        pairs = zip(self.recorded.labels, self.recorded.kinds, strict=True)
        return tuple(label for label, kind in pairs if kind != "negative")

    @property
    def negatives(self) -> tuple[str, ...]:
        """Phrases to compare words with: those recorded, or the canonical ones of an encoder."""
        found: tuple[str, ...] = ()
        if self.recorded is not None:
            pairs = zip(self.recorded.labels, self.recorded.kinds, strict=True)
            found = tuple(label for label, kind in pairs if kind == "negative")
        return found or (CANONICAL_PHRASES if self.encoder is not None else ())

    def known(self, word: str) -> bool:
        """Whether there is a vector of a word."""
        return self.encoder is not None or (
            self.recorded is not None and word in self.recorded.labels
        )

    @boundary
    def vectors(self, words: Sequence[str]) -> Float[Tensor, "n width"]:
        """Unit vectors of words or phrases.

        Recorded words are asked for as they stand; spaces around them do not count.

        Raises:
            InputError: If there are no words, one is empty, or nothing is known of one: the nearest
                that are known are named then.
        """
        asked = [word.strip() for word in words]
        if not asked or "" in asked:
            raise InputError(
                "words: expected words or phrases, got "
                + ("none." if not asked else "an empty one.")
            )
        if self.encoder is not None:
            found = self.encoder.encode_text(asked).cpu().float()
        elif self.recorded is not None:
            for word in asked:
                if word not in self.recorded.labels:
                    raise InputError(self._unknown(word, self.recorded))
            rows = [self.recorded.labels.index(word) for word in asked]
            found = self.recorded.vectors[rows].float()
        else:
            raise InputError("words: expected a model or recorded vectors of words, got none.")
        return torch.nn.functional.normalize(found, dim=-1)

    def _unknown(self, word: str, recorded: TextEmbeddings) -> str:
        """That a word has no vector, which do, and which of these are like it."""
        lowered = {label.lower(): label for label in recorded.labels}
        near = difflib.get_close_matches(word.lower(), list(lowered), n=_SUGGESTIONS)
        # A phrase that holds the word is near, however long it is.
        near += [one for one in lowered if word.lower() in one and one not in near]
        names = [lowered[one] for one in near[:_SUGGESTIONS]]
        said = (
            f"; near are {', '.join(map(repr, names))}"
            if names
            else f", such as {', '.join(map(repr, recorded.labels[:_SUGGESTIONS]))}"
        )
        return (
            f"words: expected one of the {len(recorded.labels)} recorded words, got {word!r}{said}."
        )


@boundary
def vocabulary_of(
    evidence: FeatureEvidence, encoder: TextFeatures | None = None, *, words: Path | None = None
) -> Vocabulary:
    """The words of features, by a model or as they were recorded with them.

    Args:
        evidence: Features in the space of words.
        encoder: The model that made them. None takes recorded vectors: `text_embeddings.npz` in
            the folder of the features, or beside it.
        words: Folder or file of recorded vectors, where it is another.

    Raises:
        InputError: If there is neither a model nor a file of vectors, or widths do not fit.
        FileFormatError: If the file holds something else.
    """
    basis = None if evidence.basis is None else torch.from_numpy(evidence.basis)
    mean = None if evidence.mean is None else torch.from_numpy(evidence.mean)
    recorded = None
    places = (evidence.folder, evidence.folder.parent) if words is None else (words,)
    for place in places:
        path = place / TEXT_FILE if place.is_dir() else place
        if path.is_file():
            recorded = load_text_embeddings(path)
            break
    if recorded is None and words is not None:
        raise MissingFileError(f"{words}: expected {TEXT_FILE}, found none.")
    if recorded is None and encoder is None:
        raise InputError(
            f"{evidence.folder}: expected {TEXT_FILE} in it or beside it, or a model that encodes "
            "words, got neither."
        )
    if encoder is not None:
        width = int(encoder.encode_text(["object"]).shape[1])
        if recorded is not None and recorded.vectors.shape[1] != width:
            recorded = None
    else:
        width = 0 if recorded is None else int(recorded.vectors.shape[1])
    if mean is not None and len(mean) != width:
        raise InputError(
            f"{evidence.folder}: expected words of width {len(mean)}, as the features, got {width}."
        )
    return Vocabulary(
        space=TextSpace(width=width, basis=basis, mean=mean), recorded=recorded, encoder=encoder
    )
