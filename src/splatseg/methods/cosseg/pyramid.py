"""The points of a RandLA-Net: its shape, how it is fed, and random subsets with neighbours."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import torch
from jaxtyping import Float, Float32, Int32, Int64
from msgspec import Meta
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_finite, check_shape, check_values
from splatseg.core.boundary import boundary
from splatseg.core.options import Share, options
from splatseg.errors import InputError, RangeError
from splatseg.neighbours import NeighbourIndex

MAX_WIDTH = 4096
"""Channels that a layer may have; a file that asks for more is not believed."""
Width = Annotated[int, Meta(ge=1, le=MAX_WIDTH)]

MAX_LEVELS = 12
"""Levels that a network may have."""

MAX_METRES = 1e6
"""How far from the origin a point may be, so that float32 tells centimetres apart near it."""

_FLOOR = 0.01
"""Share of the points below the floor."""

_QUERIES = 1 << 17
"""Points whose neighbours are searched at a time: 16 of each are 34 MB."""

_MAX_POINTS = (1 << 31) - 1
"""Rows that 32 bits can tell apart."""


@options
class PyramidOptions:
    """How points are sampled. The defaults are RandLA-Net's for S3DIS."""

    neighbours: Width = 16
    """Points that a point sees in its level, itself included."""

    ratios: tuple[Width, ...] = (4, 4, 4, 4, 2)
    """Of how many points of a level one is kept in the next, one number a level."""

    def __post_init__(self) -> None:
        if not self.ratios:
            raise RangeError("ratios: expected at least one level, got none.")


@options
class RandlaConfig(PyramidOptions):
    """The shape of a RandLA-Net. The defaults are the published ones for S3DIS.

    Example:
        >>> RandlaConfig().level_widths
        (32, 32, 128, 256, 512, 1024)
        >>> RandlaConfig().min_points
        4096
    """

    inputs: Literal[3, 6] = 6
    """Channels of a point: 3 for x, y, z; 6 for x, y, z and red, green, blue."""

    first_width: Width = 8
    """Channels after the first layer."""

    widths: tuple[Width, ...] = (16, 64, 128, 256, 512)
    """d of each level's block, even; a block gives 2 d channels."""

    classes: Width = 13
    """Classes of the network's own head; an encoder has none."""

    sum_slope: Share = 0.2
    """Slope below 0 of the LeakyReLU after the sum of a block and its shortcut: 0.2 in the authors'
    code (github.com/QingyongHu/RandLA-Net), 0.01 in Open3D-ML's."""

    def __post_init__(self) -> None:
        if not 1 <= len(self.widths) <= MAX_LEVELS:
            raise RangeError(f"widths: expected 1 to {MAX_LEVELS} levels, got {len(self.widths)}.")
        if any(width % 2 for width in self.widths):
            raise RangeError(f"widths: expected even numbers, got {self.widths}.")
        if len(self.ratios) != len(self.widths):
            raise RangeError(
                f"ratios: expected {len(self.widths)}, one a level, got {len(self.ratios)}."
            )

    @property
    def colour(self) -> bool:
        """Whether points come with red, green and blue."""
        return self.inputs == 6

    @property
    def level_widths(self) -> tuple[int, ...]:
        """Channels of what an encoder returns: level 0 before sampling, then each sampled level."""
        doubled = tuple(2 * width for width in self.widths)
        return (doubled[0], *doubled)

    @property
    def min_points(self) -> int:
        """Points that a scene needs for every level to have enough."""
        return min_points(self.neighbours, self.ratios)


def min_points(neighbours: int, ratios: tuple[int, ...]) -> int:
    """Points that level 0 needs so that each level has `neighbours`, and the last one a point."""
    return max(neighbours * math.prod(ratios[:-1]), math.prod(ratios))


PUBLISHED_S3DIS = RandlaConfig()
"""Hu et al.'s network for S3DIS: x, y, z, red, green, blue at a grid of 4 cm, 13 classes."""


@options
class PointInputs:
    """What a network was trained on, so that it can be fed the same.

    Positions are in metres with z up. All implementations train on pieces of scenes, 40 960 or
    65 536 points that lie around one; a whole scene has larger coordinates than it saw.
    """

    grid_size: Annotated[float, Meta(gt=0, le=1e3)]
    """Side of the cells in which points were averaged, metres."""

    origin: Literal["mean", "floor"] = "mean"
    """Where x, y, z are counted from: the mean of the points; or the mean in x and y and the floor
    in z, below which one point in a hundred lies."""

    colour_range: Annotated[float, Meta(gt=0, le=255)] = 1.0
    """What full red, green or blue is fed as: 1, or 255."""


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointPyramid:
    """Points and random subsets of them, each of the one before.

    With L ratios there are L + 1 levels; the last has no neighbours. Rows of a level are in
    ascending order of the points.
    """

    positions: Float32[Tensor, "n 3"]
    """The points: level 0."""

    kept: tuple[Int64[Tensor, "n_l"], ...]
    """For each of the L + 1 levels, its points as rows of level 0."""

    neighbours: tuple[Int32[Tensor, "n_l k"], ...]
    """For each level but the last, the nearest points of each of its points within the level,
    nearest first, of equally near ones the lower row first. A point is its own nearest, unless
    others lie in the same position."""

    pool: tuple[Int64[Tensor, "n_next"], ...]
    """For each level but the last, the rows of it that the next level keeps."""

    up: tuple[Int64[Tensor, "n_l"], ...]
    """For each level but the last, the row of the nearest point of the next level."""

    @property
    def sizes(self) -> tuple[int, ...]:
        """Points of each level."""
        return tuple(len(rows) for rows in self.kept)


@boundary
def point_pyramid(
    positions: Float[Tensor, "n 3"], *, options: PyramidOptions, seed: int
) -> PointPyramid:
    r"""Sample points at random, level by level, and search neighbours in each level.

    Level l + 1 has :math:`\lfloor n_l / r_l \rfloor` of the points of level l, all subsets
    equally likely (Hu et al. 2020, section 3.2). One permutation of the points, drawn from `seed`,
    decides all levels, as in the authors' code; the result does not depend on the number of
    threads. Besides the result, memory for 300 bytes a point is needed while it is made.

    Args:
        positions: Points, in any unit and frame.
        options: Neighbours and ratios.
        seed: Of the permutation, 0 or more.

    Raises:
        ShapeError: If the positions are not (n, 3).
        RangeError: If a coordinate is not finite, or the seed is negative.
        InputError: If there are too few points for a level to have as many as neighbours.

    Example:
        >>> points = torch.arange(24.0).reshape(8, 3)
        >>> options = PyramidOptions(neighbours=2, ratios=(2, 2))
        >>> point_pyramid(points, options=options, seed=0).sizes
        (8, 4, 2)
    """
    check_shape("positions", positions, (None, 3))
    check_finite("positions", positions)
    check_seed(seed)
    _check_enough(len(positions), options)
    points = positions.detach().cpu()
    order = np.random.default_rng(seed).permutation(len(points))
    kept = [torch.arange(len(points))]
    neighbours: list[Tensor] = []
    pool: list[Tensor] = []
    up: list[Tensor] = []
    for ratio in options.ratios:
        level = points[kept[-1]]
        index = NeighbourIndex(level)
        neighbours.append(nearest_rows(index, level, options.neighbours, torch.int32))
        chosen = torch.from_numpy(np.sort(order[: len(level) // ratio]))
        pool.append(torch.searchsorted(kept[-1], chosen))
        nearest = nearest_rows(NeighbourIndex(points[chosen]), level, 1, torch.int64)
        up.append(nearest[:, 0])
        kept.append(chosen)
    return PointPyramid(
        positions=points.float(),
        kept=tuple(kept),
        neighbours=tuple(neighbours),
        pool=tuple(pool),
        up=tuple(up),
    )


def check_seed(seed: int) -> None:
    """Refuse seeds that no generator takes.

    Raises:
        RangeError: If it is negative, or 2^63 or more.
    """
    if not 0 <= seed < 1 << 63:
        raise RangeError(f"seed: expected 0 or more, below 2^63, got {seed}.")


def _check_enough(count: int, options: PyramidOptions) -> None:
    needed = min_points(options.neighbours, options.ratios)
    if count > _MAX_POINTS:
        raise InputError(f"positions: expected at most {_MAX_POINTS} points, got {count}.")
    if count >= needed:
        return
    sizes = [count]
    for ratio in options.ratios:
        sizes.append(sizes[-1] // ratio)
    raise InputError(
        f"positions: expected at least {needed} points, so that each of {len(options.ratios)} "
        f"levels has {options.neighbours} neighbours, got {count}, of which the levels have "
        f"{', '.join(map(str, sizes))}."
    )


def nearest_rows(index: NeighbourIndex, queries: Tensor, k: int, dtype: torch.dtype) -> Tensor:
    """The k nearest points of each query, (m, k), searched in blocks to bound memory."""
    found = torch.empty(len(queries), k, dtype=dtype)
    for start in range(0, len(queries), _QUERIES):
        rows = slice(start, start + _QUERIES)
        found[rows] = index.nearest(queries[rows], k).indices
    return found
