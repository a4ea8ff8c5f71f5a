r"""Labels of any point from the vertices of primitives around it: eq. 9 of the paper.

.. math:: \mathrm{sem}(x) = \arg\max_l \sum_{i \in B(x, r)} \sigma_i
          \frac{w_i}{\sum_j w_j} k_i(l), \qquad w_i = \frac{1}{\lVert x_i - x \rVert}

over the vertices :math:`x_i` within the radius r of x, with opacity :math:`\sigma_i` and
probabilities :math:`k_i` of classes, which do not depend on x and are known once for all. A point
that lies on a vertex takes that vertex alone, which is the limit; a point without a vertex in its
ball, or with none that is opaque, has no label. The paper asks the vertices "whose features have
been adjusted during training": which are given here is the caller's choice
(`street.field.VertexRule`).

References:
    DNMP with semantics (papers/002), section 3.2, eq. 9.
"""

import math

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg._check import check_finite, check_shape, check_values
from splatseg.core.boundary import boundary
from splatseg.errors import RangeError
from splatseg.neighbours import NeighbourIndex, ball_means

_POINTS = 65536
"""Points that are looked at together."""


class BallQuery:
    """Vertices with opacities and probabilities, arranged to be asked for labels of points.

    Args:
        vertices: World, scene units.
        opacity: Of each vertex, in [0, 1].
        probabilities: Of the classes at each vertex, not negative.
        radius: Of the ball around a point, its border included; scene units, positive.

    Raises:
        ShapeError: If there is not one opacity and one row of probabilities a vertex.
        RangeError: If a value is not finite or out of range, or the radius is not positive.

    Example:
        >>> vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0]])
        >>> query = BallQuery(vertices, torch.ones(2), torch.eye(2), radius=0.8)
        >>> query.columns(torch.tensor([[0.3, 0, 0], [0.7, 0, 0], [5, 0, 0]]))[0]
        tensor([ 0,  1, -1])
    """

    @boundary
    def __init__(
        self,
        vertices: Float[Tensor, "v 3"],
        opacity: Float[Tensor, "v"],
        probabilities: Float[Tensor, "v k"],
        *,
        radius: float,
    ) -> None:
        check_shape("opacity", opacity, (len(vertices),))
        check_values("opacity", opacity, 0.0, 1.0)
        check_shape("probabilities", probabilities, (len(vertices), None))
        check_values("probabilities", probabilities, 0.0, math.inf)
        check_finite("probabilities", probabilities)
        if not (math.isfinite(radius) and radius > 0):
            raise RangeError(f"radius: expected a positive length, got {radius}.")
        self._radius = radius
        self._index = NeighbourIndex(vertices)
        self._values = (opacity[:, None] * probabilities).detach().cpu().float().contiguous()

    @property
    def radius(self) -> float:
        """Of the ball, scene units."""
        return self._radius

    @boundary
    def scores(self, points: Float[Tensor, "p 3"]) -> Float[Tensor, "p k"]:
        """The sum of eq. 9 for every class, float32; 0 where no vertex is near.

        A row adds up to the mean opacity of the vertices around the point.

        Raises:
            ShapeError: If the points are not (p, 3).
            RangeError: If a point is not finite.
        """
        _check_points(points)
        means, _ = ball_means(self._index, self._values, points.detach().cpu(), self._radius)
        return means.float()

    @boundary
    def columns(
        self, points: Float[Tensor, "p 3"]
    ) -> tuple[Int64[Tensor, "p"], Float[Tensor, "p"]]:
        """The class of each point as a column of the probabilities, and how sure it is.

        Points are gone through in blocks, so that memory is needed for the answers only. Of equal
        classes it is the first.

        Returns:
            Columns, -1 where eq. 9 is undefined, and the winner's share of the sum, float32.

        Raises:
            ShapeError: If the points are not (p, 3).
            RangeError: If a point is not finite.
        """
        _check_points(points)
        columns = torch.full((len(points),), -1, dtype=torch.int64)
        shares = torch.zeros(len(points))
        if not self._values.shape[1]:
            return columns, shares
        for start in range(0, len(points), _POINTS):
            part = slice(start, start + _POINTS)
            scores = self.scores(points[part])
            total = scores.sum(dim=1)
            winner = scores.argmax(dim=1)
            best = scores.gather(1, winner[:, None])[:, 0]
            some = total > 0
            columns[part] = torch.where(some, winner, -1)
            shares[part] = torch.where(some, best / total.clamp_min(1e-30), 0.0).clamp(0, 1)
        return columns, shares


def _check_points(points: Tensor) -> None:
    check_shape("points", points, (None, 3))
    check_finite("points", points)
