r"""Words compared with a scene's features where these differ: in their span.

Features of images and words stand apart (the modality gap), and features vary in few directions:
those in which things of the scene differ, less what a network or a compression left out. What a
word has outside of them is the same for every feature, but makes its cosines small: rare words lose
to those of large things. So both are compared in the directions that features of objects have:

.. math:: \cos_V(f, t) = \frac{\langle V f, V t \rangle}{\| V f \| \, \| V t \|}

with the rows of V the first right singular vectors of the unit features of objects, each counted by
the cells that show it, up to a limit, so that walls do not decide alone. Means are not subtracted:
first vectors are the mean.

References:
    Liang et al., Mind the Gap: Understanding the Modality Gap in Multi-modal Contrastive
    Representation Learning (2022), on the gap.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.threads import one_torch_thread
from splatseg.errors import RangeError, ShapeError
from splatseg.lift.vocabulary import TextSpace

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
    def energy(self, words: Float[Tensor, "k width"]) -> Float[Tensor, "k"]:
        """Length of words in the span, of 1, in [0, 1]: how much of a word the scene can show."""
        check_shape("words", words, (None, self.space.width))
        lengths = words.float().norm(dim=1).clamp_min(_TINY)
        return (words.float() @ self.directions.T).norm(dim=1) / lengths

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
        least_energy: float = 0.0,
    ) -> Float[Tensor, "n k"]:
        r"""Cosine of each value with each word in the span; 0 where one has no length there.

        Args:
            values: Features, in the channels of the feature maps.
            words: Vectors of words.
            least_energy: A: cosines are times :math:`e / \sqrt{e^2 + a^2}` with e the energy of the
                word, so that what the scene can hardly show is no match for anything.

        Raises:
            ShapeError: If widths do not fit.
        """
        check_shape("words", words, (None, self.space.width))
        with one_torch_thread():
            features = _unit(self.space.expand(values.float()) @ self.directions.T)
            inside = _unit(words.float()) @ self.directions.T
            energy = inside.norm(dim=1)
            kept = energy / (energy.square() + least_energy**2).sqrt().clamp_min(_TINY)
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
    full_weight: float = 500.0,
) -> WordSpan:
    """The directions in which features of objects differ.

    Args:
        values: Features of objects, in the channels of the feature maps.
        weights: How many cells show each, at least 0.
        space: How features stand for vectors in the space of words.
        components: Directions at most.
        full_weight: Cells from which on an object counts fully.

    Raises:
        ShapeError: If widths do not fit.
        RangeError: If numbers are not finite or out of range, or no feature has a weight.
    """
    if components < 1 or not full_weight > 0:
        raise RangeError(
            f"components, full_weight: expected at least 1 and above 0, got {components} and "
            f"{full_weight}."
        )
    if values.shape[:1] != weights.shape:
        raise ShapeError(f"weights: expected {len(values)}, got {tuple(weights.shape)}.")
    check_finite("values", values)
    check_finite("weights", weights)
    if not bool((weights > 0).any()) or bool((weights < 0).any()):
        raise RangeError("weights: expected at least 0, and one above 0.")
    with one_torch_thread():
        counted = weights.double().clamp_max(full_weight)
        full = _unit(space.expand(values.float()).double())
        moment = (full * counted[:, None]).T @ full
        found, axes = torch.linalg.eigh(moment)
    found, axes = found.flip(0)[:components], axes.flip(1)[:, :components]
    # Signs are the solver's own; the largest entry of each is positive.
    largest = axes.abs().argmax(dim=0)
    axes = axes * torch.sign(axes[largest, torch.arange(axes.shape[1])])
    kept = found > (_CONSTANT**2) * found[0]
    return WordSpan(directions=axes[:, kept].T.float().contiguous(), space=space)
