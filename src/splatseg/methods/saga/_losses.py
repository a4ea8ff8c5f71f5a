r"""The losses of SAGA, each of the drawn pixels of one view.

Losses of pairs of pixels are linear in the similarities S once it is known which pairs count, with
constant coefficients K. As a sum of :math:`K_{pq} \langle d_p, d_q \rangle` over directions d it
costs two products and keeps nothing of the size of the pairs for its gradient:

.. math:: \sum_{pq} K_{pq} \langle d_p, d_q \rangle = \sum_p \langle d_p, (K d)_p \rangle .
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, normalize

_BLOCK = 512
"""Pixels whose pairs with all others are held at a time."""

HARD_POSITIVE = 0.75
"""Pixels that belong together are pulled while their similarity is below this."""

HARD_NEGATIVE = 0.5
"""Pixels that do not are pushed while it is above this."""


def guidance_loss(
    prototypes: Float[Tensor, "masks channels"],
    rendered: Float[Tensor, "pixels channels"],
    inside: Bool[Tensor, "pixels masks"],
) -> Float[Tensor, ""]:
    r"""SAM-guidance loss, eq. 6 and 7: the binary cross-entropy of masks and what queries find.

    .. math:: -\mathrm{mean}_{M, p} \bigl[ M_p \log \sigma(T_M \cdot F_p)
              + (1 - M_p) \log (1 - \sigma(T_M \cdot F_p)) \bigr]

    The text sums where the code, and this, take the mean.
    """
    return binary_cross_entropy_with_logits(rendered @ prototypes.T, inside.to(rendered))


def masked_means(
    values: Float[Tensor, "pixels channels"],
    inside: Bool[Tensor, "pixels masks"],
    stands_for: Float[Tensor, "pixels"],
) -> Float[Tensor, "masks channels"]:
    """Masked average pooling, eq. 5: the mean over the pixels of each mask.

    Over drawn pixels it is an estimate, each counting as many as it stands for.
    """
    share = inside.to(values) * stands_for[:, None]
    return (share.T @ values) / share.sum(dim=0).clamp_min(1e-12)[:, None]


def correspondence_loss(
    rendered: Float[Tensor, "pixels channels"], inside: Bool[Tensor, "pixels masks"]
) -> Float[Tensor, ""]:
    r"""Correspondence loss, eq. 8 to 10: pixels are as alike as their masks are the same.

    .. math:: -\mathrm{mean}_{p, q} K(p, q) \, \max(0, \cos(F_p, F_q)), \qquad
              K(p, q) = \frac{|M^p \cap M^q|}{|M^p \cup M^q|}, \; -1 \text{ where that is } 0 .

    The text has the cosine itself and a sum; the published code, and this, cut it off below 0, so
    that unlike pixels need not become opposite, and take the mean.
    """
    directions = normalize(rendered, dim=1)
    fixed = directions.detach()
    with torch.no_grad():
        # Few sets of masks occur in a view, and K is the same for all pixels of two of them.
        sets, which = _distinct(inside)
        overlap = set_overlaps(sets).to(rendered)[:, which]
        pulled = torch.zeros_like(fixed)
        for begin in range(0, len(fixed), _BLOCK):
            block, rest = fixed[begin : begin + _BLOCK], fixed[begin:]
            kept = (block @ rest.T).gt_(0)
            kept.mul_(overlap[:, begin:].index_select(0, which[begin : begin + _BLOCK]))
            pulled[begin : begin + _BLOCK] += kept @ rest
            pulled[begin + _BLOCK :] += kept[:, len(block) :].T @ block
        value = (fixed * pulled).sum()
    # With pulled = K d the sum is <d, K d> and its gradient 2 K d, as K is symmetric.
    return -(2 * (directions * pulled).sum() - value) / max(len(rendered) ** 2, 1)


def _distinct(
    inside: Bool[Tensor, "pixels masks"],
) -> tuple[Bool[Tensor, "sets masks"], Int64[Tensor, "pixels"]]:
    """The sets of masks that occur, and which of them each pixel has."""
    packed: NDArray[np.uint8] = np.packbits(inside.numpy(), axis=1)
    # Equal bytes are equal sets, and sort a hundred times as fast as rows of booleans.
    rows = np.ascontiguousarray(packed).view(f"V{packed.shape[1]}").reshape(-1)
    first, which = np.unique(rows, return_index=True, return_inverse=True)[1:]
    return inside[torch.from_numpy(first)], torch.from_numpy(which.astype(np.int64))


def set_overlaps(sets: Bool[Tensor, "sets masks"]) -> Float[Tensor, "sets sets"]:
    """K of eq. 8 for pairs of sets of masks: intersection over union, -1 where that is 0."""
    member = sets.float()
    shared = member @ member.T
    sizes = member.sum(dim=1)
    union = sizes[:, None] + sizes[None, :] - shared
    return torch.where(shared == 0, -1.0, shared / union.clamp_min(1))


def together_at(
    inside: Bool[Tensor, "pixels masks"],
    ranks: Float[Tensor, "masks"],
    scale: float,
    *,
    known: Bool[Tensor, "pixels"] | None = None,
) -> tuple[Bool[Tensor, "pixels pixels"], Bool[Tensor, "pixels pixels"]]:
    """Which pairs of pixels belong together at a scale, and which do not.

    At a scale a pixel belongs to the masks up to it, and to larger ones only where none of those
    covers it. Pixels that share one belong together; pixels of which one belongs to a mask and
    that share none do not; of two pixels outside all masks nothing is known.

    Args:
        inside: Which pixels each mask contains.
        ranks: The scales of the masks, in [0, 1].
        scale: The scale that is asked about.
        known: Pixels of which something is known; None for all.
    """
    small = ranks <= scale
    covered = (inside & small).any(dim=1)
    member = inside & (small[None, :] | ~covered[:, None])
    one = member.float()
    together = (one @ one.T) > 0
    masked = member.any(dim=1)
    apart = ~together & (masked[:, None] | masked[None, :])
    return together, apart if known is None else apart & known[:, None] & known[None, :]


def contrast_loss(
    directions: Float[Tensor, "pixels channels"],
    together: Bool[Tensor, "pixels pixels"],
    apart: Bool[Tensor, "pixels pixels"],
    weights: Float[Tensor, "pixels"] | None = None,
) -> Float[Tensor, ""]:
    r"""Hard pairs pulled together and pushed apart: the scale-gated loss.

    .. math:: \mathrm{mean}_{P}(1 - S_{pq}) + \mathrm{mean}_{N} S_{pq}

    with P the pairs that belong together with :math:`S < 0.75` and N those that do not with
    :math:`S > 0.5`, pairs weighted by :math:`w_p w_q`, or alike without weights.
    """
    with torch.no_grad():
        similarity = directions @ directions.T
        pulled = (together & (similarity < HARD_POSITIVE)).float()
        pushed = (apart & (similarity > HARD_NEGATIVE)).float()
        if weights is not None:
            pair = weights[:, None] * weights[None, :]
            pulled, pushed = pulled * pair, pushed * pair
        pulls = pulled.sum()
        coefficients = pushed.div_(pushed.sum().clamp_min(1e-12))
        coefficients.sub_(pulled.div_(pulls.clamp_min(1e-12)))
    return (pulls > 0).float() + pair_sum(coefficients, directions)


def pair_sum(
    coefficients: Float[Tensor, "pixels pixels"], directions: Float[Tensor, "pixels channels"]
) -> Float[Tensor, ""]:
    """The sum of K_pq <d_p, d_q>, differentiable towards the directions alone; K is symmetric."""
    return (directions * (coefficients @ directions)).sum()


def norm_loss(rendered: Float[Tensor, "pixels channels"]) -> Float[Tensor, ""]:
    """The mean of (1 - |F_p|)^2: Gaussians of a pixel agree, so that their mean keeps its length.

    Directions that differ within a pixel cancel, and then the pixel shows a shorter feature than
    each of its Gaussians has.
    """
    return (1 - torch.linalg.vector_norm(rendered, dim=1)).square().mean()


def pixel_weights(
    inside: Bool[Tensor, "pixels masks"],
    areas: Float[Tensor, "masks"],
    *,
    reference: float,
    max_weight: float,
) -> Float[Tensor, "pixels"]:
    """What pixels count, the more the smaller the mask they are in: 1 to `max_weight`.

    Args:
        inside: Which pixels each mask contains.
        areas: Share of the view that each covers.
        reference: Share from which on a mask counts 1; smaller ones count in inverse proportion.
        max_weight: The largest weight; 1 weighs all pixels alike.
    """
    smallest = torch.where(inside, areas[None, :], 1.0).amin(dim=1) if inside.shape[1] else None
    if smallest is None:
        return torch.ones(len(inside))
    return (reference / smallest.clamp_min(1e-12)).clamp(1.0, max_weight)


def members(
    pixel: Int64[Tensor, "entries"], mask: Int64[Tensor, "entries"], pixels: int
) -> tuple[Bool[Tensor, "pixels masks"], Int64[Tensor, "masks"]]:
    """Which pixels each mask contains, and the numbers of the masks that occur, ascending."""
    numbers, column = torch.unique(mask, return_inverse=True)
    inside = torch.zeros(pixels, len(numbers), dtype=torch.bool)
    inside[pixel, column] = True
    return inside, numbers
