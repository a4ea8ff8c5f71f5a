"""Points averaged in the cells of a grid, as networks of points are trained on."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64
from torch import Tensor

from splatseg._check import check_finite, check_shape, check_values
from splatseg.core.boundary import boundary
from splatseg.errors import RangeError

_MAX_CELL = 1e15
"""Number of a cell along an axis up to which float64 tells cells apart."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GridPoints:
    """One point for each cell that has some."""

    positions: Float64[Tensor, "m 3"]
    """The mean of the points of each cell, by cell in x, then y, then z."""

    colours: Float32[Tensor, "m 3"] | None
    """The mean of their colours."""


@boundary
def average_on_grid(
    positions: Float[Tensor, "n 3"], colours: Float[Tensor, "n 3"] | None, *, side: float
) -> GridPoints:
    r"""Average points in cells :math:`\lfloor p / s \rfloor` of a grid.

    So points are no denser in one place than in another, as in the scans that networks are
    trained on.

    Args:
        positions: In any unit.
        colours: Averaged in the same way.
        side: s, in the unit of the positions.

    Raises:
        ShapeError: If positions or colours are not (n, 3).
        RangeError: If a value is not finite, or the side is not above 0 or far too small.

    Example:
        >>> points = torch.tensor([[0.1, 0, 0], [0.3, 0, 0], [1.2, 0, 0]])
        >>> average_on_grid(points, None, side=1.0).positions[:, 0]
        tensor([0.2000, 1.2000], dtype=torch.float64)
    """
    check_shape("positions", positions, (None, 3))
    if not 0 < side < float("inf"):
        raise RangeError(f"side: expected above 0, got {side}.")
    points = positions.detach().cpu().double()
    check_values("positions", points, -_MAX_CELL * side, _MAX_CELL * side)
    if colours is not None:
        check_shape("colours", colours, (len(positions), 3))
        check_finite("colours", colours)
    if not len(points):
        return GridPoints(positions=points, colours=None if colours is None else colours.float())
    cells = np.floor(points.numpy() / side)
    order = np.lexsort(cells.T[::-1])
    changes = np.any(np.diff(cells[order], axis=0) != 0, axis=1)
    starts = np.concatenate(([0], np.flatnonzero(changes) + 1))
    counts = np.diff(starts, append=len(order))[:, None]

    def averaged(values: Tensor) -> Tensor:
        sums = np.add.reduceat(values.detach().cpu().double().numpy()[order], starts, axis=0)
        return torch.from_numpy(sums / counts)

    return GridPoints(
        positions=averaged(points), colours=None if colours is None else averaged(colours).float()
    )
