r"""The neighbour graph of a scene, built once and kept for many selections.

Refining, filling holes and completing a selection all ask which Gaussians are neighbours, how
alike they are, and whether they touch. For a scene of 400 k Gaussians that takes seconds to find
and milliseconds to look up, so a session builds a `NeighbourGraph` when the scene opens.

Strengths are those of `lift.neighbour_graph`: distance, colour, normal and, where there are
any, features. Two Gaussians touch as in `selection.components`.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatseg.core import Features, Gaussians
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import RangeError, ShapeError
from splatseg.lift.neighbour_graph import NodeAttributes, flat_normals, neighbour_graph
from splatseg.selection import touching


@dataclass(frozen=True, slots=True, kw_only=True)
class GraphOptions:
    """Which Gaussians are neighbours, and what makes them alike."""

    neighbours: int = 12
    """Nearest Gaussians of each one; an edge is there where either end is among the other's."""

    colour_width: float = 0.1
    """Standard deviation of colours in [0, 1] that count as alike."""

    feature_width: float = 1.0
    """Width of the feature affinity, in squared median distances of features along edges."""

    normal_width: float = 0.5
    """Standard deviation of the sine between normals of flat Gaussians that count as alike."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.neighbours < 1:
            raise RangeError(f"neighbours: expected at least 1, got {self.neighbours}.")
        for name in ("colour_width", "feature_width", "normal_width"):
            value = getattr(self, name)
            if not value > 0:
                raise RangeError(f"{name}: expected a positive number, got {value}.")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Edges:
    """Edges that leave some rows, in the order of the rows asked for."""

    first: Int64[Tensor, "edges"]
    """Index into the rows that were asked for."""

    second: Int64[Tensor, "edges"]
    """The neighbour, a row of the scene."""

    strengths: Float[Tensor, "edges"]
    """How alike the ends are, in (0, 1]."""

    touching: Bool[Tensor, "edges"]
    """Whether their ellipsoids of two standard deviations touch."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NeighbourGraph:
    """Neighbours of every Gaussian, how alike they are and whether they touch; symmetric.

    Make it with `build_graph`. 9 bytes an edge: about 45 MB for 334 k Gaussians.
    """

    strengths: Any
    """``scipy.sparse.csr_matrix`` (n, n) of float32 in (0, 1], nothing on the diagonal."""

    touching: Bool[Tensor, "edges"]
    """Of each entry of `strengths`, in its order."""

    mean_degree: float
    """Mean sum of the strengths of a Gaussian's edges; 1 where there are no edges."""

    def __len__(self) -> int:
        return int(self.strengths.shape[0])

    @property
    def nbytes(self) -> int:
        """Memory that it takes, bytes."""
        matrix = self.strengths
        parts = (matrix.data, matrix.indices, matrix.indptr)
        return sum(int(part.nbytes) for part in parts) + self.touching.nbytes

    def edges(self, rows: Int64[Tensor, "m"]) -> Edges:
        """All edges that leave some rows; a row may be asked for twice."""
        matrix = self.strengths
        chosen = rows.numpy()
        starts = matrix.indptr[chosen].astype(np.int64)
        sizes = matrix.indptr[chosen + 1].astype(np.int64) - starts
        before = np.cumsum(sizes) - sizes
        entries = np.repeat(starts - before, sizes) + np.arange(int(sizes.sum()))
        return Edges(
            first=torch.from_numpy(np.repeat(np.arange(len(chosen)), sizes)),
            second=torch.from_numpy(matrix.indices[entries].astype(np.int64)),
            strengths=torch.from_numpy(matrix.data[entries]),
            touching=self.touching[torch.from_numpy(entries)],
        )

    def check(self, name: str, values: Tensor) -> None:
        """Raise `ShapeError` unless `values` has one row a Gaussian."""
        if len(values) != len(self):
            raise ShapeError(
                f"{name}: expected {len(self)} rows, those of the graph's Gaussians, "
                f"got {len(values)}."
            )


@boundary
def build_graph(
    gaussians: Gaussians,
    *,
    features: Features | None = None,
    options: GraphOptions | None = None,
) -> NeighbourGraph:
    """Find the neighbours of every Gaussian; seconds for a scene, so keep what it returns.

    Args:
        gaussians: The Gaussians of the scene.
        features: What else makes neighbours alike, compared by direction; rows of zeros are
            Gaussians of which nothing is known.
        options: Which are neighbours, and what makes them alike.

    Raises:
        ShapeError: If there is not one row of features a Gaussian.
        RangeError: If a value is NaN or infinite.

    Example:
        >>> row = torch.arange(4.0).unsqueeze(1) * torch.tensor([[1.0, 0.0, 0.0]])
        >>> g = Gaussians(means=row, rotations=torch.eye(4)[:1].expand(4, 4),
        ...               scales=torch.full((4, 3), 0.3), opacities=torch.ones(4),
        ...               sh=torch.zeros(4, 1, 3))
        >>> graph = build_graph(g, options=GraphOptions(neighbours=1))
        >>> graph.edges(torch.tensor([1])).second
        tensor([0, 2])
    """
    options = options or GraphOptions()
    gaussians.check_values()
    if features is not None and len(features) != len(gaussians):
        raise ShapeError(
            f"features: expected {len(gaussians)} rows, one a Gaussian, got {len(features)}."
        )
    gaussians = gaussians.to(device="cpu")
    matrix = neighbour_graph(
        NodeAttributes(
            positions=gaussians.means.detach().double().numpy(),
            colours=gaussians.colours.detach().float().clamp(0, 1).numpy(),
            features=None if features is None else features.values.detach().cpu().float().numpy(),
            normals=flat_normals(gaussians),
        ),
        neighbours=options.neighbours,
        colour_width=options.colour_width,
        feature_width=options.feature_width,
        normal_width=options.normal_width,
    )
    first = torch.from_numpy(np.repeat(np.arange(len(gaussians)), np.diff(matrix.indptr)))
    second = torch.from_numpy(matrix.indices.astype(np.int64))
    degree = float(matrix.data.sum(dtype=np.float64)) / max(len(gaussians), 1)
    return NeighbourGraph(
        strengths=matrix,
        touching=_touching(gaussians, first, second),
        mean_degree=degree if degree > 0 else 1.0,
    )


def _touching(gaussians: Gaussians, first: Tensor, second: Tensor) -> Tensor:
    """Which edges touch. Each is asked for in both directions alike, so that rounding agrees."""
    return touching(gaussians, torch.minimum(first, second), torch.maximum(first, second))
