"""Features of the points of a scene by a frozen encoder."""

import math
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg._check import check_choice, check_finite, check_shape
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, RangeError
from splatseg.lift.point_network.checkpoint import PointEncoder
from splatseg.lift.point_network.grid import average_on_grid
from splatseg.lift.point_network.inputs import MAX_METRES, feed_points, points_origin
from splatseg.lift.point_network.pyramid import (
    PointPyramid,
    PyramidOptions,
    check_seed,
    nearest_rows,
    point_pyramid,
)
from splatseg.neighbours import NeighbourIndex

Precision = Literal["float32", "float16"]

_SPACING_SAMPLE = 20_000
"""Points of which the spacing is measured."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpatialOptions:
    """How a scene is brought before an encoder."""

    metres_per_unit: float | None = None
    """Metres that a unit of the positions is. None, where that is not known, takes the scene to
    be as dense as what the encoder was trained on: half of the points have another one within
    its grid's side."""

    origin: tuple[float, float, float] | None = None
    """Where x, y, z are counted from, in metres. Views of a scene need one for all of them, for
    the encoder reads coordinates; None takes that of the points."""

    grid: bool = False
    """Average the points in cells of the side that the encoder was trained with. The encoder then
    sees points as even as those of its training, and each point has the features of the nearest
    average."""

    precision: Precision = "float32"
    """Type of the features that are returned; they are computed in float32."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_choice("precision", self.precision, get_args(Precision))
        scale = self.metres_per_unit
        if scale is not None and not (math.isfinite(scale) and scale > 0):
            raise RangeError(f"metres_per_unit: expected above 0, got {scale}.")
        if self.origin is not None and not all(math.isfinite(value) for value in self.origin):
            raise RangeError(f"origin: expected finite coordinates, got {self.origin}.")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SpatialFeatures:
    """What an encoder found of a scene, at every level."""

    pyramid: PointPyramid
    """The points and their samples, metres from the origin of `PointInputs`."""

    levels: tuple[Float[Tensor, "n_l channels"], ...]
    """Features as `RandlaEncoder.forward` returns them: of level 0, then of each sampled level,
    `RandlaConfig.level_widths` channels."""

    rows: Int64[Tensor, "n"]
    """The row of level 0 of each point that was given: its own, or that of the nearest average of
    a grid."""

    metres_per_unit: float
    """How the positions were scaled."""

    origin: tuple[float, float, float]
    """Where x, y, z were counted from, in metres."""

    is_scale_assumed: bool
    """Whether that was not known, and taken from how dense the points are."""


@boundary
def scene_options(
    encoder: PointEncoder,
    positions: Float[Tensor, "n 3"],
    *,
    options: SpatialOptions,
    seed: int,
) -> SpatialOptions:
    """Options with the scale and the origin of a scene, by which subsets of it are encoded alike.

    Args:
        encoder: Of `load_point_encoder`.
        positions: All points of the scene, z up.
        options: What is given stays; what is None is found of the points.
        seed: Of the points by which the scale is told.

    Raises:
        ShapeError: If positions are not (n, 3).
        RangeError: If a value is not finite or the scene, in metres, too large.
        InputError: If points lie on each other so that the scale cannot be told.
    """
    check_shape("positions", positions, (None, 3))
    check_finite("positions", positions)
    check_seed(seed)
    metres, scale = _in_metres(positions.detach().cpu().double(), encoder, options, seed)
    origin = options.origin or points_origin(metres, inputs=encoder.inputs)
    return replace(options, metres_per_unit=scale, origin=origin)


@boundary
def spatial_features(
    encoder: PointEncoder,
    positions: Float[Tensor, "n 3"],
    colours: Float[Tensor, "n 3"] | None,
    *,
    options: SpatialOptions,
    seed: int,
) -> SpatialFeatures:
    """Features of points by a frozen encoder, fed as it was trained.

    Published networks are evaluated on pieces of 40 960 points around one; here the whole scene
    is evaluated at once, as CoSSegGaussians does with what a view sees, and its positions are
    counted from one origin. The encoder takes z for up.

    Args:
        encoder: Of `load_point_encoder`.
        positions: Points, of any unit and origin, z up.
        colours: Red, green and blue of each in [0, 1]; values beyond are cut off. May be None, and
            is not read, where the encoder takes none.
        options: Scale, grid and type of the result.
        seed: Of the random sampling.

    Raises:
        ShapeError: If positions or colours are not (n, 3).
        RangeError: If a value is not finite or the scene, in metres, too large.
        InputError: If the encoder takes colours and there are none, there are too few points for
            its levels, or points lie on each other so that the scale cannot be told.
    """
    check_shape("positions", positions, (None, 3))
    check_finite("positions", positions)
    check_seed(seed)
    if encoder.colour and colours is None:
        raise InputError(f"colours: {encoder.source} takes colours of points, got none.")
    metres, scale = _in_metres(positions.detach().cpu().double(), encoder, options, seed)
    given = colours if encoder.colour else None
    rows = torch.arange(len(metres))
    if options.grid:
        averages = average_on_grid(metres, given, side=encoder.inputs.grid_size)
        rows = nearest_rows(NeighbourIndex(averages.positions), metres, 1, torch.int64)[:, 0]
        metres, given = averages.positions, averages.colours
    origin = options.origin or points_origin(metres, inputs=encoder.inputs)
    local, channels = feed_points(metres, given, inputs=encoder.inputs, origin=origin)
    config = encoder.config
    pyramid = point_pyramid(
        local,
        options=PyramidOptions(neighbours=config.neighbours, ratios=config.ratios),
        seed=seed,
    )
    with torch.no_grad():
        levels = encoder.encoder(pyramid, channels)
    return SpatialFeatures(
        pyramid=pyramid,
        levels=tuple(_stored(level, options.precision) for level in levels),
        rows=rows,
        metres_per_unit=scale,
        origin=origin,
        is_scale_assumed=options.metres_per_unit is None,
    )


def _in_metres(
    points: Tensor, encoder: PointEncoder, options: SpatialOptions, seed: int
) -> tuple[Tensor, float]:
    """Points in metres, and how many of them a unit is."""
    scale = options.metres_per_unit
    if scale is None:
        scale = encoder.inputs.grid_size / _spacing(points, seed)
    metres = points * scale
    farthest = float(metres.abs().max()) if len(metres) else 0.0
    if not farthest <= MAX_METRES:
        raise RangeError(
            f"positions: expected a scene of at most {MAX_METRES:g} metres, got {farthest:g} with "
            f"{scale:g} metres a unit."
        )
    return metres, scale


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


def _stored(level: Tensor, precision: Precision) -> Tensor:
    if precision == "float32":
        return level
    half = level.half()
    if not bool(torch.isfinite(half).all()):
        raise RangeError(
            f"precision: expected features that float16 holds, got {float(level.abs().max()):g}."
        )
    return half
