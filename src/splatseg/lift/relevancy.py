r"""Features in the space of words: cosines with words, and how relevant a word is.

The relevancy of a word with the vector t for features f (Kerr et al. 2023, LERF, section 3.4) is
its softmax against each of some canonical words n, the least of them:

.. math:: r = \min_n \frac{e^{\tau \cos(f, t)}}{e^{\tau \cos(f, t)} + e^{\tau \cos(f, n)}}
            = \sigma\bigl(\tau (\cos(f, t) - \max_n \cos(f, n))\bigr)
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError

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
