r"""How much views agree with a pixel's label: the weight of pixels that contradict all others.

.. math:: a_p = \frac{\sum_i w_{pi} s_{i, \mathrm{label}(p)}}{\sum_i w_{pi}}

with :math:`s_{ic}` the share of the votes of all views for id c on Gaussian i (`lift.mass.uplift`).
"""

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.core import Labels
from splatseg.errors import InputError
from splatseg.lift.training import Batch
from splatseg.methods._trained import TINY


class VoteAgreement:
    """The weight of each pixel of a batch.

    Args:
        votes: Labels with the shares of several ids.
        ids: All ids, ascending; a pixel's label is a number among them.

    Raises:
        InputError: If the labels have no shares.
    """

    def __init__(self, votes: Labels, ids: Int64[Tensor, "classes"]) -> None:
        if votes.candidates is None or votes.shares is None:
            raise InputError("votes: expected labels with the shares of several ids, got none.")
        self._candidates = votes.candidates.cpu()
        self._shares = votes.shares.cpu().float()
        self._ids = ids

    def __call__(self, batch: Batch) -> Float[Tensor, "pixels"]:
        """In [0, 1]."""
        rows = batch.weights.rows
        label = self._ids[batch.target("label")]
        entries = batch.weights.touched[rows.ids.long()]
        own = torch.repeat_interleave(label, rows.indptr.diff())
        agrees = self._candidates[entries] == own[:, None]
        share = (self._shares[entries] * agrees).sum(dim=1) * rows.weights.float()
        pixel = torch.repeat_interleave(torch.arange(len(label)), rows.indptr.diff())
        total = torch.zeros(len(label)).index_add_(0, pixel, share)
        return total / (rows.row_sums() + TINY)
