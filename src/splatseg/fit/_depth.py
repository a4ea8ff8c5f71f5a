r"""Depth maps as a second teacher: the expected depth of a view is pulled to what was measured.

The loss of a view is

.. math:: \frac{\lambda}{m} \sum_p \left| \frac{s}{d(p)} - \frac{s}{D(p)} \right|

over the m pixels that have a measured depth D and are drawn (alpha at least 0.5); d is the
expected depth and s the median of D, so that the unit of length does not matter. Inverse depth
is what the 3DGS code regularises too: far things, whose depth is uncertain, count less.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatseg.core import Camera, View
from splatseg.errors import InputError
from splatseg.fit._options import FitOptions
from splatseg.io.depths import load_depth
from splatseg.render.warp import Warp, straightened

_FINAL_WEIGHT = 0.01
"""What is left of the weight at progress 1: at the end the photographs decide."""

_SOLID = 0.5
_NEAREST = 0.1
"""Drawn depths below this share of the median count as this share: the slope of 1 / d has no
bound, and one Gaussian before the lens would drown the rest."""

_ROUNDS = 10
_FEWEST = 20
"""Start points that a relative depth map must show to be aligned."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthLoss:
    """The depth loss of one rendering."""

    value: float
    gradient: Float[Tensor, "height width"]
    """Derivative of `value` with respect to the expected depth."""


class DepthMaps:
    """Depth maps of the training views, read when first asked for.

    Args:
        views: The training views; those without a depth map have no depth loss.
        points: Points on what is shown, which relative maps are aligned to.
        options: ``metric`` maps hold z-depth. ``relative`` ones hold inverse depth up to a scale
            and a shift of each view, as networks that see one photograph give it; median and
            mean deviation of the points in view settle the two (see `aligned_inverse`).
        where: Messages begin with it.

    Raises:
        InputError: If no view has a depth map, or relative maps have no points to align to.
    """

    def __init__(
        self,
        views: Sequence[View],
        *,
        points: Float[Tensor, "n 3"] | None,
        options: FitOptions,
        where: str,
    ) -> None:
        if not any(view.depth is not None for view in views):
            raise InputError(
                f"{where}: expected depth maps of training views, as depth supervision "
                "needs them, got none."
            )
        self._views = tuple(views)
        self._relative = options.depth == "relative"
        self._weight = options.depth_weight
        self._points: Tensor | None = None
        if self._relative:
            if points is None or len(points) == 0:
                raise InputError(
                    f"{where}: expected start points to align relative depth maps to, got none."
                )
            self._points = points
        self._kept: dict[int, tuple[Tensor, float] | None] = {}

    def loss(
        self,
        index: int,
        depth: Float[Tensor, "height width"],
        alpha: Float[Tensor, "height width"],
        *,
        progress: float,
        mask: Bool[Tensor, "height width"] | None = None,
    ) -> DepthLoss | None:
        """The loss of a view's expected depth; None where the view has no depth map.

        Both are read at the coarser of the two resolutions, without interpolation: between a
        thing and what is behind it there is no depth.

        Args:
            index: Which training view.
            depth: The rendering's expected depth, of any reduction.
            alpha: Its alpha.
            progress: The weight falls exponentially with it.
            mask: Pixels that count; None is all.
        """
        known = self._map(index)
        if known is None:
            return None
        inverse, scale = known
        rows, map_rows = _common(depth.shape[0], inverse.shape[0])
        columns, map_columns = _common(depth.shape[1], inverse.shape[1])
        drawn = depth.detach()[rows][:, columns]
        goal = inverse[map_rows][:, map_columns].to(drawn)
        counts = (goal > 0) & (alpha.detach()[rows][:, columns] >= _SOLID)
        if mask is not None:
            counts &= mask[rows][:, columns]
        weight = self._weight * _FINAL_WEIGHT**progress / max(1, int(counts.sum()))
        bounded = drawn.clamp_min(_NEAREST * scale)
        difference = torch.where(counts, scale / bounded - scale * goal, 0.0)
        slope = -weight * difference.sign() * scale / bounded.square()
        gradient = torch.zeros_like(depth)
        gradient[rows.unsqueeze(1), columns] = slope
        return DepthLoss(value=weight * float(difference.abs().sum()), gradient=gradient)

    def _map(self, index: int) -> tuple[Tensor, float] | None:
        """Inverse depth in one over scene units (0 is unknown) and the median depth."""
        if index not in self._kept:
            view = self._views[index]
            self._kept[index] = None if view.depth is None else self._read(view)
        return self._kept[index]

    def _read(self, view: View) -> tuple[Tensor, float] | None:
        values = load_depth(view)
        if not view.camera.is_pinhole:
            values = _straight(values, view.camera)
        if self._points is None:
            inverse = torch.where(values > 0, 1 / values.clamp_min(1e-12), 0.0)
        else:
            aligned = aligned_inverse(values, view.camera, self._points)
            if aligned is None:
                return None
            inverse = aligned
        known = inverse[inverse > 0]
        return (inverse, float(1 / known.median())) if len(known) else None


def aligned_inverse(
    values: Float[Tensor, "rows columns"], camera: Camera, points: Float[Tensor, "n 3"]
) -> Float[Tensor, "rows columns"] | None:
    """A relative map as inverse depth, by the points that its view shows.

    The line through medians and mean absolute deviations of both, as the 3DGS code has it; then
    some rounds of least squares over the points that were nearest to the line, the nearer half,
    because the others may be hidden. None where fewer than 20 points are in view, or the map is
    flat.
    """
    straight = straightened(camera)
    at, z = straight.project(points.double())
    size = at.new_tensor([straight.width, straight.height])
    inside = (z > 0) & (at >= 0).all(dim=1) & (at < size).all(dim=1)
    cell = at[inside] / size * at.new_tensor([values.shape[1], values.shape[0]])
    column, row = cell.long().unbind(1)
    seen = values[row, column].double()
    wanted = 1 / z[inside][seen > 0]
    seen = seen[seen > 0]
    if len(seen) < _FEWEST:
        return None
    middle, goal = seen.median(), wanted.median()
    spread = (seen - middle).abs().mean()
    if float(spread) <= 0:
        return None
    scale = (wanted - goal).abs().mean() / spread
    for _ in range(_ROUNDS):
        off = ((seen - middle) * scale + goal - wanted).abs()
        near = off <= off.median()
        middle, goal = seen[near].mean(), wanted[near].mean()
        across = seen[near] - middle
        if float(across.square().sum()) <= 0:
            return None
        scale = (across * (wanted[near] - goal)).sum() / across.square().sum()
    inverse = ((values.double() - middle) * scale + goal).float()
    return torch.where(values > 0, inverse.clamp_min(0), 0.0)


def _straight(values: Tensor, camera: Camera) -> Tensor:
    """A distorted photograph's depth map in the pixels of its straight image, nearest.

    Depth along the axis does not depend on the lens.
    """
    lens = camera.resized(values.shape[1], values.shape[0])
    pinhole = straightened(lens)
    return Warp.between(pinhole, lens, "nearest").apply(values.unsqueeze(-1)).squeeze(-1)


def _common(size: int, other: int) -> tuple[Tensor, Tensor]:
    """Indices into two rows of pixels that cover the same, at the coarser resolution."""
    count = min(size, other)
    step = torch.arange(count)
    return step * size // count, step * other // count
