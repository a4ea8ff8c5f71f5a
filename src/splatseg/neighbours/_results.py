"""What a search finds."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor


def square_root(squared: Float64[Tensor, "*shape"]) -> Float64[Tensor, "*shape"]:
    """Square roots rounded correctly: torch's may be off in the last bit."""
    return torch.from_numpy(np.sqrt(squared.numpy()))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Neighbours:
    """The k nearest points of each query, nearest first, of equally near ones the lower index."""

    indices: Int64[Tensor, "m k"]
    """Rows of the points, -1 where there are fewer than k."""

    distances: Float64[Tensor, "m k"]
    """How far they are, in the unit of the points; infinite where there are fewer than k."""

    def __len__(self) -> int:
        return len(self.indices)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NeighbourLists:
    """The points within a radius of each query, as sparse rows (CSR).

    Those of query i are ``indices[starts[i]:starts[i + 1]]``, nearest first, of equally near
    ones the lower index first.
    """

    starts: Int64[Tensor, "m+1"]
    """Where each query's points begin; the last value is how many pairs there are."""

    indices: Int64[Tensor, "pairs"]
    """Rows of the points."""

    distances: Float64[Tensor, "pairs"]
    """How far they are, in the unit of the points."""

    def __len__(self) -> int:
        return len(self.starts) - 1

    @property
    def counts(self) -> Int64[Tensor, "m"]:
        """How many points each query has."""
        return self.starts.diff()

    def to(self, device: torch.device) -> "NeighbourLists":
        """The same on a device."""
        return NeighbourLists(
            starts=self.starts.to(device),
            indices=self.indices.to(device),
            distances=self.distances.to(device),
        )

    @property
    def queries(self) -> Int64[Tensor, "pairs"]:
        """The query of each pair: with `indices` the edges of a graph."""
        return torch.repeat_interleave(
            torch.arange(len(self), device=self.starts.device), self.counts
        )
