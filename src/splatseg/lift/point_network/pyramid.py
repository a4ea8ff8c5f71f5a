"""Random sampling of points to ever fewer, with the neighbours in each level."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Int32, Int64
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, RangeError
from splatseg.lift.point_network.config import min_points
from splatseg.neighbours import NeighbourIndex

_QUERIES = 1 << 17
"""Points whose neighbours are searched at a time: 16 of each are 34 MB."""
_MAX_POINTS = (1 << 31) - 1
"""Rows that 32 bits can tell apart."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PyramidOptions:
    """How points are sampled. The defaults are RandLA-Net's for S3DIS."""

    neighbours: int = 16
    """Points that a point sees in its level, itself included."""

    ratios: tuple[int, ...] = (4, 4, 4, 4, 2)
    """Of how many points of a level one is kept in the next, one number a level."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if not 1 <= self.neighbours <= 4096:
            raise RangeError(f"neighbours: expected 1 to 4096, got {self.neighbours}.")
        if not self.ratios:
            raise RangeError("ratios: expected at least one level, got none.")
        if any(not 1 <= ratio <= 4096 for ratio in self.ratios):
            raise RangeError(f"ratios: expected numbers from 1 to 4096, got {self.ratios}.")


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

    def to(self, device: torch.device | str) -> "PointPyramid":
        """The pyramid on another device."""
        return PointPyramid(
            positions=self.positions.to(device),
            kept=tuple(one.to(device) for one in self.kept),
            neighbours=tuple(one.to(device) for one in self.neighbours),
            pool=tuple(one.to(device) for one in self.pool),
            up=tuple(one.to(device) for one in self.up),
        )


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


@boundary
def join_pyramids(pyramids: Sequence[PointPyramid]) -> PointPyramid:
    """Several pyramids as one, for a batch: no point sees a point of another one.

    Args:
        pyramids: At least one, of the same options. Rows of level 0 follow each other.

    Raises:
        InputError: If there is none, or their levels or neighbours differ in number.
    """
    if not pyramids:
        raise InputError("pyramids: expected at least one, got none.")
    shapes = sorted({tuple(near.shape[1] for near in one.neighbours) for one in pyramids})
    if len(shapes) > 1:
        raise InputError(
            "pyramids: expected the same levels with as many neighbours, got neighbours "
            f"{' and '.join(str(list(shape)) for shape in shapes)}."
        )
    starts = np.cumsum([[0] * (len(shapes[0]) + 1), *(p.sizes for p in pyramids)], axis=0)[:-1]

    def joined(name: str, ahead: int, level: int) -> Tensor:
        """A field at a level, of which the values are rows of the level so many ahead."""
        parts = (getattr(one, name)[level] for one in pyramids)
        shifts = (int(start[level + ahead]) for start in starts)
        return torch.cat([part + shift for part, shift in zip(parts, shifts, strict=True)])

    levels = range(len(shapes[0]))
    return PointPyramid(
        positions=torch.cat([one.positions for one in pyramids]),
        kept=tuple(joined("kept", -level, level) for level in range(len(shapes[0]) + 1)),
        neighbours=tuple(joined("neighbours", 0, level) for level in levels),
        pool=tuple(joined("pool", 0, level) for level in levels),
        up=tuple(joined("up", 1, level) for level in levels),
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
