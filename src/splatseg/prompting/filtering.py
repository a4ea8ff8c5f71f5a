r"""Members far from the others are taken out (SAGA, section 3.5, statistical filtering).

With :math:`m_g` the mean distance of a Gaussian to the k nearest other members, and mean
:math:`\mu` and standard deviation :math:`\sigma` of these over all members,

.. math:: G' = \{ g \in G \;|\; m_g \le \mu + \sigma \}.

The paper takes :math:`k = \sqrt{|G|}`. Distances are linear, in the unit of the scene.
"""

import math
from dataclasses import dataclass

from jaxtyping import Bool
from torch import Tensor

from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import RangeError
from splatseg.neighbours import NeighbourIndex, Subset


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterOptions:
    """How members far from the others are told."""

    max_neighbours: int | None = 32
    """Most neighbours that a mean distance is of; there are the square root of the number of
    members. None for no such limit, as published."""

    deviations: float = 1.0
    """Standard deviations above the mean from which on a member is taken out; at least 0."""

    repeats: int = 1
    """Most times it is done, each time with what the time before left; at least 1."""

    min_deviation: float = 0.0
    """A standard deviation below this, in the unit of the scene, ends the repeating: nothing is
    far from the others any more. The published code has 0.1, with 5 repeats, in some notebooks."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.max_neighbours is not None and self.max_neighbours < 1:
            raise RangeError(f"max_neighbours: expected at least 1, got {self.max_neighbours}.")
        if self.repeats < 1:
            raise RangeError(f"repeats: expected at least 1, got {self.repeats}.")
        for name in ("deviations", "min_deviation"):
            value = getattr(self, name)
            if not 0 <= value < math.inf:
                raise RangeError(f"{name}: expected a finite number of at least 0, got {value}.")

    @classmethod
    def published(cls) -> "FilterOptions":
        """As the paper has it: neighbours without a limit, once."""
        return cls(max_neighbours=None)


@boundary
def statistical_filter(
    index: NeighbourIndex,
    members: Bool[Tensor, "n"],
    options: FilterOptions = FilterOptions(),
) -> Bool[Tensor, "n"]:
    """The members that are not far from the others.

    Args:
        index: Of the centres of all Gaussians.
        members: Which of them are selected.
        options: Neighbours, threshold and repeats.

    Returns:
        Some of the members; all of them if there are two or fewer.

    Raises:
        ShapeError: If `members` is not (n,).

    Example:
        >>> import torch
        >>> row = torch.tensor([[float(x), 0, 0] for x in (0, 1, 2, 3, 4, 5, 6, 7, 8, 40)])
        >>> statistical_filter(NeighbourIndex(row), torch.ones(10, dtype=torch.bool)).sum()
        tensor(9)
    """
    kept = members
    for _ in range(options.repeats):
        subset = Subset(index, kept)
        if len(subset) <= 2:
            return kept
        k = neighbour_count(len(subset), options.max_neighbours)
        distances = subset.mean_distances(k)
        among = distances[kept].double()
        deviation = float(among.std(correction=0))
        if deviation < options.min_deviation:
            return kept
        # The means are float32; so is the threshold, or equal means would be above their mean.
        limit = float(among.mean()) + options.deviations * deviation
        passed = distances <= limit * (1 + 1e-6)
        if int(passed.sum()) == len(subset):
            return kept
        kept = passed
    return kept


def neighbour_count(members: int, max_neighbours: int | None) -> int:
    """The square root of the number of members, rounded, within [1, `max_neighbours`]."""
    k = max(1, round(math.sqrt(members)))
    return k if max_neighbours is None else min(k, max_neighbours)
