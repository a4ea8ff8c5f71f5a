"""How the points of a network are fed: their unit, their origin and the range of colours."""

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Float, Float32
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_choice, check_finite, check_shape, check_values
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import RangeError

Origin = Literal["mean", "floor"]

MAX_METRES = 1e6
"""How far from the origin a point may be, so that float32 tells centimetres apart near it."""
_FLOOR = 0.01
"""Share of the points below the floor."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PointInputs:
    """What a network was trained on, so that it can be fed the same.

    Positions are in metres with z up. All implementations train on pieces of scenes, 40 960 or
    65 536 points that lie around one; a whole scene has larger coordinates than it saw.
    """

    grid_size: float
    """Side of the cells in which points were averaged, metres."""

    origin: Origin = "mean"
    """Where x, y, z are counted from: the mean of the points; or the mean in x and y and the floor
    in z, below which one point in a hundred lies."""

    colour_range: float = 1.0
    """What full red, green or blue is fed as: 1, or 255."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_choice("origin", self.origin, get_args(Origin))
        for name, most in (("grid_size", 1e3), ("colour_range", 255.0)):
            value = getattr(self, name)
            if not (math.isfinite(value) and 0 < value <= most):
                raise RangeError(f"{name}: expected above 0 and at most {most:g}, got {value}.")


@boundary
def points_origin(
    positions: Float[Tensor, "n 3"], *, inputs: PointInputs
) -> tuple[float, float, float]:
    """Where x, y, z of these points are counted from.

    Args:
        positions: Metres, z up, at least one point.
        inputs: What the network was trained on.

    Raises:
        ShapeError: If the positions are not (n, 3).
        RangeError: If a value is not finite, a point lies beyond 1000 km, or there is none.
    """
    points = _checked(positions)
    # NumPy's sums are the same on any number of threads.
    x, y, z = points.mean(axis=0).tolist()
    if inputs.origin == "floor":
        z = float(np.quantile(points[:, 2], _FLOOR))
    return x, y, z


@boundary
def feed_points(
    positions: Float[Tensor, "n 3"],
    colours: Float[Tensor, "n 3"] | None,
    *,
    inputs: PointInputs,
    origin: tuple[float, float, float] | None = None,
) -> tuple[Float32[Tensor, "n 3"], Float32[Tensor, "n channels"]]:
    """Positions and input channels of points as a network takes them.

    Args:
        positions: Metres, z up, at least one point.
        colours: Red, green and blue in [0, 1]; values beyond, which the colours of Gaussians may
            have, are cut off. None gives positions alone.
        inputs: What the network was trained on.
        origin: Of the coordinates, which spatial encodings read. Subsets of a scene, such as what
            single views show, need that of the scene; None takes `points_origin` of the points.

    Returns:
        Positions from the origin, for `point_pyramid`; and the 3 or 6 channels of each point,
        positions first.

    Raises:
        ShapeError: If positions or colours are not (n, 3).
        RangeError: If a value is not finite, a point lies beyond 1000 km, or there is none.
    """
    points = _checked(positions)
    if origin is None:
        origin = points_origin(positions, inputs=inputs)
    check_values("origin", torch.tensor(origin), -MAX_METRES, MAX_METRES)
    local = torch.from_numpy((points - origin).astype(np.float32))
    if colours is None:
        return local, local
    check_shape("colours", colours, (len(positions), 3))
    check_finite("colours", colours)
    fed = colours.detach().cpu().float().clamp(0, 1) * inputs.colour_range
    return local, torch.cat((local, fed), dim=1)


def _checked(positions: Tensor) -> NDArray[np.float64]:
    check_shape("positions", positions, (None, 3))
    check_values("positions", positions, -MAX_METRES, MAX_METRES)
    if not len(positions):
        raise RangeError("positions: expected at least one point, got none.")
    return positions.detach().cpu().double().numpy()
