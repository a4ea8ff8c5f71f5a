"""Which Gaussians stand for surfaces: opaque ones, no needles, and none that floats alone."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from splatseg._check import check_range
from splatseg.core import Gaussians
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, RangeError
from splatseg.neighbours import NeighbourIndex


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterOptions:
    """Which Gaussians are taken for surfaces. None leaves a rule out."""

    opaque_share: float | None = None
    """Share of the Gaussians that is kept by opacity, the most opaque first, in (0, 1]."""

    min_opacity: float | None = 0.1
    """Least opacity, in [0, 1]."""

    max_elongation: float | None = 30.0
    """Largest ratio of the largest scale to the second: above it a Gaussian is a needle. Flat ones
    are none."""

    scale_share: float | None = 0.995
    """Share of the Gaussians that is kept by their largest scale, the smallest first, in (0, 1]:
    what is blurred over much of the scene is no surface."""

    min_neighbours: int | None = 4
    """Least number of other centres that must lie near."""

    radius: float | None = None
    """How near, scene units. None takes ten times the median distance from a centre to the last of
    so many nearest others: fits put many centres onto one another."""

    def __post_init__(self) -> None:
        convert_fields(self)
        for name in ("opaque_share", "scale_share"):
            value = getattr(self, name)
            if value is not None and not 0 < value <= 1:
                raise RangeError(f"{name}: expected above 0 and at most 1, got {value}.")
        if self.min_opacity is not None:
            check_range("min_opacity", self.min_opacity, 0.0, 1.0)
        if self.max_elongation is not None and not self.max_elongation >= 1:
            raise RangeError(f"max_elongation: expected at least 1, got {self.max_elongation}.")
        if self.min_neighbours is not None and self.min_neighbours < 0:
            raise RangeError(f"min_neighbours: expected at least 0, got {self.min_neighbours}.")
        if self.radius is not None and not 0 < self.radius < float("inf"):
            raise RangeError(f"radius: expected above 0, got {self.radius}.")


_NEAREST_FACTOR = 10.0


@boundary
def surface_gaussians(
    gaussians: Gaussians, *, options: FilterOptions | None = None
) -> Bool[Tensor, "n"]:
    """Which Gaussians stand for surfaces.

    Args:
        gaussians: The Gaussians of the scene.
        options: The rules; a Gaussian must satisfy all of them. Density is that of what the
            other rules keep.

    Raises:
        InputError: If none does.
    """
    options = options or FilterOptions()
    opacities = gaussians.opacities.detach().cpu().reshape(-1)
    scales = gaussians.scales.detach().cpu().sort(dim=1, descending=True).values
    kept = torch.ones(len(opacities), dtype=torch.bool)
    if options.opaque_share is not None:
        kept &= _first(-opacities, options.opaque_share)
    if options.min_opacity is not None:
        kept &= opacities >= options.min_opacity
    if options.max_elongation is not None:
        kept &= scales[:, 0] <= options.max_elongation * scales[:, 1]
    if options.scale_share is not None:
        kept &= _first(scales[:, 0], options.scale_share)
    if options.min_neighbours and bool(kept.any()):
        kept[kept.clone()] = _dense(gaussians.means.detach().cpu()[kept], options)
    if not bool(kept.any()):
        raise InputError(
            f"gaussians: expected some that stand for surfaces, none of {len(kept)} does by the "
            "rules that were given."
        )
    return kept


def _first(values: Tensor, share: float) -> Bool[Tensor, "n"]:
    """The share of rows with the least values; of equals those that come first."""
    count = max(1, round(share * len(values)))
    kept = torch.zeros(len(values), dtype=torch.bool)
    kept[torch.argsort(values, stable=True)[:count]] = True
    return kept


def _dense(means: Tensor, options: FilterOptions) -> Bool[Tensor, "n"]:
    index = NeighbourIndex(means)
    radius = options.radius
    if radius is None:
        wanted = options.min_neighbours or 1
        if len(means) <= wanted:
            return torch.zeros(len(means), dtype=torch.bool)
        last = index.nearest_others(wanted).distances[:, -1]
        radius = _NEAREST_FACTOR * float(last.median())
    # A centre finds itself too.
    return index.count_within(means, radius) > (options.min_neighbours or 0)
