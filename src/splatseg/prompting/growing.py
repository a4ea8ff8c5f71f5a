r"""Selections grown in space (SAGA, section 3.5).

The radius is made of the distances of the members to the nearest of each other,

.. math:: d_g = \min_{g' \in G, g' \ne g} |x_g - x_{g'}|, \quad r = Q_q \{ d_g \},

their quantile q; the paper takes the largest (q = 1), which one stray member decides. All
distances are linear and in the unit of the scene: the published code compares squares with linear
ones (its k-NN returns squares, its ball query takes a radius).
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool
from torch import Tensor

from splatseg._check import check_range
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import RangeError
from splatseg.neighbours import NeighbourIndex, Subset

# Nearest distances are float32; their rounding does not decide what is as far as one of them.
_ROUNDING = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class GrowOptions:
    """How far a selection grows."""

    radius_quantile: float = 0.99
    """Which quantile of the members' nearest distances is the radius, in [0, 1]; 1 as published."""

    max_radius: float = math.inf
    """Largest radius, in the unit of the scene; above 0."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_range("radius_quantile", self.radius_quantile, 0.0, 1.0)
        if not self.max_radius > 0:
            raise RangeError(f"max_radius: expected a radius above 0, got {self.max_radius}.")

    @classmethod
    def published(cls) -> "GrowOptions":
        """As the paper has it: the largest of the nearest distances."""
        return cls(radius_quantile=1.0)


@boundary
def growth_radius(
    index: NeighbourIndex,
    members: Bool[Tensor, "n"],
    options: GrowOptions = GrowOptions(),
) -> float:
    """The radius that a selection grows by, in the unit of the scene.

    Returns:
        The quantile of the nearest distances: the smallest of them that this share of the members
        does not exceed. 0 if there are fewer than two members.

    Raises:
        ShapeError: If `members` is not (n,).
    """
    return _radius(Subset(index, members), options)


@boundary
def region_grow(
    index: NeighbourIndex,
    seeds: Bool[Tensor, "n"],
    candidates: Bool[Tensor, "n"],
    options: GrowOptions = GrowOptions(),
) -> Bool[Tensor, "n"]:
    """What validated seeds reach among candidates: region growing based filtering.

    Candidates within the radius of what is already reached are added until there are none.

    Args:
        index: Of the centres of all Gaussians.
        seeds: Gaussians known to belong, such as those that a mask validates.
        candidates: Gaussians that may belong, such as those retrieved by features.
        options: The radius, from the seeds' distances to each other.

    Returns:
        The seeds and the candidates reached.

    Raises:
        ShapeError: If `seeds` or `candidates` are not (n,).
    """
    radius = growth_radius(index, seeds, options)
    return Subset(index, seeds | candidates).connected(seeds, radius)


@boundary
def ball_grow(
    index: NeighbourIndex,
    members: Bool[Tensor, "n"],
    options: GrowOptions = GrowOptions(),
    *,
    among: Bool[Tensor, "n"] | None = None,
) -> Bool[Tensor, "n"]:
    """The members and every Gaussian in a ball around one: ball query based growing.

    Args:
        index: Of the centres of all Gaussians.
        members: The selection.
        options: The radius, from the members' distances to each other.
        among: Gaussians that may be added, such as those that no mask excludes; None for all.

    Raises:
        ShapeError: If `members` or `among` are not (n,).
    """
    subset = Subset(index, members)
    return subset.near(_radius(subset, options), among=among)


def _radius(subset: Subset, options: GrowOptions) -> float:
    if len(subset) < 2:
        return 0.0
    nearest = subset.mean_distances(1)[subset.members].cpu().numpy()
    rank = max(math.ceil(options.radius_quantile * len(nearest)), 1) - 1
    quantile = float(np.partition(nearest, rank)[rank])
    return min(quantile * (1 + _ROUNDING), options.max_radius)
