r"""Features of pixels onto voxels: means over what shows a voxel, or all of them solved for.

.. math:: f_v = \frac{\sum_{views} \sum_p h_{pv} F_p}{\sum_{views} \sum_p h_{pv}}

with :math:`h_{pv}` 1 for the first voxel that the ray of pixel p hits (section 3.4 of the paper).

A cell of a feature map is larger than what it shows, and networks spread what they see over the
cells around it, so that such a mean mixes a voxel with all that is beside it, in every view. Solved
for together, the features x of all voxels are alike those of neighbours that look alike:

.. math:: \min_x \sum_p \Bigl\| f_p - \bar f - \sum_v a_{pv} x_v \Bigr\|^2
          + \mu \sum_{u \sim v} w_{uv} \| x_u - x_v \|^2 + \lambda \sum_v \| x_v \|^2,
          \qquad a = G_\sigma * s

over the cells p of all views, with :math:`s_{pv}` the share of voxel v in the pixels of cell p,
blurred by a Gaussian of :math:`\sigma` cells, w the strengths of the neighbour graph of places and
colours (`lift.completion.graph`), and :math:`\bar f` the mean of all cells. Without neighbours it
is the mixing model by which objects are told apart (`methods.objects`); there are far more voxels
than objects, and what single cells do not settle, neighbours do. Solved by conjugate gradients,
some channels at a time; the matrix is never formed.

References:
    End-to-End Pipeline for Open-Vocabulary Semantic Novel View Synthesis with 3D Gaussians,
    sections 3.2 to 3.4.
    Keshava and Mustard, Spectral Unmixing, IEEE Signal Processing Magazine 19 (2002), eq. 2.
    Hestenes and Stiefel, Methods of Conjugate Gradients (1952).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Float64, Int32, Int64
from numpy.typing import NDArray
from scipy import sparse
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from splatseg._native import VoxelGrid as NativeGrid
from splatseg._native import add_hit_features
from splatseg.core import UNLABELLED, FeatureMap, FeatureSource, Gaussians, Labels, View
from splatseg.core.boundary import boundary
from splatseg.core.sh import base_colours
from splatseg.core.voxels import VoxelGrid
from splatseg.errors import InputError, ShapeError
from splatseg.lift.label_maps import label_map
from splatseg.lift.neighbour_graph import NodeAttributes, neighbour_graph
from splatseg.lift.voting.features import Taps, camera_of_grid, checked_grid, grid_taps
from splatseg.lift.voting.uplift import voting_views
from splatseg.methods.objects import pixel_cells
from splatseg.methods.voxels.grid import nearest_voxels

HitRule = Literal["first", "solved"]
"""See `VoxelOptions.hits`."""

BLUR = 1.0
"""Sigma: by how many cells of their feature maps networks spread what they see."""

SMOOTHNESS = 0.7
"""Mu: how much a voxel is like its neighbours; 1 counts as much as a whole cell."""

NEIGHBOURS = 16
COLOUR_WIDTH = 0.2
"""Standard deviation of colours, in [0, 1], that count as alike."""

RIDGE = 0.05
"""Lambda, in cells: a voxel that is in fewer, and has no neighbours, is drawn to the mean."""

_NEAR, _FAR = 0.01, 1e9
"""Distance at which rays begin and end, scene units."""

_STEPS = 60
_TOLERANCE = 1e-3
"""Residual over the right side at which conjugate gradients end."""

_CHANNELS = 64
"""Channels that are solved for at a time."""

Array = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LiftedVoxels:
    """Features of voxels, and what they rest on."""

    values: Float[Tensor, "m channels"]
    """Zeros where nothing was hit."""

    totals: Float64[Tensor, "m"]
    """Weight of the hits, or of cells; 0 where nothing was hit."""


@boundary
def lift_to_voxels(
    grid: VoxelGrid,
    views: Sequence[View],
    evidence: FeatureSource,
    gaussians: Gaussians,
    *,
    hits: HitRule = "solved",
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> LiftedVoxels:
    """Give voxels the features of the pixels that show them.

    Each view's features are read once; memory is that of the sums, float32, and of one view. Views
    are summed in the order of their names, and a voxel's pixels in theirs, so that the result does
    not depend on the number of threads.

    Args:
        grid: The voxels.
        views: Those whose features are used.
        evidence: Their feature maps, of any width.
        gaussians: The Gaussians of the scene; each is of the voxel nearest to its centre.
        hits: Which voxels a feature goes to.
        backend: Name of the rendering backend.
        progress: Called with the steps done and all there are, one a view, and with solved some
            more.

    Raises:
        InputError: If there are no views, one has no features, or a feature is not finite.
        ShapeError: If a grid of features does not fit its photograph, or widths differ.
    """
    ordered = voting_views(views, evidence, "features")
    found: _RayMeans | VoxelMixing | None = None
    channels, steps = 0, len(ordered)
    for done, view in enumerate(ordered):
        features = checked_grid(view, evidence.features(view.name))
        if found is None:
            channels = features.channels
            if hits == "first":
                found = _RayMeans(grid, channels)
            else:
                found = VoxelMixing(
                    grid=grid,
                    gaussians=gaussians,
                    rows=nearest_voxels(grid, gaussians.means),
                    channels=channels,
                    backend=backend,
                )
            steps += parts_of(channels) if hits == "solved" else 0
        if features.channels != channels:
            raise ShapeError(
                f"evidence: expected {channels} channels of view {view.name}, as of "
                f"view {ordered[0].name}, got {features.channels}."
            )
        found.add(view, features)
        if progress is not None:
            progress(done + 1, steps)
    if found is None:
        raise InputError("views: expected at least one view with features, got none.")
    return found.result(
        lambda part: None if progress is None else progress(len(ordered) + part, steps)
    )


class _RayMeans:
    """Means over the pixels whose rays hit a voxel first."""

    def __init__(self, grid: VoxelGrid, channels: int) -> None:
        self._grid, self._native = grid, NativeGrid(grid.cells.cpu())
        self._sums = torch.zeros(len(grid), channels)
        self._totals = torch.zeros(len(grid), dtype=torch.float64)

    def add(self, view: View, features: FeatureMap) -> None:
        """Add what the rays of a view hit."""
        covered, camera = camera_of_grid(view, features)
        origin, directions = camera.rays()
        start = (origin.cpu().double() - self._grid.origin) / self._grid.size
        towards = (directions.reshape(-1, 3).cpu().double() / self._grid.size).contiguous()
        hits = torch.empty((len(towards), 1), dtype=torch.int32)
        self._native.trace(start, towards, _NEAR, _FAR, None, hits, None)
        down, right = (
            _packed(grid_taps(count, pixels / features.stride, size))
            for count, pixels, size in (
                (features.features.shape[0], covered[0], camera.height),
                (features.features.shape[1], covered[1], camera.width),
            )
        )
        values = features.features.float().cpu().contiguous()
        by_view = False
        add_hit_features(*down, *right, hits, None, values, by_view, self._sums, self._totals)

    def result(self, _: Callable[[int], None]) -> LiftedVoxels:
        """The means."""
        self._sums /= torch.where(self._totals > 0, self._totals, 1.0).float()[:, None]
        return LiftedVoxels(values=self._sums, totals=self._totals)


def _packed(taps: Taps) -> tuple[Int32[Tensor, "2 pixels"], Float[Tensor, "pixels"]]:
    first, second, weight = taps
    return torch.stack((first, second)).to(torch.int32).contiguous(), weight.float().contiguous()


@dataclass(slots=True, kw_only=True, eq=False)
class VoxelMixing:
    """The mixing model of all views; take in views, then solve.

    Voxels are seen where their Gaussians make most of a pixel.
    """

    grid: VoxelGrid
    gaussians: Gaussians
    rows: Int64[Tensor, "n"]
    """The voxel of each Gaussian."""

    channels: int
    backend: str
    _cells: int = 0
    _parts: list["_ViewShares"] = field(default_factory=list)
    _right: Array = field(init=False)
    _features: NDArray[np.float64] = field(init=False)
    _totals: NDArray[np.float64] = field(init=False)

    def __post_init__(self) -> None:
        self._right = np.zeros((len(self.grid), self.channels), np.float32)
        self._features = np.zeros(self.channels)
        self._totals = np.zeros(len(self.grid))

    def add(self, view: View, features: FeatureMap) -> None:
        """Take in the cells of a view; memory is that of the shares of the voxels that it shows."""
        _, camera = camera_of_grid(view, features)
        labels = Labels(
            ids=self.rows.int(), confidence=torch.ones(len(self.rows)), background=UNLABELLED
        )
        drawn = label_map(self.gaussians, camera, labels, backend=self.backend).ids
        part = _ViewShares.of(drawn.cpu().numpy(), features, len(self.grid))
        values = features.features.float().cpu().flatten(0, 1)
        self._right += part.forth.T @ part.blurred(values, once=True).numpy()
        self._features += values.double().sum(dim=0).numpy()
        self._totals += part.seen
        self._cells += len(values)
        self._parts.append(part)

    def result(self, progress: Callable[[int], None]) -> LiftedVoxels:
        """X and the mean added, and in how many cells each voxel is, all its shares together.

        Args:
            progress: Called with the number of the parts of the channels that are done, of
                `parts_of`.
        """
        mean = (self._features / max(self._cells, 1)).astype(np.float32)
        right, totals = self._right, self._totals
        right -= totals[:, None].astype(np.float32) * mean
        smooth, degree = self._smoothing()
        diagonal = sum(part.squares for part in self._parts) + degree + RIDGE
        scale = (1 / diagonal).astype(np.float32)[:, None]
        # Views on top of each other: one sum over cells a product and not one a view.
        forth: Any = sparse.vstack([part.forth for part in self._parts], format="csr")
        back = forth.T.tocsr()

        def applied(x: Array) -> Array:
            cells, start = torch.from_numpy(forth @ x), 0
            for part in self._parts:
                own = slice(start, start := start + part.forth.shape[0])
                cells[own] = part.blurred(cells[own], once=False)
            return smooth @ x + np.float32(RIDGE) * x + back @ cells.numpy()

        for done in range(parts_of(right.shape[1])):
            part = slice(done * _CHANNELS, (done + 1) * _CHANNELS)
            right[:, part] = conjugate_gradients(
                applied, np.ascontiguousarray(right[:, part]), scale
            )
            progress(done + 1)
        right += mean
        return LiftedVoxels(values=torch.from_numpy(right), totals=torch.from_numpy(totals))

    def _smoothing(self) -> tuple[Any, NDArray[np.float64]]:
        """Mu times the Laplacian of the neighbour graph, and its diagonal."""
        colours = torch.zeros(len(self.grid), 4, dtype=torch.float64)
        own = base_colours(self.gaussians.sh).detach().cpu().double()
        colours.index_add_(0, self.rows, torch.cat((own, torch.ones(len(own), 1)), dim=1))
        graph = neighbour_graph(
            NodeAttributes(
                positions=self.grid.centres.numpy(),
                colours=(colours[:, :3] / colours[:, 3:].clamp_min(1)).float().numpy(),
            ),
            neighbours=NEIGHBOURS,
            colour_width=COLOUR_WIDTH,
            feature_width=1.0,
        )
        degree = SMOOTHNESS * np.asarray(graph.sum(axis=1), dtype=np.float64).reshape(-1)
        laplacian = sparse.diags(degree) - SMOOTHNESS * graph
        return sparse.csr_matrix(laplacian, dtype=np.float32), degree


def parts_of(channels: int) -> int:
    """How many times some channels are solved for."""
    return -(-channels // _CHANNELS)


def conjugate_gradients(applied: Any, right: Array, scale: Array) -> Array:
    """X with applied(X) = right, column by column.

    Args:
        applied: A symmetric positive definite matrix times columns.
        right: (m, k).
        scale: (m, 1), about the inverse of the diagonal.
    """
    x = np.zeros_like(right)
    residual, goal = right.copy(), _TOLERANCE * np.sqrt(_dots(right, right))
    scaled = scale * residual
    direction, before = scaled.copy(), _dots(residual, scaled)
    for _ in range(_STEPS):
        if bool((np.sqrt(_dots(residual, residual)) <= goal).all()):
            break
        moved = applied(direction)
        step = _quotient(before, _dots(direction, moved))
        x += step * direction
        residual -= step * moved
        scaled = scale * residual
        now = _dots(residual, scaled)
        direction = scaled + _quotient(now, before) * direction
        before = now
    return x


def _dots(a: Array, b: Array) -> NDArray[np.float64]:
    return (a * b).sum(axis=0, dtype=np.float64)


def _quotient(a: NDArray[np.float64], b: NDArray[np.float64]) -> Array:
    """0 where a column is solved already."""
    return np.divide(a, b, out=np.zeros_like(a), where=b > 0).astype(np.float32)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _ViewShares:
    """Which voxels the cells of a view show, and how what they show is blurred."""

    forth: Any
    """Shares (cells, m), scipy sparse rows, float32."""

    down: tuple[Tensor, Tensor]
    """The blur of rows of cells, and its square; symmetric."""

    right: tuple[Tensor, Tensor]
    """Of columns."""

    seen: NDArray[np.float64]
    """Cells that each voxel makes, all shares together (m,)."""

    squares: NDArray[np.float64]
    """About the diagonal of the normal equations (m,): as if each voxel had one cell of a view."""

    @classmethod
    def of(cls, ids: NDArray[Any], grid: FeatureMap, count: int) -> "_ViewShares":
        """Those of a drawn view.

        Args:
            ids: The voxel of each pixel (height, width), -1 for none.
            grid: The cells.
            count: How many voxels there are.
        """
        cells = grid.features.shape[0] * grid.features.shape[1]
        cell = pixel_cells(ids.shape, grid).ravel()
        pixels = np.bincount(cell, minlength=cells)
        there = ids.ravel() >= 0
        at = (cell[there], ids.ravel()[there].astype(np.int64))
        part = (1 / pixels[at[0]]).astype(np.float32)
        forth = sparse.csr_matrix(sparse.coo_matrix((part, at), shape=(cells, count)))
        matrices = [
            _blur_matrices(size, BLUR) for size in (grid.features.shape[0], grid.features.shape[1])
        ]
        kept = [float(both[1].diagonal().mean()) for both in matrices]
        return cls(
            forth=forth,
            down=matrices[0],
            right=matrices[1],
            seen=np.asarray(forth.sum(axis=0), dtype=np.float64).reshape(-1),
            squares=kept[0]
            * kept[1]
            * np.asarray(forth.multiply(forth).sum(axis=0), dtype=np.float64).reshape(-1),
        )

    def blurred(
        self, values: Float[Tensor, "cells channels"], *, once: bool
    ) -> Float[Tensor, "cells channels"]:
        """Values of cells blurred once, or twice."""
        down, right = (one[0 if once else 1] for one in (self.down, self.right))
        grid = values.reshape(len(down), len(right), -1)
        rows = (down @ grid.flatten(1)).reshape(grid.shape)
        return (right @ rows).flatten(0, 1)


def _blur_matrices(size: int, blur: float) -> tuple[Tensor, Tensor]:
    """A Gaussian over cells in a row, symmetric as it is mirrored at the ends, and its square."""
    one = np.eye(size)
    if blur > 0:
        one = gaussian_filter1d(one, blur, axis=0, mode="reflect")
    return torch.from_numpy(one).float(), torch.from_numpy(one @ one).float()
