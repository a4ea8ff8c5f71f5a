"""Means of values over balls, weighted by inverse distance, without a list of pairs."""

import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, RangeError
from splatseg.neighbours._index import MAX_COORDINATE, NeighbourIndex


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
