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

What no view sees takes the labels of what is shaped like it, by extremely randomised trees
(`ShapeForest`). The labels that views give to points are all that the trees learn from; no label of
any other drive, and none of the points themselves.

References:
    Geurts et al., Extremely randomized trees (Machine Learning 2006).
    Weinmann et al., Semantic point cloud interpretation based on optimal neighborhoods, relevant
    features and efficient classifiers (ISPRS 2015), section 3.2.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core.threads import caller_threads
from splatseg.errors import import_package
from splatseg.neighbours import NeighbourIndex

_STEPS = 4096
"""Positions within a cell are rounded to so many steps, so that their sums are exact and no order
of the points changes a mean."""

_KEY_BITS = 21
"""Bits of a coordinate in a key: cells in each direction, 2^20 on either side of the origin."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Thinned:
    """The cells that points fall into, ordered by their coordinates, whatever the points' order."""

    centres: Float[Tensor, "n 3"]
    """Mean of the points of each cell, world, float64."""

    cell_of: Int[Tensor, "p"]
    """The cell of each point, int64."""

    hashes: Int[Tensor, "n"]
    """A number of each cell that depends on its coordinates alone, int64, not negative: the
    smallest ones are a random sample of the cells."""

    def __len__(self) -> int:
        return len(self.centres)


def thin(points: Float[Tensor, "p 3"], cell: float) -> Thinned:
    """Sort points into cells of a grid with a corner at the origin.

    Args:
        points: Positions in the world, scene units, finite.
        cell: Side of a cell, scene units, positive. Cells that are 2^20 or more from the origin
            share numbers with others on the far side.
    """
    scaled = points.detach().cpu().double().numpy() / cell
    corner = np.floor(scaled)
    inside = np.round((scaled - corner) * _STEPS).astype(np.int64)
    coordinates = corner.astype(np.int64)
    keys = packed_keys(coordinates)
    _, first, cell_of, counts = np.unique(
        keys, return_index=True, return_inverse=True, return_counts=True
    )
    cell_of = cell_of.reshape(-1)
    sums = np.zeros((len(counts), 3), dtype=np.int64)
    for axis in range(3):
        np.add.at(sums[:, axis], cell_of, inside[:, axis])
    means = coordinates[first] + sums / (counts[:, None] * _STEPS)
    return Thinned(
        centres=torch.from_numpy(means * cell),
        cell_of=torch.from_numpy(cell_of),
        hashes=torch.from_numpy(_mixed(keys[first])),
    )


def packed_keys(coordinates: NDArray[np.int64]) -> NDArray[np.int64]:
    """One int64 for integer coordinates (n, d), d at most 3, ordered as they are."""
    offset = 1 << (_KEY_BITS - 1)
    mask = (1 << _KEY_BITS) - 1
    keys = np.zeros(len(coordinates), dtype=np.int64)
    for axis in range(coordinates.shape[1]):
        keys = (keys << _KEY_BITS) | ((coordinates[:, axis] + offset) & mask)
    return keys


def _mixed(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """The finaliser of SplitMix64 (Steele et al. 2014): neighbouring keys become unlike numbers."""
    mixed = keys.astype(np.uint64)
    mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return ((mixed ^ (mixed >> np.uint64(31))) >> np.uint64(1)).astype(np.int64)


_SMALL, _LARGE = 10, 30
"""Points of the two neighbourhoods, the point itself among them."""

_EDGES = 16
"""Nearest others of each point in the graph."""

_COLUMNS = (0.5, 2.0)
"""Sides of the columns in which the lowest and highest points are looked for, metres."""

_ROWS = 65536


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LocalShapes:
    """What is around each of some points."""

    features: Float[Tensor, "n f"]
    """Shape, float32; lengths in metres."""

    normals: Float[Tensor, "n 3"]
    """Direction in which the point and its nearest extend least, of either sign."""

    neighbours: Int[Tensor, "n k"]
    """Rows of the nearest others, -1 where there are none."""

    distances: Float[Tensor, "n k"]
    """How far they are, metres; infinite where there are none."""


def local_shapes(points: Float[Tensor, "n 3"], up: Float[Tensor, "3"]) -> LocalShapes:
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
    return LocalShapes(
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


SMOOTHING = 0.7
"""Beta: what neighbours count together beside a point's own votes."""

SMOOTHING_WIDTH = 0.3
"""S, metres."""

NORMAL_WIDTH = 0.2
"""A: by how much of 1 - |cos| of their normals neighbours count e times less."""

_CUT = 3.0
"""Neighbours farther than so many widths do not count."""


def smoothed(
    shares: Float[Tensor, "n c"], shapes: LocalShapes, *, steps: int
) -> Float[Tensor, "n c"]:
    r"""Shares of labels smoothed over the graph of nearest points, along surfaces, not across them.

    .. math:: x_i \leftarrow (1 - \beta)\, y_i + \beta \sum_j \frac{w_{ij}}{\sum_k w_{ik}} x_j,
              w_{ij} = \exp\left(-\frac{d_{ij}^2}{2 s^2} - \frac{1 - |n_i \cdot n_j|}{a}\right)

    with y what is known of each point, d distances, n normals: a fixed number of steps of label
    propagation (Zhou et al. 2004, eq. 4), so that a point knows nothing of what is far away.

    References:
        Zhou et al., Learning with local and global consistency (NIPS 2004).
        Tomasi and Manduchi, Bilateral filtering for gray and color images (ICCV 1998): weights by
        distance times weights by likeness.

    Args:
        shares: What is known of each point.
        shapes: The graph, and normals.
        steps: How many.
    """
    rows = shapes.neighbours.clamp_min(0)
    weights = torch.empty(rows.shape)
    for rank in range(rows.shape[1]):
        distance = shapes.distances[:, rank]
        alike = (shapes.normals * shapes.normals[rows[:, rank]]).sum(dim=1).abs()
        weights[:, rank] = torch.where(
            distance <= _CUT * SMOOTHING_WIDTH,
            torch.exp(-(distance**2) / (2 * SMOOTHING_WIDTH**2) - (1 - alike) / NORMAL_WIDTH),
            0.0,
        )
    total = weights.sum(dim=1, keepdim=True)
    # Whoever has no neighbour keeps what it knows.
    beta = torch.where(total > 0, SMOOTHING / total.clamp_min(1e-30), 0.0)
    own = torch.where(total > 0, 1 - SMOOTHING, 1.0) * shares
    out = shares
    for _ in range(steps):
        after = own.clone()
        for rank in range(rows.shape[1]):
            after += (beta * weights[:, rank : rank + 1]) * out[rows[:, rank]]
        out = after
    return out


_MIN_LEAF = 5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShapeSamples:
    """Points with labels to learn from: at most so many of each, and how many each stands for."""

    features: Float[Tensor, "m f"]
    labels: Int[Tensor, "m"]
    """Columns of the table of votes, int64."""

    weights: Float[Tensor, "m"]
    """How sure its label is, in [0, 1]."""

    hashes: Int[Tensor, "m"]
    totals: Float[Tensor, "c"]
    """Points of each label before the sample was drawn."""

    def __len__(self) -> int:
        return len(self.labels)


def drawn(samples: Sequence[ShapeSamples], per_label: int) -> ShapeSamples:
    """Several samples as one: of each label those with the smallest hashes.

    Samples of samples are the sample of all: how a drive is divided does not matter.
    """
    features = torch.cat([sample.features for sample in samples])
    labels = torch.cat([sample.labels for sample in samples])
    weights = torch.cat([sample.weights for sample in samples])
    hashes = torch.cat([sample.hashes for sample in samples])
    order = np.lexsort((hashes.numpy(), labels.numpy()))
    grouped = labels.numpy()[order]
    starts = np.searchsorted(grouped, grouped, side="left")
    kept = torch.from_numpy(order[np.arange(len(order)) - starts < per_label])
    totals = torch.stack([sample.totals for sample in samples]).sum(dim=0)
    return ShapeSamples(
        features=features[kept],
        labels=labels[kept],
        weights=weights[kept],
        hashes=hashes[kept],
        totals=totals,
    )


def forest_package() -> Any:
    """What grows the trees.

    Raises:
        MissingPackageError: If the extra `street` is not installed.
    """
    return import_package("sklearn.ensemble", "labels of points by their shapes", "street")


class ShapeForest:
    """Trees that tell from a shape what it is called.

    Args:
        samples: What to learn from, at least one point.
        trees: How many.
        seed: Of the trees.
    """

    def __init__(self, samples: ShapeSamples, *, trees: int, seed: int) -> None:
        labels = samples.labels.numpy()
        present = np.bincount(labels, minlength=len(samples.totals))
        # Each label counts as often as it came, though only some of its points were kept.
        share = samples.totals.numpy() / np.maximum(present, 1)
        self._labels = len(samples.totals)
        self._forest = forest_package().ExtraTreesClassifier(
            n_estimators=trees,
            min_samples_leaf=_MIN_LEAF,
            random_state=seed,
            n_jobs=caller_threads(),
        )
        self._forest.fit(
            samples.features.numpy(), labels, sample_weight=samples.weights.numpy() * share[labels]
        )
        # Trees add their answers up in the order in which their threads end: one at a time.
        self._forest.n_jobs = 1

    def shares(self, features: Float[Tensor, "n f"]) -> Float[Tensor, "n c"]:
        """How sure each label is of each shape; rows add up to 1."""
        out = torch.zeros(len(features), self._labels)
        columns = torch.from_numpy(np.asarray(self._forest.classes_, dtype=np.int64))
        blocks = features.split(_ROWS)
        with ThreadPoolExecutor(caller_threads()) as pool:
            told = pool.map(self._told, blocks)
            for start, shares in zip(range(0, len(out), _ROWS), told, strict=True):
                out[start : start + _ROWS, columns] = torch.from_numpy(shares).float()
        return out

    def _told(self, features: Float[Tensor, "m f"]) -> NDArray[np.float64]:
        return np.asarray(self._forest.predict_proba(features.numpy()))
