r"""Shapes around points: what a wall, a pole or a lawn is like, wherever it stands.

With :math:`\lambda_1 \ge \lambda_2 \ge \lambda_3` the roots of the eigenvalues of the covariance
of a point and its k nearest, a neighbourhood is described by

.. math:: \frac{\lambda_1 - \lambda_2}{\lambda_1}, \quad
          \frac{\lambda_2 - \lambda_3}{\lambda_1}, \quad
          \frac{\lambda_3}{\lambda_1}, \quad \lambda_1, \quad
          |n \cdot u|, \quad |t \cdot u|

(linearity, planarity, scattering, size, and how the normal n and the longest direction t stand to
up, u), at two sizes; by the height over the lowest and below the highest points around; and by
the mean of all these over the neighbours' neighbours. No place and no colour is among them, so
that what was learned at one place of a drive holds at another.

References:
    Weinmann et al., Semantic point cloud interpretation based on optimal neighborhoods, relevant
    features and efficient classifiers (ISPRS 2015), section 3.2.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from splatseg.lift.points.thin import packed_keys
from splatseg.neighbours import NeighbourIndex

_SMALL, _LARGE = 10, 30
"""Points of the two neighbourhoods, the point itself among them."""

_EDGES = 16
"""Nearest others of each point in the graph."""

_COLUMNS = (0.5, 2.0)
"""Sides of the columns in which the lowest and highest points are looked for, metres."""

_ROWS = 65536


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Surroundings:
    """What is around each of some points."""

    features: Float[Tensor, "n f"]
    """Shape, float32; lengths in metres."""

    normals: Float[Tensor, "n 3"]
    """Direction in which the point and its nearest extend least, of either sign."""

    neighbours: Int[Tensor, "n k"]
    """Rows of the nearest others, -1 where there are none."""

    distances: Float[Tensor, "n k"]
    """How far they are, metres; infinite where there are none."""


def surroundings(points: Float[Tensor, "n 3"], up: Float[Tensor, "3"]) -> Surroundings:
    """Describe what is around each point.

    Args:
        points: Positions, metres, float64. Their density matters: thin them first.
        up: Direction away from the ground, of any length.
    """
    up = up.double() / torch.linalg.vector_norm(up.double())
    index = NeighbourIndex(points)
    count = len(points)
    shapes = [torch.empty(count, 6) for _ in (_SMALL, _LARGE)]
    normals = torch.empty(count, 3)
    neighbours = torch.empty(count, _EDGES, dtype=torch.int64)
    distances = torch.empty(count, _EDGES)
    for start in range(0, count, _ROWS):
        part = slice(start, start + _ROWS)
        rows = torch.arange(count)[part]
        found = index.nearest_others(_LARGE - 1, rows=rows)
        # Where there are fewer points than neighbours, a point stands in for those there are not.
        near = torch.where(found.indices >= 0, found.indices, rows[:, None])
        offsets = points[torch.cat((rows[:, None], near), dim=1)] - points[rows, None]
        shapes[0][part], normals[part] = _shape(offsets[:, :_SMALL], up)
        shapes[1][part], _ = _shape(offsets, up)
        neighbours[part] = found.indices[:, :_EDGES]
        distances[part] = found.distances[:, :_EDGES].float()
    own = torch.cat((*shapes, _heights(points, up)), dim=1)
    around = _mean_over(neighbours, _mean_over(neighbours, own))
    return Surroundings(
        features=torch.cat((own, around), dim=1),
        normals=normals,
        neighbours=neighbours,
        distances=distances,
    )


def _shape(
    offsets: Float[Tensor, "m k 3"], up: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "m 6"], Float[Tensor, "m 3"]]:
    """The six numbers of a neighbourhood, and its normal."""
    centred = offsets - offsets.mean(dim=1, keepdim=True)
    covariance = centred.transpose(1, 2) @ centred / offsets.shape[1]
    values, vectors = (torch.from_numpy(out) for out in np.linalg.eigh(covariance.numpy()))
    small, middle, large = values.clamp_min(0).sqrt().unbind(dim=1)
    scale = large.clamp_min(1e-9)
    standing = (vectors * up[:, None]).sum(dim=1).abs()
    described = torch.stack(
        (
            (large - middle) / scale,
            (middle - small) / scale,
            small / scale,
            large,
            standing[:, 0],
            standing[:, 2],
        ),
        dim=1,
    )
    return described.float(), vectors[:, :, 0].float()


def _heights(points: Float[Tensor, "n 3"], up: Float[Tensor, "3"]) -> Float[Tensor, "n 6"]:
    """Height over the lowest point of nine columns and of one's own, and below its highest."""
    height = (points @ up).numpy()
    across = _across(points, up)
    return torch.from_numpy(
        np.concatenate([_in_columns(across, height, side) for side in _COLUMNS], axis=1)
    ).float()


def _across(points: Float[Tensor, "n 3"], up: Float[Tensor, "3"]) -> NDArray[np.float64]:
    """Coordinates in the plane across up, (n, 2)."""
    axis = torch.eye(3, dtype=torch.float64)[int(up.abs().argmin())]
    first = torch.linalg.cross(up, axis)
    first = first / torch.linalg.vector_norm(first)
    return (points @ torch.stack((first, torch.linalg.cross(up, first)), dim=1)).numpy()


def _in_columns(
    across: NDArray[np.float64], height: NDArray[np.float64], side: float
) -> NDArray[np.float64]:
    coordinates = np.floor(across / side).astype(np.int64)
    keys, column = np.unique(packed_keys(coordinates), return_inverse=True)
    column = column.reshape(-1)
    lowest = np.full(len(keys), np.inf)
    highest = np.full(len(keys), -np.inf)
    np.minimum.at(lowest, column, height)
    np.maximum.at(highest, column, height)
    around = lowest.copy()
    own = np.zeros((len(keys), 2), dtype=np.int64)
    own[column] = coordinates
    for step in np.ndindex(3, 3):
        wanted = packed_keys(own + (np.array(step) - 1))
        row = np.searchsorted(keys, wanted).clip(0, len(keys) - 1)
        around = np.where(keys[row] == wanted, np.minimum(around, lowest[row]), around)
    return np.stack(
        (height - around[column], height - lowest[column], highest[column] - height), axis=1
    )


def _mean_over(
    neighbours: Int[Tensor, "n k"], values: Float[Tensor, "n f"]
) -> Float[Tensor, "n f"]:
    """Mean over each row's neighbours, in their order; of none the row's own."""
    total = torch.zeros_like(values)
    for rank in range(neighbours.shape[1]):
        row = neighbours[:, rank]
        total += values[row.clamp_min(0)] * (row >= 0)[:, None]
    count = (neighbours >= 0).sum(dim=1, keepdim=True)
    return torch.where(count > 0, total / count.clamp_min(1), values)
