r"""What a label costs a pixel that may be labelled wrongly.

With p the probability of the pixel's label and q those of all ids:

.. math::
    \text{cross-entropy:}\; & -\log p \\
    \text{generalised (Zhang and Sabuncu 2018, eq. 6):}\; & (1 - p^{0.7}) / 0.7 \\
    \text{symmetric (Wang et al. 2019, eq. 6):}\; & -0.1 \log p + 4\,(1 - p) \\
    \text{bootstrap (Reed et al. 2015, eq. 6):}\; & -0.95 \log p - 0.05 \sum_c q_c \log q_c

References:
    Zhang and Sabuncu, Generalized Cross Entropy Loss for Training Deep Neural Networks with Noisy
    Labels (2018).
    Wang et al., Symmetric Cross Entropy for Robust Learning with Noisy Labels (2019).
    Reed et al., Training Deep Neural Networks on Noisy Labels with Bootstrapping (2015), soft.
"""

from typing import Literal, get_args

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.methods._trained import TINY

LabelLoss = Literal["cross_entropy", "generalised", "symmetric", "bootstrap"]
LABEL_LOSSES: tuple[LabelLoss, ...] = get_args(LabelLoss)

GENERALISED_POWER = 0.7
SYMMETRIC_FORWARD, SYMMETRIC_REVERSE = 0.1, 4.0
BOOTSTRAP_SHARE = 0.05


def label_loss(
    probabilities: Float[Tensor, "pixels classes"],
    label: Int64[Tensor, "pixels"],
    kind: LabelLoss,
) -> Float[Tensor, "pixels"]:
    """What each pixel's label costs.

    Args:
        probabilities: Of each id, rows that add up to 1.
        label: The column of each pixel's label.
        kind: Which cost.
    """
    own = probabilities.gather(1, label[:, None]).squeeze(1)
    log = torch.log(own + TINY)
    match kind:
        case "cross_entropy":
            return -log
        case "generalised":
            # The power of 0 has no gradient.
            return (1 - (own + TINY) ** GENERALISED_POWER) / GENERALISED_POWER
        case "symmetric":
            return -SYMMETRIC_FORWARD * log + SYMMETRIC_REVERSE * (1 - own)
        case "bootstrap":
            entropy = -(probabilities * torch.log(probabilities + TINY)).sum(dim=1)
            return -(1 - BOOTSTRAP_SHARE) * log + BOOTSTRAP_SHARE * entropy
