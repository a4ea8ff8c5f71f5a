"""Candidates of soft labels."""

import torch
from torch import Tensor

from splatseg.core.evidence import UNLABELLED


def merged_candidates(candidates: Tensor, shares: Tensor) -> tuple[Tensor, Tensor]:
    """Candidates of which several may be the same id, with their shares added up."""
    columns = list(candidates.unbind(dim=1))
    sums = [column.float().clone() for column in shares.unbind(dim=1)]
    for later in range(1, len(columns)):
        for first in range(later):
            same = (columns[later] == columns[first]) & (columns[later] != UNLABELLED)
            sums[first] += torch.where(same, sums[later], 0.0)
            columns[later] = torch.where(same, UNLABELLED, columns[later])
    found, added = torch.stack(columns, dim=1), torch.stack(sums, dim=1)
    return found, torch.where(found == UNLABELLED, 0.0, added)
