"""Questions about a subset of indexed points."""

import math

import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from splatseg._check import check_shape
from splatseg._native import Subset as NativeSubset
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, RangeError
from splatseg.neighbours._index import NeighbourIndex

MAX_EXTENT = 1e18
"""Largest magnitude of a coordinate: squared distances stay within float32."""


class Subset:
    r"""Some of the points of an index: their neighbours among each other, and what is near them.

    It takes its order from the index, so that making one costs a pass over the mask; the index is
    made once for a scene and kept. All answers are exact and do not depend on the number of
    threads; `neighbours.reference` has their definitions. Radii include their border, as those of
    `NeighbourIndex` do: :math:`d^2 \le r^2` in float64.

    Args:
        index: An index of points with three columns, of float32 or a narrower type.
        members: Which of its points belong to the subset.

    Raises:
        InputError: If the points have not three columns, or are of float64.
        RangeError: If a coordinate is beyond 1e18.
        ShapeError: If `members` is not (n,).

    Example:
        >>> points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [3, 0, 0], [4, 0, 0]])
        >>> ends = Subset(NeighbourIndex(points), torch.tensor([True, False, False, True]))
        >>> ends.mean_distances(1)
        tensor([4., nan, nan, 4.])
        >>> ends.near(1.0)
        tensor([True, True, True, True])
    """

    @boundary
    def __init__(self, index: NeighbourIndex, members: Bool[Tensor, "n"]) -> None:
        if index.dimensions != 3 or index.is_double:
            raise InputError(
                "index: expected points of three columns of float32, got "
                f"{index.dimensions} of {'float64' if index.is_double else 'float32'}."
            )
        if index.extent > MAX_EXTENT:
            raise RangeError(
                f"index: expected coordinates of at most {MAX_EXTENT:g} for a subset, got "
                f"{index.extent:g}."
            )
        self._index = index
        self._members = members
        self._native = NativeSubset(index.native, self._marks("members", members))

    def __len__(self) -> int:
        return self._native.count

    @property
    def members(self) -> Bool[Tensor, "n"]:
        """Which of the points belong to the subset."""
        return self._members

    @boundary
    def mean_distances(self, k: int) -> Float32[Tensor, "n"]:
        r"""Mean distance of each member to its k nearest other members.

        Distances are computed in float32 and are within a millionth of the exact ones; which
        members are nearest is decided exactly by these. Where there are fewer than k others, it
        is the mean over all of them; a member that is alone has 0.

        Args:
            k: How many, at least 1. With 1 it is the distance to the nearest.

        Returns:
            (n,) in the unit of the points; NaN for points that are not members.

        Raises:
            RangeError: If `k` is below 1.
        """
        if k < 1:
            raise RangeError(f"k: expected at least 1, got {k}.")
        means = torch.full((len(self._index),), math.nan)
        self._native.mean_distances(min(k, 2**31), means)
        return means.to(self._members.device)

    @boundary
    def near(self, radius: float, *, among: Bool[Tensor, "n"] | None = None) -> Bool[Tensor, "n"]:
        """The members, and the points within a radius of one: the subset, dilated by a ball.

        Args:
            radius: In the unit of the points, at least 0.
            among: Points that may be added; None for all.

        Raises:
            RangeError: If `radius` is negative or NaN.
            ShapeError: If `among` is not (n,).
        """
        marks = torch.zeros(len(self._index), dtype=torch.uint8)
        allowed = None if among is None else self._marks("among", among)
        self._native.near(self._index.native, allowed, _squared(radius), marks)
        return marks.view(torch.bool).to(self._members.device)

    @boundary
    def connected(self, seeds: Bool[Tensor, "n"], radius: float) -> Bool[Tensor, "n"]:
        """The members that seeds reach in steps from member to member.

        It is what dilating the seeds by the radius within the members comes to when it is
        repeated until nothing is added.

        Args:
            seeds: Where to start; those that are not members count for nothing.
            radius: Longest step, in the unit of the points, at least 0.

        Raises:
            RangeError: If `radius` is negative or NaN.
            ShapeError: If `seeds` is not (n,).
        """
        marks = torch.zeros(len(self._index), dtype=torch.uint8)
        start = self._marks("seeds", seeds)
        self._native.connected(start, _squared(radius), marks)
        return marks.view(torch.bool).to(self._members.device)

    def _marks(self, name: str, mask: Tensor) -> Tensor:
        check_shape(name, mask, (len(self._index),))
        return mask.detach().cpu().contiguous().view(torch.uint8)


def _squared(radius: float) -> float:
    if not radius >= 0:
        raise RangeError(f"radius: expected a distance of at least 0, got {radius}.")
    return radius * radius
