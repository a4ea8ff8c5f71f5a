"""The readable reference: every query against every point, in torch."""

import math

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from splatseg.neighbours._index import NeighbourLists, Neighbours, square_root


def squared_distances(
    queries: Float[Tensor, "m d"], points: Float[Tensor, "n d"]
) -> Float64[Tensor, "m n"]:
    """Squared distances in float64, a column after the other added up."""
    total = torch.zeros(len(queries), len(points), dtype=torch.float64)
    for query, point in zip(queries.double().T, points.double().T, strict=True):
        total += (query[:, None] - point) ** 2
    return total


def nearest(
    points: Float[Tensor, "n d"],
    queries: Float[Tensor, "m d"],
    k: int,
    *,
    max_distance: float = math.inf,
    own: Int64[Tensor, "m"] | None = None,
) -> Neighbours:
    """What `NeighbourIndex.nearest` finds, and with `own` `nearest_others`.

    Args:
        points: The indexed points.
        queries: The query positions.
        k: Number of neighbours.
        max_distance: Maximum distance of a neighbour.
        own: The point that each query excludes.
    """
    squared, order = _ordered(points, queries, max_distance, own)
    short = max(0, k - len(points))
    squared = torch.nn.functional.pad(squared, (0, short), value=math.inf)[:, :k]
    order = torch.nn.functional.pad(order, (0, short), value=-1)[:, :k]
    return Neighbours(
        indices=torch.where(squared.isinf(), -1, order), distances=square_root(squared)
    )


def within(
    points: Float[Tensor, "n d"],
    queries: Float[Tensor, "m d"],
    radius: float,
    *,
    max_neighbours: int | None = None,
    own: Int64[Tensor, "m"] | None = None,
) -> NeighbourLists:
    """What `NeighbourIndex.within` finds, and with `own` other points than these alone."""
    squared, order = _ordered(points, queries, radius, own)
    if max_neighbours is not None:
        squared, order = squared[:, :max_neighbours], order[:, :max_neighbours]
    found = squared.isfinite()
    starts = torch.zeros(len(queries) + 1, dtype=torch.int64)
    starts[1:] = found.sum(dim=1).cumsum(dim=0)
    return NeighbourLists(
        starts=starts, indices=order[found], distances=square_root(squared[found])
    )


def ball_means(
    points: Float[Tensor, "n 3"],
    values: Float[Tensor, "n c"],
    queries: Float[Tensor, "m 3"],
    radius: float,
) -> tuple[Float64[Tensor, "m c"], Int64[Tensor, "m"]]:
    """What `neighbours.ball_means` finds."""
    squared = squared_distances(queries, points)
    near = squared <= radius * radius
    exact = (squared == 0) & near
    weights = torch.where(exact.any(dim=1, keepdim=True), exact.double(), squared.rsqrt() * near)
    weights = torch.where(near, weights, 0.0)
    total = weights.sum(dim=1, keepdim=True)
    means = weights @ values.float().double() / total
    return torch.where(total > 0, means, 0.0), near.sum(dim=1)


def mean_distances(
    points: Float[Tensor, "n 3"], members: Bool[Tensor, "n"], k: int
) -> Float64[Tensor, "n"]:
    """What `Subset.mean_distances` finds, in float64."""
    chosen = points[members]
    squared = squared_distances(chosen, chosen)
    squared.fill_diagonal_(math.inf)
    others = min(k, len(chosen) - 1)
    means = torch.full((len(points),), math.nan, dtype=torch.float64)
    nearest_of = squared.sort(dim=1).values[:, : max(others, 0)]
    means[members] = nearest_of.sqrt().sum(dim=1) / max(others, 1)
    return means


def near(
    points: Float[Tensor, "n 3"],
    members: Bool[Tensor, "n"],
    radius: float,
    *,
    among: Bool[Tensor, "n"] | None = None,
) -> Bool[Tensor, "n"]:
    """What `Subset.near` finds."""
    close = (squared_distances(points, points[members]) <= radius * radius).any(dim=1)
    return members | (close if among is None else close & among)


def connected(
    points: Float[Tensor, "n 3"],
    members: Bool[Tensor, "n"],
    seeds: Bool[Tensor, "n"],
    radius: float,
) -> Bool[Tensor, "n"]:
    """What `Subset.connected` finds: dilation within the members, repeated."""
    reached = members & seeds
    while True:
        grown = near(points, reached, radius, among=members)
        if torch.equal(grown, reached):
            return reached
        reached = grown


def _ordered(
    points: Tensor, queries: Tensor, radius: float, own: Tensor | None
) -> tuple[Float64[Tensor, "m n"], Int64[Tensor, "m n"]]:
    """Squared distances, ascending, and the indices of the points; infinite where not found."""
    squared = squared_distances(queries, points)
    squared[squared > radius * radius] = math.inf
    if own is not None:
        squared[torch.arange(len(own)), own] = math.inf
    ordered = squared.sort(dim=1, stable=True)
    return ordered.values, ordered.indices
