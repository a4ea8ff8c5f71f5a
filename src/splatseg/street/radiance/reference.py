"""Eq. 5 ray by ray and sample by sample, as it is written."""

import torch
from jaxtyping import Float
from torch import Tensor


def composite(
    opacity: Float[Tensor, "n hits"],
    values: Float[Tensor, "n hits c"],
    background: Float[Tensor, "n c"],
) -> Float[Tensor, "n c"]:
    """What rays show, in float64; see `compositing.composite`."""
    shown = torch.zeros(background.shape, dtype=torch.float64)
    for ray in range(len(opacity)):
        transmittance = 1.0
        for sigma, value in zip(opacity[ray].tolist(), values[ray], strict=True):
            shown[ray] += transmittance * sigma * value.double()
            transmittance *= 1.0 - sigma
        shown[ray] += transmittance * background[ray].double()
    return shown


def cross_entropy(probabilities: Float[Tensor, "n k"], columns: list[int]) -> float:
    """Eq. 7: minus the mean over all rays of the log of the label's; -1 adds nothing."""
    total = 0.0
    for row, column in zip(probabilities.double(), columns, strict=True):
        if column >= 0:
            total -= float(row[column].log())
    return total / len(columns)
