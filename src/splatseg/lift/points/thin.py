"""Points thinned to cells of a grid: what is computed once for all points of a cell."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

_STEPS = 4096
"""Positions within a cell are rounded to so many steps, so that their sums are exact and no order
of the points changes a mean."""

_KEY_BITS = 21
"""Bits of a coordinate in a key: cells in each direction, 2^20 on either side of the origin."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Thinned:
    """The cells that points fall into, ordered by their coordinates, whatever the points' order."""

    centres: Float[Tensor, "n 3"]
    """Mean of the points of each cell, world, float64."""

    cell_of: Int[Tensor, "p"]
    """The cell of each point, int64."""

    hashes: Int[Tensor, "n"]
    """A number of each cell that depends on its coordinates alone, int64, not negative: the
    smallest ones are a random sample of the cells."""

    def __len__(self) -> int:
        return len(self.centres)


def thin(points: Float[Tensor, "p 3"], cell: float) -> Thinned:
    """Sort points into cells of a grid with a corner at the origin.

    Args:
        points: Positions in the world, scene units, finite.
        cell: Side of a cell, scene units, positive. Cells that are 2^20 or more from the origin
            share numbers with others on the far side.
    """
    scaled = points.detach().cpu().double().numpy() / cell
    corner = np.floor(scaled)
    inside = np.round((scaled - corner) * _STEPS).astype(np.int64)
    coordinates = corner.astype(np.int64)
    keys = packed_keys(coordinates)
    _, first, cell_of, counts = np.unique(
        keys, return_index=True, return_inverse=True, return_counts=True
    )
    cell_of = cell_of.reshape(-1)
    sums = np.zeros((len(counts), 3), dtype=np.int64)
    for axis in range(3):
        np.add.at(sums[:, axis], cell_of, inside[:, axis])
    means = coordinates[first] + sums / (counts[:, None] * _STEPS)
    return Thinned(
        centres=torch.from_numpy(means * cell),
        cell_of=torch.from_numpy(cell_of),
        hashes=torch.from_numpy(_mixed(keys[first])),
    )


def packed_keys(coordinates: NDArray[np.int64]) -> NDArray[np.int64]:
    """One int64 for integer coordinates (n, d), d at most 3, ordered as they are."""
    offset = 1 << (_KEY_BITS - 1)
    mask = (1 << _KEY_BITS) - 1
    keys = np.zeros(len(coordinates), dtype=np.int64)
    for axis in range(coordinates.shape[1]):
        keys = (keys << _KEY_BITS) | ((coordinates[:, axis] + offset) & mask)
    return keys


def _mixed(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """The finaliser of SplitMix64 (Steele et al. 2014): neighbouring keys become unlike numbers."""
    mixed = keys.astype(np.uint64)
    mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return ((mixed ^ (mixed >> np.uint64(31))) >> np.uint64(1)).astype(np.int64)
