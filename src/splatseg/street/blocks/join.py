"""Labels that several blocks give to the same points, as one."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg.core import UNLABELLED, PointLabels
from splatseg.io.arrays import read_npy
from splatseg.io.atomic import named_write_failures

_LAST = np.iinfo(np.int64).max


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WeightedLabels:
    """What one block says of some points."""

    rows: Int[Tensor, "n"]
    """Which points, int64, each once."""

    ids: Int[Tensor, "n"]
    """int32, -1 none."""

    shares: Float[Tensor, "n"]
    """The confidence times what the block counts there, float64."""

    @classmethod
    def of(
        cls, labels: PointLabels, rows: Int[Tensor, "n"], weights: Float[Tensor, "n"]
    ) -> "WeightedLabels":
        """Labels of the points of some rows, by a block that counts so much at them."""
        return cls(
            rows=rows,
            ids=labels.ids.detach().cpu().int(),
            shares=weights * labels.confidence.detach().cpu().double(),
        )

    def save(self, path: Path) -> None:
        """Keep them in a file of this run: one array of float64, which holds all of it exactly.

        Raises:
            OutputError: If it cannot be written.
        """
        table = torch.stack((self.rows.double(), self.ids.double(), self.shares))
        with named_write_failures(path):
            np.save(path, table.numpy(), allow_pickle=False)

    @classmethod
    def load(cls, path: Path) -> "WeightedLabels":
        """Read what `save` kept."""
        rows, ids, shares = torch.from_numpy(read_npy(path))
        return cls(rows=rows.long(), ids=ids.int(), shares=shares)


def joined(parts: list[WeightedLabels], count: int) -> PointLabels:
    r"""The id with the largest sum of shares at each point.

    .. math:: v_c(x) = \sum_b w_b(x)\, p_b(x)\, [k_b(x) = c], \qquad
              \mathrm{id}(x) = \arg\max_c v_c(x)

    with k the id and p the confidence that block b gives. No label competes as one more id. Equal
    sums go to the smaller id, and no label loses them.

    Args:
        parts: What the blocks say, in their order, which is that of the sums.
        count: Number of points.

    Returns:
        Ids, and as confidence the winner's sum; -1 and 0 where no block says anything.
    """
    ids = torch.full((count,), UNLABELLED, dtype=torch.int32)
    confidence = torch.zeros(count)
    if not sum(len(part.rows) for part in parts):
        return PointLabels(ids=ids, confidence=confidence)
    rows = np.concatenate([part.rows.numpy() for part in parts]).astype(np.int64)
    named = np.concatenate([part.ids.numpy() for part in parts]).astype(np.int64)
    shares = np.concatenate([part.shares.numpy() for part in parts])
    pairs, inverse = np.unique(np.stack((rows, named), axis=1), axis=0, return_inverse=True)
    sums = np.bincount(inverse.reshape(-1), weights=shares, minlength=len(pairs))
    order_of_id = np.where(pairs[:, 1] == UNLABELLED, _LAST, pairs[:, 1])
    order = np.lexsort((order_of_id, -sums, pairs[:, 0]))
    first = order[np.unique(pairs[order, 0], return_index=True)[1]]
    at = torch.from_numpy(pairs[first, 0])
    ids[at] = torch.from_numpy(pairs[first, 1].astype(np.int32))
    confidence[at] = torch.from_numpy(sums[first]).float().clamp(0, 1)
    return PointLabels(ids=ids, confidence=confidence)
