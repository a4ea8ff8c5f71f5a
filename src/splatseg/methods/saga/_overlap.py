"""How well a similarity tells a mask: the best overlap that a threshold gives."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def best_overlap(
    similarity: Float[Tensor, "pixels"],
    inside: Bool[Tensor, "pixels"],
    weights: Float[Tensor, "pixels"],
) -> float:
    """The best intersection over union, of any threshold, of similar pixels with a mask.

    Pixels of one similarity come in together.

    Args:
        similarity: Of each pixel to what is looked for.
        inside: Which pixels the mask contains.
        weights: What each pixel counts.
    """
    if not bool(inside.any()):
        return 0.0
    values, order = torch.sort(similarity, descending=True, stable=True)
    weight = weights[order].double()
    found = torch.cumsum(weight, dim=0)
    shared = torch.cumsum(weight * inside[order], dim=0)
    overlap = shared / (found + shared[-1] - shared)
    last = torch.ones(len(values), dtype=torch.bool)
    last[:-1] = values[1:] < values[:-1]
    return float(overlap[last].max())
