"""Where a splat scene is: its solid part, its middle, its bounds, and a level frame for it."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import Gaussians
from splatseg.errors import InputError

_SOLID = 0.1
_QUANTILE = 0.02
_LARGEST = 0.95


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Extent:
    """The robust extent of a scene in level axes: right, ahead, up."""

    world_from_level: Float[Tensor, "3 3"]
    """Rotation whose columns are the level axes in the world, float64."""

    centre: Float[Tensor, "3"]
    """Middle of the bounds, level axes."""

    half: Float[Tensor, "3"]
    """Half the size of the bounds, level axes."""

    solid: Float[Tensor, "m 3"]
    """Centres of Gaussians that are not faint, level axes."""

    mass: Float[Tensor, "n"]
    """How much each Gaussian matters: opacity times area, no single one too much; sums to 1."""

    @property
    def radius(self) -> float:
        """Half the diagonal of the bounds."""
        return float(torch.linalg.vector_norm(self.half))

    def world(self, points_level: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Points in world axes."""
        return points_level @ self.world_from_level.T


def extent_of(gaussians: Gaussians, up: tuple[float, float, float]) -> Extent:
    """Measure a scene, floaters and far splats left out.

    The bounds hold the middle 96 % of the centres of the Gaussians with an opacity of at least
    0.1 along each axis (of all, where fewer than fifty are that solid).

    Raises:
        InputError: If there is no Gaussian, or all are in one place.
    """
    if not len(gaussians):
        raise InputError("gaussians: expected at least one, got none.")
    rotation = level_axes(up)
    points = gaussians.means.detach().cpu().double() @ rotation
    solid = gaussians.opacities.detach().cpu() >= _SOLID
    if int(solid.sum()) < 50:
        solid = torch.ones_like(solid)
    kept = points[solid]
    ordered = kept.sort(dim=0).values
    last = len(kept) - 1
    low = ordered[round(_QUANTILE * last)]
    high = ordered[round((1 - _QUANTILE) * last)]
    size = gaussians.scales.detach().cpu().double()
    # A few Gaussians are a scene too, and a single one has the size of its own.
    pad = size[solid].median(dim=0).values.max()
    half = (high - low) / 2 + pad
    if not float(half.max()) > 0:
        raise InputError("gaussians: expected a scene with an extent, got all in one point.")
    area = size.sort(dim=1).values[:, 1:].prod(dim=1)
    largest = area[solid].sort().values[round(_LARGEST * last)]
    mass = gaussians.opacities.detach().cpu().double() * area.clamp_max(largest)
    inside = ((points - (low + high) / 2).abs() <= 1.5 * half).all(dim=1)
    mass = torch.where(inside, mass, torch.zeros_like(mass))
    return Extent(
        world_from_level=rotation,
        centre=(low + high) / 2,
        half=half.clamp_min(1e-3 * float(half.max())),
        solid=kept,
        mass=(mass / mass.sum().clamp_min(1e-30)).float(),
    )


def level_axes(up: tuple[float, float, float]) -> Float[Tensor, "3 3"]:
    """Rotation world_from_level whose last column is up.

    Raises:
        InputError: If up is no direction.
    """
    third = torch.tensor(up, dtype=torch.float64)
    length = float(torch.linalg.vector_norm(third))
    if not 0 < length < float("inf"):
        raise InputError(f"up: expected a direction, got {up}.")
    third = third / length
    # The axis of the world that is most level, so that results do not hang on rounding.
    helper = torch.zeros(3, dtype=torch.float64)
    helper[int(third.abs().argmin())] = 1.0
    second = torch.linalg.cross(third, helper)
    second = second / torch.linalg.vector_norm(second)
    return torch.stack((torch.linalg.cross(second, third), second, third), dim=1)
