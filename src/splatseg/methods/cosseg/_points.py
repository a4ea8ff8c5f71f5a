"""Which points the decoder is given, and what stands beside each of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatseg.core import Gaussians
from splatseg.core.rigid import upright
from splatseg.core.sh import base_colours
from splatseg.errors import InputError
from splatseg.lift.point_network import (
    PointEncoder,
    SpatialOptions,
    spatial_features,
)
from splatseg.methods.cosseg._fusion import FusionInputs, Scaling
from splatseg.methods.cosseg._options import Spatial


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointSet:
    """Some Gaussians as the decoder takes them."""

    inputs: FusionInputs
    rows: Int64[Tensor, "n"]
    """Row of each Gaussian of the scene among the points; -1 for those that are not there."""

    metres_per_unit: float | None = None
    """How positions were scaled for the point network; None where there is none."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointSource:
    """Makes point sets of a scene."""

    gaussians: Gaussians
    scales: Sequence[Float[Tensor, "n channels"]]
    """Distilled features, the shallowest block first; none where space is decoded alone."""

    encoder: PointEncoder | None
    """None where each Gaussian is decoded from its own features."""

    spatial: Spatial
    space: SpatialOptions
    """Scale and origin of the scene, the same for all its subsets: views and boxes."""

    up: tuple[float, float, float] | None
    seed: int

    def raw(self, chosen: Int64[Tensor, "m"]) -> "RawPoints":
        """What stands beside some Gaussians, not yet scaled.

        Raises:
            InputError: If there are too few for the levels of the point network.
        """
        if self.encoder is None:
            own = [scale[chosen] for scale in self.scales]
            return RawPoints(parts=(tuple(own),), up=(), chosen=chosen, metres_per_unit=None)
        gaussians = self.gaussians
        found = spatial_features(
            self.encoder,
            upright(gaussians.means.detach().cpu()[chosen], self.up),
            base_colours(gaussians.sh)[chosen],
            options=self.space,
            seed=self.seed,
        )
        pyramid = found.pyramid
        levels: list[tuple[Tensor, ...]] = []
        if self.spatial == "first":
            # What the widest neighbourhood says, brought down to the points themselves.
            last = found.levels[-1]
            for up in reversed(pyramid.up):
                last = last[up]
            own = [scale[chosen] for scale in self.scales[:1]]
            return RawPoints(
                parts=((last, *own),), up=(), chosen=chosen, metres_per_unit=found.metres_per_unit
            )
        for level, values in enumerate(found.levels):
            at = chosen[pyramid.kept[level]]
            own = [self.scales[level][at]] if level < len(self.scales) else []
            levels.append((values, *own))
        return RawPoints(
            parts=tuple(levels),
            up=pyramid.up,
            chosen=chosen,
            metres_per_unit=found.metres_per_unit,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RawPoints:
    """What stands beside points at each level, part by part."""

    parts: tuple[tuple[Float[Tensor, "n_l channels"], ...], ...]
    up: tuple[Int64[Tensor, "n_l"], ...]
    chosen: Int64[Tensor, "m"]
    metres_per_unit: float | None

    def scalings(self) -> tuple[tuple[Scaling, ...], ...]:
        """What brings each channel to mean 0 and variance 1 here."""
        return tuple(tuple(Scaling.of(part) for part in level) for level in self.parts)

    def scaled(self, scalings: Sequence[Sequence[Scaling]], count: int) -> PointSet:
        """The points of a scene of so many Gaussians, scaled."""
        levels = tuple(
            torch.cat([scaling(part) for scaling, part in zip(own, level, strict=True)], dim=1)
            for own, level in zip(scalings, self.parts, strict=True)
        )
        rows = torch.full((count,), -1, dtype=torch.int64)
        rows[self.chosen] = torch.arange(len(self.chosen))
        return PointSet(
            inputs=FusionInputs(levels=levels, up=self.up),
            rows=rows,
            metres_per_unit=self.metres_per_unit,
        )


def joined_blocks(raw: Sequence[RawPoints]) -> RawPoints:
    """Points of boxes that do not see each other, as one."""
    first = raw[0]
    levels = range(len(first.parts))
    starts = np.cumsum(
        [[0] * len(first.parts), *([len(p[0]) for p in one.parts] for one in raw)], 0
    )
    return RawPoints(
        parts=tuple(
            tuple(
                torch.cat([one.parts[level][part] for one in raw])
                for part in range(len(first.parts[level]))
            )
            for level in levels
        ),
        up=tuple(
            torch.cat([one.up[level] + int(starts[k][level + 1]) for k, one in enumerate(raw)])
            for level in range(len(first.up))
        ),
        chosen=torch.cat([one.chosen for one in raw]),
        metres_per_unit=first.metres_per_unit,
    )


def boxes(
    means: Float[Tensor, "n 3"], chosen: Int64[Tensor, "m"], most: int
) -> list[Int64[Tensor, "some"]]:
    """Points cut at medians of their longest sides until no box has more than `most`."""
    if len(chosen) <= most:
        return [chosen]
    points = means[chosen]
    axis = int((points.amax(dim=0) - points.amin(dim=0)).argmax())
    order = torch.argsort(points[:, axis], stable=True)
    half = len(chosen) // 2
    first, second = chosen[order[:half]].sort().values, chosen[order[half:]].sort().values
    return boxes(means, first, most) + boxes(means, second, most)


def check_decoded(kept: Bool[Tensor, "n"], min_pixels: int) -> Int64[Tensor, "m"]:
    """The Gaussians that are decoded.

    Raises:
        InputError: If there is none.
    """
    chosen = torch.nonzero(kept).squeeze(1)
    if not len(chosen):
        raise InputError(
            f"min_pixels: expected Gaussians in at least {min_pixels} pixels, got none of "
            f"{len(kept)}."
        )
    return chosen
