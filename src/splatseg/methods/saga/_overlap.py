"""How well what was found agrees with a mask."""

from jaxtyping import Bool, Float
from torch import Tensor


def mean_overlap(
    found: Bool[Tensor, "pixels queries"],
    inside: Bool[Tensor, "pixels"],
    weights: Float[Tensor, "pixels"],
) -> float:
    """The mean intersection over union of what queries found with a mask.

    Args:
        found: Which pixels each query finds.
        inside: Which pixels the mask contains.
        weights: What each pixel counts.
    """
    if not bool(inside.any()) or not found.shape[1]:
        return 0.0
    weight = weights.double()[:, None]
    both = (weight * (found & inside[:, None])).sum(dim=0)
    either = (weight * (found | inside[:, None])).sum(dim=0)
    return float((both / either).mean())
