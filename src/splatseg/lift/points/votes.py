r"""Votes of views at points: the label of the pixel where a point is seen.

A view votes at the points x that it shows, with the label c of the pixel that x projects to:

.. math:: v_c(x) = \sum_{j:\; z_j(x) \le (1 + \rho)\, D_j(x) + \tau}
                   \min\!\left(1, \frac{r}{z_j(x)}\right) [L_j(x) = c]

with z the z-depth of the point in view j, D the median depth of what the field shows in its pixel
and L the field's label map there. What lies before the surface is seen, so that a surface that
the field has too far away loses no points; what lies behind it by more than the tolerance is not.
Far views, whose pixels cover more of the world, count less.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg.core import Camera
from splatseg.lift.points.sight import seen_points

_NEAR = 1e-3
"""z-depth, as a part of the length in which views count in full, below which nothing is seen."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenView:
    """What a view of a field shows: labels, and where."""

    camera: Camera

    columns: Int[Tensor, "height width"]
    """Columns of the table of votes, -1 where there is no label."""

    depth: Float[Tensor, "height width"]
    """Median z-depth, scene units, 0 where nothing is."""


def view_votes(
    views: Iterable[SeenView],
    points: Float[Tensor, "n 3"],
    labels: int,
    *,
    tolerance: float,
    relative_tolerance: float,
    full_distance: float,
) -> Float[Tensor, "n c"]:
    """How many views vote for each label at each point, far ones less.

    Args:
        views: What they show, in the order in which votes are summed.
        points: World, scene units.
        labels: Columns of the table.
        tolerance: Tau, scene units.
        relative_tolerance: Rho.
        full_distance: r, up to where a view's vote counts 1, scene units.
    """
    votes = torch.zeros(len(points), labels)
    flat = votes.view(-1)
    at = points.double()
    for view in views:
        seen = seen_points(
            at,
            view.camera,
            view.depth,
            tolerance=tolerance,
            relative_tolerance=relative_tolerance,
            near=_NEAR * full_distance,
        )
        label = view.columns[seen.rows, seen.columns].long()
        named = label >= 0
        weight = (full_distance / seen.depth[named]).clamp_max(1).float()
        # A view names each point once, so that nothing is added twice to one number.
        flat[seen.points[named] * labels + label[named]] += weight
    return votes
