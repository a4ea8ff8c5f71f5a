r"""Features of objects as a method: each Gaussian takes the vector of its object.

Masks are associated into objects (`methods.associate`). A cell of a feature map shows several
objects, and networks spread what they see over the cells around it. A mug that is smaller than a
cell never has one of its own: the mean over its pixels is that of the desk. So the features x of
all objects are solved for together:

.. math:: \min_x \sum_p \Bigl\| f_p - \sum_k a_{pk} x_k \Bigr\|^2
          + \lambda \sum_k \| x_k - \bar f \|^2, \qquad a = G_\sigma * s

over the cells p of all views, with :math:`s_{pk}` the share of object k in the pixels of cell p of
its rendered label map, blurred by a Gaussian of :math:`\sigma` cells, and :math:`\bar f` the mean
of all cells. What no object claims is one more. :math:`\sigma` is that of the least residual. It is
the linear mixing model of remote sensing, with known abundances and unknown endmembers.

References:
    Keshava and Mustard, Spectral Unmixing, IEEE Signal Processing Magazine 19 (2002), eq. 2.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import scipy.sparse as sparse
import torch
from jaxtyping import Float, Int64
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.sparse.linalg import splu
from torch import Tensor

from splatseg.core import (
    UNLABELLED,
    FeatureMap,
    Features,
    FeatureSource,
    Gaussians,
    InstanceTree,
    Labels,
    LayerInfo,
    View,
)
from splatseg.core.boundary import boundary
from splatseg.core.options import options as options_class
from splatseg.errors import InputError, ShapeError
from splatseg.lift.label_maps import label_map
from splatseg.lift.segments import EvidenceSegments
from splatseg.lift.voting.features import camera_of_grid, checked_grid
from splatseg.lift.voting.uplift import voting_views
from splatseg.methods._method import Method, MethodInputs
from splatseg.methods.associate import associate

BLURS = (0.0, 0.5, 0.7, 1.0, 1.4, 2.0)
"""Standard deviations, in cells, of which the one with the least residual is taken."""

RIDGE = 1.0
"""Lambda, in cells: an object that is in fewer is drawn to the mean of all."""

_MIN_SHARE = 1e-3
"""Share of a cell below which an object counts as not in it."""

_SOLVED = "the blur is that of the least residual and the ridge one cell"


@options_class(removed=dict.fromkeys(("unmixing", "blur", "ridge"), _SOLVED))
class ObjectFeaturesOptions:
    """How features of objects are found."""

    masks: str | None = None
    """Evidence of masks, or of panoptic or tracked segments, by which objects are found; needed."""


def run(inputs: MethodInputs, options: ObjectFeaturesOptions) -> Features:
    """Associate masks, and solve for the features of the objects.

    Returns:
        The vector of its object for each Gaussian, zeros where it has none or no view shows it.
        Weights of the Gaussians of an object add up to the cells that show it.
    """
    masks = inputs.companions.get("masks")
    if masks is None:
        raise InputError(
            "masks: expected evidence of masks, such as masks_sam, to find objects by, got none."
        )
    found = associate(
        inputs.gaussians,
        inputs.views,
        EvidenceSegments(evidence=masks),
        backend=inputs.backend,
        executor=inputs.executor,
    )
    objects = found.cut("object") if isinstance(found, InstanceTree) else found
    solved = object_features(
        inputs.gaussians,
        inputs.views,
        inputs.evidence,
        objects,
        backend=inputs.backend,
        progress=inputs.progress,
    )
    row = solved.of_gaussians(objects)
    known = (row >= 0) & (solved.cells[row.clamp_min(0)] > 0)
    row = row.clamp_min(0)
    size = torch.bincount(row[known], minlength=len(solved.ids)).clamp_min(1)
    return Features(
        values=torch.where(known[:, None], solved.values[row], 0.0),
        weights=torch.where(known, (solved.cells / size)[row], 0.0),
        info=LayerInfo(
            method="objects",
            options=asdict(options),
            views=tuple(sorted(view.name for view in inputs.views)),
            details={
                "objects": int((solved.cells > 0).sum()),
                "blur": solved.blur,
                "residual": round(solved.residual, 6),
            },
        ),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObjectFeatures:
    """A vector an object."""

    ids: Int64[Tensor, "k"]
    """Of the objects, ascending."""

    values: Float[Tensor, "k channels"]
    """float32; channels are those of the feature maps."""

    cells: Float[Tensor, "k"]
    """How many cells show each: the squares of its shares of them, summed. 0: no view shows it."""

    blur: float = 0.0
    """Sigma that was taken."""

    residual: float = 0.0
    """Share, in [0, 1], of the sum of squares of all features that is left over."""

    def of_gaussians(self, objects: Labels) -> Int64[Tensor, "n"]:
        """The row of each Gaussian's object, -1 where it has none that is known.

        Args:
            objects: Which object each Gaussian is of.
        """
        ids = objects.ids.cpu().long()
        if not len(self.ids):
            return torch.full_like(ids, UNLABELLED)
        row = torch.searchsorted(self.ids, ids).clamp_max(len(self.ids) - 1)
        return torch.where((ids != UNLABELLED) & (self.ids[row] == ids), row, UNLABELLED)


@boundary
def object_features(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: FeatureSource,
    objects: Labels,
    *,
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> ObjectFeatures:
    """Solve for the feature of every object.

    Memory is that of one view and of pairs of objects that share a cell. The result depends neither
    on the order of the views nor on the number of threads.

    Args:
        gaussians: The Gaussians of the scene.
        views: Those whose features are used.
        evidence: Their feature maps, as `lift.mass.features.uplift_features` takes them.
        objects: Which object each Gaussian is of; -1 is none.
        backend: Name of the rendering backend.
        progress: Called with the views done and all there are.

    Raises:
        InputError: If there are no objects or no views, one has no features, or a feature is not
            finite.
        ShapeError: If a grid does not fit its photograph, or widths differ between views.
    """
    if len(objects) != len(gaussians):
        raise ShapeError(f"objects: expected {len(gaussians)} rows, got {len(objects)}.")
    ids = torch.unique(objects.ids.cpu().long())
    ids = ids[ids != UNLABELLED]
    if not len(ids):
        raise InputError("objects: expected a layer with at least one object, got one without.")
    ordered = voting_views(views, evidence, "features")
    model: MixingModel | None = None
    hard = Labels(ids=objects.ids, confidence=objects.confidence, background=UNLABELLED)
    for done, view in enumerate(ordered):
        grid = checked_grid(view, evidence.features(view.name))
        model = model or MixingModel(len(ids) + 1, grid.channels)
        if grid.channels != model.channels:
            raise ShapeError(
                f"evidence: expected {model.channels} channels of view {view.name}, as of "
                f"view {ordered[0].name}, got {grid.channels}."
            )
        _, camera = camera_of_grid(view, grid)
        found = label_map(gaussians, camera, hard, backend=backend).ids
        model.add(_rows_of(found, ids).numpy(), grid)
        if progress is not None:
            progress(done + 1, len(ordered))
    if model is None:
        raise InputError("views: expected at least one view with features, got none.")
    values, cells, blur, residual = model.solved()
    return ObjectFeatures(
        ids=ids,
        values=torch.from_numpy(values[:-1]).float(),
        cells=torch.from_numpy(cells[:-1]).float(),
        blur=blur,
        residual=residual,
    )


def _rows_of(ids: Tensor, known: Int64[Tensor, "k"]) -> Int64[Tensor, "height width"]:
    """Rows of ids among those known; all others, none too, are the row after the last."""
    flat = ids.cpu().long()
    row = torch.searchsorted(known, flat).clamp_max(len(known) - 1)
    return torch.where(known[row] == flat, row, len(known))


def cell_shares(
    rows: NDArray[np.int64], grid: FeatureMap
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Which objects a view shows, and their shares of the pixels of each cell.

    Args:
        rows: Of the object of every pixel, (height, width).
        grid: The cells; the last ones may reach over the edge, or be missing.

    Returns:
        Rows of objects (u,), ascending, and shares (cell rows, cell columns, u).
    """
    down, right = grid.features.shape[:2]
    there, local = np.unique(rows, return_inverse=True)
    index = pixel_cells(rows.shape, grid) * len(there) + local.reshape(rows.shape)
    counts = np.bincount(index.ravel(), minlength=down * right * len(there)).astype(np.float64)
    counts = counts.reshape(down, right, len(there))
    total = counts.sum(axis=2, keepdims=True)
    return there, counts / np.where(total > 0, total, 1.0)


def pixel_cells(size: tuple[int, ...], grid: FeatureMap) -> NDArray[np.int64]:
    """The cell of each pixel of a picture of this (height, width), row by row.

    Pixels beyond the last whole cell belong to it.
    """
    down, right = grid.features.shape[:2]
    row = np.minimum(np.arange(size[0]) // grid.stride, down - 1)
    column = np.minimum(np.arange(size[1]) // grid.stride, right - 1)
    return row[:, None] * right + column[None, :]


class MixingModel:
    """The mixing model of features that share cells, summed over views, for each of `BLURS`.

    Args:
        count: Objects, each a column; the last may stand for what no object has.
        channels: Width of a feature.
    """

    def __init__(self, count: int, channels: int) -> None:
        self.channels = channels
        self._systems = [_NormalEquations(count, channels) for _ in BLURS]

    def add(self, columns: NDArray[np.int64], grid: FeatureMap) -> None:
        """Take in the cells of a view.

        Args:
            columns: Column of the object of every pixel, (height, width).
            grid: The cells.
        """
        features = grid.features.double().cpu().flatten(0, 1).numpy()
        there, shares = cell_shares(columns, grid)
        for blur, system in zip(BLURS, self._systems, strict=True):
            system.add(there, _blurred(shares, blur), features)

    def solved(self) -> tuple[NDArray[np.float64], NDArray[np.float64], float, float]:
        """X (count, channels), the cells of each object, the blur, and the residual."""
        found = [system.solved() for system in self._systems]
        best = min(range(len(found)), key=lambda index: (found[index][1], index))
        values, residual = found[best]
        return values, self._systems[best].cells(), BLURS[best], residual


def _blurred(shares: NDArray[np.float64], blur: float) -> NDArray[np.float64]:
    """Shares of cells (rows, columns, objects) spread by a Gaussian of `blur` cells."""
    if blur <= 0:
        return shares
    once = gaussian_filter1d(shares, blur, axis=0, mode="nearest")
    return gaussian_filter1d(once, blur, axis=1, mode="nearest")


class _NormalEquations:
    """The normal equations for one blur, summed over views; float64, sparse, in one thread.

    Args:
        count: Objects, each a column.
        channels: Width of a feature.
    """

    def __init__(self, count: int, channels: int) -> None:
        self.channels = channels
        self._matrix: Any = sparse.csr_matrix((count, count), dtype=np.float64)
        self._right = np.zeros((count, channels))
        self._squares = 0.0
        self._features, self._cells = np.zeros(channels), 0

    def add(
        self,
        columns: NDArray[np.int64],
        shares: NDArray[np.float64],
        features: NDArray[np.float64],
    ) -> None:
        """Take in the cells of a view.

        Args:
            columns: (u,) columns of the objects that it shows.
            shares: (rows, columns, u) their shares of its cells, from `cell_shares`.
            features: (cells, channels), row by row.
        """
        dense = shares.reshape(-1, len(columns))
        local = sparse.csr_matrix(np.where(dense >= _MIN_SHARE, dense, 0.0))
        product = (local.T @ local).tocoo()
        self._matrix = self._matrix + sparse.csr_matrix(
            (product.data, (columns[product.row], columns[product.col])), self._matrix.shape
        )
        self._right[columns] += local.T @ features
        self._squares += float(np.square(features).sum())
        self._features += features.sum(axis=0)
        self._cells += len(features)

    def cells(self) -> NDArray[np.float64]:
        """The diagonal: the squares of the shares of each object, summed."""
        return np.asarray(self._matrix.diagonal(), dtype=np.float64)

    def solved(self) -> tuple[NDArray[np.float64], float]:
        """X (count, channels), and the share of the squares, in [0, 1], that is left over."""
        mean = self._features / max(self._cells, 1)
        count = len(self._right)
        factors = splu((self._matrix + RIDGE * sparse.identity(count)).tocsc())
        found = factors.solve(self._right + RIDGE * mean)
        product = self._matrix @ found
        left = self._squares - 2 * float((found * self._right).sum())
        left += float((found * product).sum())
        return found, max(0.0, left) / self._squares if self._squares > 0 else 0.0


METHOD = Method(
    name="objects",
    summary="each Gaussian takes the feature of its object, solved for all objects together",
    reference="linear spectral unmixing (Keshava and Mustard 2002), eq. 2",
    evidence=("features",),
    options=ObjectFeaturesOptions,
    run=run,
    returns="features",
    companions={"masks": ("masks", "panoptic", "tracked")},
    complete=False,
    words="span",
)
