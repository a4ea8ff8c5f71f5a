r"""Features of objects, told apart where they share cells of feature maps.

A cell of a feature map shows several objects, and networks spread what they see over the cells
around it. A mug that is smaller than a cell never has one of its own: the mean over its pixels is
that of the desk. So the features x of all objects are solved for together:

.. math:: \min_x \sum_p \Bigl\| f_p - \sum_k a_{pk} x_k \Bigr\|^2
          + \lambda \sum_k \| x_k - \bar f \|^2, \qquad a = G_\sigma * s

over the cells p of all views, with :math:`s_{pk}` the share of object k in the pixels of cell p of
its rendered label map, blurred by a Gaussian of :math:`\sigma` cells, and :math:`\bar f` the mean
of all cells. What no object claims is one more. :math:`\sigma` is that of the least residual. It is
the linear mixing model of remote sensing, with known abundances and unknown endmembers.

References:
    Keshava and Mustard, Spectral Unmixing, IEEE Signal Processing Magazine 19 (2002), eq. 2.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int64
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_shape
from splatseg.core import UNLABELLED, FeatureMap, FeatureSource, Gaussians, Labels, View
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.lift.label_maps import label_map
from splatseg.lift.voting.features import camera_of_grid, checked_grid
from splatseg.lift.voting.uplift import voting_views
from splatseg.lift.words.unmixing import NormalEquations, blurred
from splatseg.render import RenderOptions

BLURS = (0.0, 0.5, 0.7, 1.0, 1.4, 2.0)
"""Standard deviations, in cells, of which the one with the least residual is taken."""


@dataclass(frozen=True, slots=True, kw_only=True)
class UnmixOptions:
    """How features of objects are solved for."""

    blur: float | None = None
    """Standard deviation, in cells, by which networks spread what they see. None: that of `BLURS`
    with the least residual."""

    ridge: float = 1.0
    """Lambda, in cells: an object that is in fewer is drawn to the mean of all."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.blur is not None and not 0 <= self.blur <= 100:
            raise RangeError(f"blur: expected 0 to 100 cells, got {self.blur}.")
        if not (math.isfinite(self.ridge) and self.ridge > 0):
            raise RangeError(f"ridge: expected above 0, got {self.ridge}.")


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

    def __post_init__(self) -> None:
        convert_fields(self)
        check_shape("values", self.values, (len(self.ids), None))
        check_shape("cells", self.cells, (len(self.ids),))

    @boundary
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
    options: UnmixOptions | None = None,
    render_options: RenderOptions | None = None,
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
        options: How they are solved for.
        render_options: Switches of the blending model.
        backend: Name of the rendering backend.
        progress: Called with the views done and all there are.

    Raises:
        InputError: If there are no objects or no views, one has no features, or a feature is not
            finite.
        ShapeError: If a grid does not fit its photograph, or widths differ between views.
    """
    options = options or UnmixOptions()
    if len(objects) != len(gaussians):
        raise ShapeError(f"objects: expected {len(gaussians)} rows, got {len(objects)}.")
    ids = torch.unique(objects.ids.cpu().long())
    ids = ids[ids != UNLABELLED]
    if not len(ids):
        raise InputError("objects: expected a layer with at least one object, got one without.")
    ordered = voting_views(views, evidence, "features")
    blurs = BLURS if options.blur is None else (options.blur,)
    systems: list[NormalEquations] = []
    hard = Labels(ids=objects.ids, confidence=objects.confidence, background=UNLABELLED)
    for done, view in enumerate(ordered):
        grid = checked_grid(view, evidence.features(view.name))
        features = grid.features.double().cpu().flatten(0, 1).numpy()
        if not systems:
            systems = [NormalEquations(len(ids) + 1, grid.channels) for _ in blurs]
        if grid.channels != systems[0].channels:
            raise ShapeError(
                f"evidence: expected {systems[0].channels} channels of view {view.name}, as of "
                f"view {ordered[0].name}, got {grid.channels}."
            )
        _, camera = camera_of_grid(view, grid)
        found = label_map(gaussians, camera, hard, options=render_options, backend=backend).ids
        columns, shares = cell_shares(_rows_of(found, ids).numpy(), grid)
        for blur, system in zip(blurs, systems, strict=True):
            system.add(columns, blurred(shares, blur), features)
        if progress is not None:
            progress(done + 1, len(ordered))
    solved = [system.solved(options.ridge) for system in systems]
    best = min(range(len(solved)), key=lambda index: (solved[index][1], index))
    values, residual = solved[best]
    return ObjectFeatures(
        ids=ids,
        values=torch.from_numpy(values[:-1]).float(),
        cells=torch.from_numpy(systems[best].cells()[:-1]).float(),
        blur=blurs[best],
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
