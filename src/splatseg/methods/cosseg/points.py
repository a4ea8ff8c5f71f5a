"""What stands beside each Gaussian that is decoded: features of a frozen encoder, and of blocks.

Published networks are evaluated on pieces of 40 960 points around one; here all points of a set are
encoded at once, as CoSSegGaussians does with what a view sees. The encoder takes z for up, and
reads coordinates: the origin and the scale are those of the scene, for all of its subsets.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.core import Gaussians
from splatseg.core.rigid import upright
from splatseg.core.sh import base_colours
from splatseg.errors import InputError, RangeError
from splatseg.lift.training import TensorBudget
from splatseg.methods.cosseg.checkpoint import PointEncoder
from splatseg.methods.cosseg.options import Spatial
from splatseg.methods.cosseg.pyramid import (
    MAX_METRES,
    PointPyramid,
    feed_points,
    point_pyramid,
    points_origin,
)
from splatseg.neighbours import NeighbourIndex

_SPACING_SAMPLE = 20_000
"""Points of which the spacing is measured."""

_CONSTANT = 1e-6
"""Deviation below which a channel is constant."""

_LARGEST = 60000.0
"""What float16 holds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpatialFrame:
    """How the points of a scene are brought before an encoder."""

    metres_per_unit: float
    """Metres that a unit of the positions is."""

    origin: tuple[float, float, float]
    """Where x, y, z are counted from, metres."""

    is_scale_assumed: bool
    """Whether the scale was not known, and is such that half of the points have another one within
    the side of the grid that the encoder was trained with."""


def spatial_frame(
    encoder: PointEncoder,
    positions: Float[Tensor, "n 3"],
    *,
    metres_per_unit: float | None,
    seed: int,
) -> SpatialFrame:
    """The scale and the origin of a scene.

    Args:
        encoder: Of `load_point_encoder`.
        positions: All points of the scene, z up.
        metres_per_unit: None, where that is not known, tells it by how dense the points are.
        seed: Of the points by which it is told.

    Raises:
        RangeError: If the scene, in metres, is too large.
        InputError: If points lie on each other so that the scale cannot be told.
    """
    points = positions.detach().cpu().double()
    scale = metres_per_unit or encoder.inputs.grid_size / _spacing(points, seed)
    origin = points_origin(_in_metres(points, scale), inputs=encoder.inputs)
    return SpatialFrame(
        metres_per_unit=scale, origin=origin, is_scale_assumed=metres_per_unit is None
    )


def spatial_features(
    encoder: PointEncoder,
    positions: Float[Tensor, "n 3"],
    colours: Float[Tensor, "n 3"],
    *,
    frame: SpatialFrame,
    seed: int,
) -> tuple[PointPyramid, tuple[Float[Tensor, "n_l channels"], ...]]:
    """Features of points by a frozen encoder, fed as it was trained.

    Args:
        encoder: Of `load_point_encoder`.
        positions: Points, of any unit and origin, z up.
        colours: Red, green and blue of each in [0, 1]; values beyond are cut off, and none is read
            where the encoder takes none.
        frame: Of the scene.
        seed: Of the random sampling.

    Returns:
        The points and their samples, and features as `RandlaEncoder.forward` returns them, float16.

    Raises:
        RangeError: If the points are too far apart, or features beyond float16.
        InputError: If there are too few points for its levels.
    """
    metres = _in_metres(positions.detach().cpu().double(), frame.metres_per_unit)
    given = colours if encoder.colour else None
    local, channels = feed_points(metres, given, inputs=encoder.inputs, origin=frame.origin)
    pyramid = point_pyramid(local, options=encoder.config, seed=seed)
    with torch.no_grad():
        levels = encoder.encoder(pyramid, channels)
    return pyramid, tuple(_halved(level) for level in levels)


def _in_metres(points: Tensor, scale: float) -> Tensor:
    metres = points * scale
    farthest = float(metres.abs().max()) if len(metres) else 0.0
    if not farthest <= MAX_METRES:
        raise RangeError(
            f"positions: expected a scene of at most {MAX_METRES:g} metres, got {farthest:g} with "
            f"{scale:g} metres a unit."
        )
    return metres


def _spacing(points: Tensor, seed: int) -> float:
    """The median distance from a point to the nearest other one."""
    if len(points) < 2:
        raise InputError(
            f"positions: expected at least 2 points to tell their scale by, got {len(points)}."
        )
    asked = np.random.default_rng(seed).permutation(len(points))[:_SPACING_SAMPLE]
    found = NeighbourIndex(points).nearest_others(1, rows=torch.from_numpy(np.sort(asked)))
    spacing = float(found.distances.median())
    if spacing == 0:
        raise InputError(
            "metres_per_unit: half of the points lie on another one, so the scale cannot be told "
            "from how dense they are; give it."
        )
    return spacing


def _halved(level: Tensor) -> Tensor:
    half = level.half()
    if not bool(torch.isfinite(half).all()):
        raise RangeError(
            f"encoder: expected features that float16 holds, got {float(level.abs().max()):g}."
        )
    return half


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FusionInputs:
    """What the decoder is given of a set of points; nothing in it is learnt."""

    levels: tuple[Float[Tensor, "n_l channels"], ...]
    """Per level, spatial encoding and distilled feature of each of its points, side by side;
    float16 or float32. One level: nothing is decoded from above."""

    up: tuple[Int64[Tensor, "n_l"], ...]
    """For each level but the last, the row of the nearest point of the next."""

    @property
    def widths(self) -> tuple[int, ...]:
        """Channels of each level."""
        return tuple(level.shape[1] for level in self.levels)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scaling:
    """What brings channels to mean 0 and variance 1."""

    mean: Float[Tensor, "channels"]
    scale: Float[Tensor, "channels"]

    @classmethod
    def of(cls, values: Float[Tensor, "n channels"]) -> "Scaling":
        """That of some rows; a constant channel becomes 0."""
        # NumPy's sums are the same on any number of threads.
        numbers = values.float().numpy()
        mean = numbers.mean(axis=0, dtype=np.float64)
        deviation = numbers.std(axis=0, dtype=np.float64)
        scale = np.divide(1.0, deviation, out=np.zeros_like(deviation), where=deviation > _CONSTANT)
        return cls(mean=torch.from_numpy(mean).float(), scale=torch.from_numpy(scale).float())

    def __call__(self, values: Float[Tensor, "n channels"]) -> Float[Tensor, "n channels"]:
        """The values scaled, in float16."""
        return ((values.float() - self.mean) * self.scale).clamp_(-_LARGEST, _LARGEST).half()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointSet:
    """Some Gaussians as the decoder takes them."""

    inputs: FusionInputs
    rows: Int64[Tensor, "n"]
    """Row of each Gaussian of the scene among the points; -1 for those that are not there."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RawPoints:
    """What stands beside points at each level, part by part, not yet scaled."""

    parts: tuple[tuple[Float[Tensor, "n_l channels"], ...], ...]
    up: tuple[Int64[Tensor, "n_l"], ...]
    chosen: Int64[Tensor, "m"]

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
        return PointSet(inputs=FusionInputs(levels=levels, up=self.up), rows=rows)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointSource:
    """Makes point sets of a scene."""

    gaussians: Gaussians
    scales: Sequence[Float[Tensor, "n channels"]]
    """Distilled features, the shallowest block first; none where space is decoded alone."""

    encoder: PointEncoder | None = None
    """None where each Gaussian is decoded from its own features."""

    frame: SpatialFrame | None = None
    """Of the scene, where there is an encoder."""

    spatial: Spatial
    up: tuple[float, float, float] | None
    seed: int

    def raw(self, chosen: Int64[Tensor, "m"]) -> RawPoints:
        """What stands beside some Gaussians.

        Raises:
            InputError: If there are too few for the levels of the point network.
        """
        if self.encoder is None or self.frame is None:
            own = tuple(scale[chosen] for scale in self.scales)
            return RawPoints(parts=(own,), up=(), chosen=chosen)
        pyramid, levels = spatial_features(
            self.encoder,
            upright(self.gaussians.means.detach().cpu()[chosen], self.up),
            base_colours(self.gaussians.sh)[chosen],
            frame=self.frame,
            seed=self.seed,
        )
        if self.spatial == "first":
            # What the widest neighbourhood says, brought down to the points themselves.
            last = levels[-1]
            for up in reversed(pyramid.up):
                last = last[up]
            own = (scale[chosen] for scale in self.scales[:1])
            return RawPoints(parts=((last, *own),), up=(), chosen=chosen)
        parts = tuple(
            (values, *(scale[chosen[kept]] for scale in self.scales[level : level + 1]))
            for level, (values, kept) in enumerate(zip(levels, pyramid.kept, strict=True))
        )
        return RawPoints(parts=parts, up=pyramid.up, chosen=chosen)


class VisiblePoints:
    """Point sets of views, each made when it is first asked for.

    Use it in a ``with`` block: what the budget does not hold lies in a temporary folder.

    Args:
        make: Makes the points of a view, by its number.
        memory: Bytes that are kept in memory.
    """

    def __init__(self, make: Callable[[int], PointSet], *, memory: int) -> None:
        self._make = make
        self._budget = TensorBudget(memory)
        self._kept: dict[int, PointSet] = {}

    def __enter__(self) -> "VisiblePoints":
        return self

    def __exit__(self, *_: object) -> None:
        self._kept.clear()
        self._budget.close()

    def of(self, view: int) -> PointSet:
        """The points of a view.

        Raises:
            SplatsegError: If they are too much for memory and cannot be written.
        """
        if view not in self._kept:
            self._kept[view] = self._budgeted(self._make(view))
        return self._kept[view]

    def _budgeted(self, points: PointSet) -> PointSet:
        inputs = points.inputs
        arrays = self._budget.kept((*inputs.levels, *inputs.up, points.rows))
        count = len(inputs.levels)
        return PointSet(
            inputs=FusionInputs(levels=tuple(arrays[:count]), up=tuple(arrays[count:-1])),
            rows=arrays[-1],
        )
