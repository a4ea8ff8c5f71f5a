"""What a search finds."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64
from torch import Tensor

from splatseg._check import check_finite, check_shape, check_values
from splatseg._native import NeighbourIndex as NativeIndex
from splatseg._native import Subset as NativeSubset
from splatseg.core import Gaussians
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, RangeError, ShapeError


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


# The index that searches are made in.


MAX_DIMENSIONS = 8
"""Columns that points may have."""

MAX_COORDINATE = 1e150
"""Largest magnitude of a coordinate: squares of differences must not overflow float64."""

MAX_PAIRS = 100_000_000
"""Pairs that a radius search returns by default: 1.6 GB."""


class NeighbourIndex:
    r"""Points, arranged to be searched: the k nearest, and all within a radius.

    Answers are those of comparing a query q with every point p. Distances are computed in float64
    from coordinates as they are (float32 and narrower types are widened, which is exact),

    .. math:: d^2 = ((q_0 - p_0)^2 + (q_1 - p_1)^2) + (q_2 - p_2)^2 + \ldots

    in this order of additions, and points are ordered by :math:`d^2`, equal ones by index. A
    radius includes its border: :math:`d^2 \le r^2`, both in float64. So answers do not depend on
    the number of threads, nor on what else is asked for.

    Points are copied. Besides them and the answer, memory is needed for about 60 bytes a point
    (three columns) and, while a search runs, 20 MB at most.

    Args:
        points: (n, d) with d from 1 to 8, any n, or Gaussians, of which the centres are meant.

    Raises:
        ShapeError: If the points are not (n, d).
        RangeError: If a coordinate is not finite, or beyond 1e150.
        InputError: If they are not of a floating-point type.

    Example:
        >>> index = NeighbourIndex(torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 0, 0], [5, 0, 0]]))
        >>> index.nearest(torch.tensor([[0.9, 0.0, 0.0]]), 2).indices
        tensor([[1, 2]])
        >>> index.nearest_others(1).indices[:, 0]
        tensor([1, 2, 1, 1])
    """

    @boundary
    def __init__(self, points: Float[Tensor, "n d"] | Gaussians) -> None:
        given = points.means if isinstance(points, Gaussians) else points
        if given.ndim != 2 or not 1 <= given.shape[1] <= MAX_DIMENSIONS:
            raise ShapeError(
                f"points: expected shape (any, 1 to {MAX_DIMENSIONS}), got {tuple(given.shape)}."
            )
        self._device = given.device
        self._shape = tuple(given.shape)
        wide = _coordinates("points", given)
        self._is_double = given.dtype == torch.float64
        self._extent = float(wide.abs().amax()) if wide.numel() else 0.0
        self._native = NativeIndex(wide)

    def __len__(self) -> int:
        return self._shape[0]

    @property
    def dimensions(self) -> int:
        """How many coordinates a point has."""
        return self._shape[1]

    @property
    def is_double(self) -> bool:
        """Whether the points came as float64."""
        return self._is_double

    @property
    def extent(self) -> float:
        """The largest magnitude of a coordinate."""
        return self._extent

    @property
    def native(self) -> NativeIndex:
        """What the kernels search in."""
        return self._native

    @property
    def nbytes(self) -> int:
        """Memory that the index takes, bytes."""
        return self._native.nbytes

    def nearest(
        self, queries: Float[Tensor, "m d"], k: int, *, max_distance: float = math.inf
    ) -> Neighbours:
        """The k nearest points of each query.

        Args:
            queries: Positions, in the unit and frame of the points. One of the points finds
                itself; see `nearest_others`.
            k: How many, at least 1; may be more than there are points.
            max_distance: Points farther than this are not found; at least 0.

        Returns:
            Indices and distances (m, k) on the device of `queries`.

        Raises:
            ShapeError: If `queries` is not (m, d).
            RangeError: If `k` or `max_distance` is out of range, or a query is not finite.
            InputError: If the queries are not of a floating-point type.
        """
        return self._nearest(self._queries(queries), None, k, max_distance, queries.device)

    def nearest_others(
        self,
        k: int,
        *,
        rows: Int64[Tensor, "m"] | None = None,
        max_distance: float = math.inf,
    ) -> Neighbours:
        """The k nearest other points of points of the index.

        A point leaves itself out by its index: others in the same position are found.

        Args:
            k: How many, at least 1; may be more than there are other points.
            rows: Indices of the points that ask; None for all, in their order.
            max_distance: Points farther than this are not found; at least 0.

        Returns:
            Indices and distances (m, k) on the device of the points.

        Raises:
            ShapeError: If `rows` is not (m,).
            RangeError: If `k`, `max_distance` or a row is out of range.
            InputError: If `rows` are no integers.
        """
        return self._nearest(None, self._rows(rows), k, max_distance, self._device)

    def count_within(self, queries: Float[Tensor, "m d"], radius: float) -> Int64[Tensor, "m"]:
        """How many points lie within a radius of each query.

        Args:
            queries: Positions, in the unit and frame of the points. One of the points counts
                itself.
            radius: In the unit of the points, at least 0.

        Raises:
            ShapeError: If `queries` is not (m, d).
            RangeError: If `radius` is negative or NaN, or a query is not finite.
            InputError: If the queries are not of a floating-point type.
        """
        return self._counts(self._queries(queries), radius).to(queries.device)

    def within(
        self,
        queries: Float[Tensor, "m d"],
        radius: float,
        *,
        max_neighbours: int | None = None,
        max_pairs: int = MAX_PAIRS,
    ) -> NeighbourLists:
        """All points within a radius of each query.

        Args:
            queries: Positions, in the unit and frame of the points. One of the points finds
                itself.
            radius: In the unit of the points, at least 0.
            max_neighbours: Only the nearest so many of each query, at least 1; None for all.
            max_pairs: More than so many pairs of a query and a point, 16 bytes each, are
                refused before memory is taken for them. Ask in blocks of queries then.

        Returns:
            Sparse rows on the device of `queries`.

        Raises:
            ShapeError: If `queries` is not (m, d).
            RangeError: If an argument is out of range, or a query is not finite.
            InputError: If the queries are not of a floating-point type, or there are more than
                `max_pairs` pairs.
        """
        asked = self._queries(queries)
        if max_neighbours is not None:
            _check_count("max_neighbours", max_neighbours)
        counts = self._counts(asked, radius)
        if max_neighbours is not None:
            counts = counts.clamp_max(max_neighbours)
        starts = torch.zeros(len(counts) + 1, dtype=torch.int64)
        torch.cumsum(counts, dim=0, out=starts[1:])
        pairs = int(starts[-1])
        if pairs > max_pairs:
            raise InputError(
                f"radius: expected at most {max_pairs} pairs of a query and a point within it "
                f"(max_pairs), got {pairs} within {radius:g}; ask for a smaller radius, or give "
                "max_neighbours."
            )
        indices = torch.empty(pairs, dtype=torch.int64)
        squared = torch.empty(pairs, dtype=torch.float64)
        self._native.within(asked, None, radius * radius, starts, indices, squared)
        found = NeighbourLists(starts=starts, indices=indices, distances=square_root(squared))
        return found.to(queries.device)

    def _nearest(
        self,
        queries: Tensor | None,
        rows: Tensor | None,
        k: int,
        max_distance: float,
        device: torch.device,
    ) -> Neighbours:
        _check_count("k", k)
        _check_distance("max_distance", max_distance)
        asked = queries if queries is not None else rows
        count = len(self) if asked is None else len(asked)
        indices = torch.empty(count, k, dtype=torch.int64)
        squared = torch.empty(count, k, dtype=torch.float64)
        self._native.nearest(queries, rows, max_distance * max_distance, indices, squared)
        return Neighbours(indices=indices.to(device), distances=square_root(squared).to(device))

    def _counts(self, queries: Tensor, radius: float) -> Tensor:
        _check_distance("radius", radius)
        counts = torch.empty(len(queries), dtype=torch.int64)
        self._native.count_within(queries, None, radius * radius, counts)
        return counts

    def _queries(self, queries: Tensor) -> Tensor:
        check_shape("queries", queries, (None, self.dimensions))
        return _coordinates("queries", queries)

    def _rows(self, rows: Tensor | None) -> Tensor | None:
        if rows is None:
            return None
        check_shape("rows", rows, (None,))
        if rows.is_floating_point() or rows.is_complex() or rows.dtype == torch.bool:
            raise InputError(f"rows: expected integers, got {rows.dtype}.")
        chosen = rows.detach().cpu().long().contiguous()
        if len(chosen) and not 0 <= int(chosen.min()) <= int(chosen.max()) < len(self):
            raise RangeError(
                f"rows: expected indices in [0, {len(self)}), got "
                f"[{int(chosen.min())}, {int(chosen.max())}]."
            )
        return chosen


def _coordinates(name: str, values: Tensor) -> Tensor:
    """Checked, as rows of float64 on the CPU."""
    if not values.is_floating_point():
        raise InputError(f"{name}: expected a floating-point type, got {values.dtype}.")
    wide = values.detach().cpu().double().contiguous()
    check_values(name, wide, -MAX_COORDINATE, MAX_COORDINATE)
    return wide


def _check_count(name: str, count: int) -> None:
    if count < 1:
        raise RangeError(f"{name}: expected at least 1, got {count}.")


def _check_distance(name: str, distance: float) -> None:
    if not distance >= 0:
        raise RangeError(f"{name}: expected a distance of at least 0, got {distance}.")


# Means of values over balls, weighted by inverse distance, without a list of pairs.


@boundary
def ball_means(
    index: NeighbourIndex,
    values: Float[Tensor, "n c"],
    queries: Float[Tensor, "m 3"],
    radius: float,
) -> tuple[Float64[Tensor, "m c"], Int64[Tensor, "m"]]:
    r"""Inverse-distance weighted means of values of the points in a ball around each query.

    .. math:: m(q) = \frac{\sum_i w_i v_i}{\sum_i w_i}, \qquad
              w_i = \frac{1}{\lVert p_i - q \rVert}, \qquad \lVert p_i - q \rVert \le r

    Points exactly at the query have all the weight, in equal parts: the limit. Values are taken
    as float32, sums are float64, in an order that depends on the index and the query alone.

    Args:
        index: Of points with three columns.
        values: A row for each of its points, finite.
        queries: Positions, in the unit and frame of the points.
        radius: Of the ball, its border included; at least 0.

    Returns:
        The means, 0 where no point is in the ball, and how many points were in it.

    Raises:
        ShapeError: If there is not a row for each point, or queries are not (m, 3).
        RangeError: If the radius is negative or NaN, or a value or query is not finite.
        InputError: If the index has not three columns.
    """
    if index.dimensions != 3:
        raise InputError(f"index: expected points of three columns, got {index.dimensions}.")
    check_shape("values", values, (len(index), None))
    check_finite("values", values)
    check_shape("queries", queries, (None, 3))
    if not radius >= 0:
        raise RangeError(f"radius: expected a distance of at least 0, got {radius}.")
    asked = queries.detach().cpu().double().contiguous()
    if len(asked) and not bool((asked.abs() <= MAX_COORDINATE).all()):
        raise RangeError(f"queries: expected coordinates of at most {MAX_COORDINATE:g}.")
    means = torch.empty(len(asked), values.shape[1], dtype=torch.float64)
    counts = torch.empty(len(asked), dtype=torch.int64)
    rows = values.detach().cpu().float().contiguous()
    index.native.ball_means(asked, radius * radius, rows, means, counts)
    return means.to(queries.device), counts.to(queries.device)


# Questions about a subset of indexed points.


MAX_EXTENT = 1e18
"""Largest magnitude of a coordinate: squared distances stay within float32."""


class Subset:
    r"""Some of the points of an index: their neighbours among each other, and what is near them.

    It takes its order from the index, so that making one costs a pass over the mask; the index is
    made once for a scene and kept. All answers are exact and do not depend on the number of
    threads. Radii include their border, as those of `NeighbourIndex` do:
    :math:`d^2 \le r^2` in float64.

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
