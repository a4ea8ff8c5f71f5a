r"""Uplift of features: each Gaussian takes the mean of what its pixels show.

.. math:: f_i = \frac{\sum_{views} \sum_p w_{pi} F_p}{\sum_{views} \sum_p w_{pi}}

with :math:`F_p` the feature grid of the view, read at the centre of pixel p: the closed-form
solution to which gradient descent on rendered features is an approximation.

References:
    Marrie et al., LUDVIG: Learning-free Uplifting of 2D Visual features to Gaussian Splatting
    scenes (2024), eq. 4.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.core import (
    LOCAL,
    Camera,
    Executor,
    FeatureMap,
    Features,
    FeatureSource,
    Gaussians,
    LayerInfo,
    View,
    camera_of_map,
)
from splatseg.core.options import Count, options
from splatseg.errors import InputError, ShapeError
from splatseg.lift.voting.uplift import RenderAdjoint, voting_views
from splatseg.render import options_for

_CHANNELS = 64
"""Channels carried at a time, which bounds the memory of upsampled images."""


@options(
    removed={
        "norm": "features are summed as they are",
        "resampling": "pixels read the four cell centres around them",
        "min_weight": "weights of the layer say what a feature rests on",
        "channels": "64 are carried at a time",
    }
)
class FeatureUpliftOptions:
    """How feature maps become features of Gaussians."""

    longest_side: Count | None = None
    """Longest side, in pixels, of the views through which the features are seen; smaller is
    faster and a little blurred. None keeps the size of the evidence."""


def uplift_features(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: FeatureSource,
    *,
    options: FeatureUpliftOptions | None = None,
    backend: str = "auto",
    executor: Executor = LOCAL,
    progress: Callable[[int, int], None] | None = None,
) -> Features:
    """Give Gaussians the mean of the features that their pixels have.

    Each view's features are read once. Sums are float32, over the views in the order of their
    names, so the order they are given in does not matter.

    Args:
        gaussians: The Gaussians of the scene.
        views: Those whose features are used.
        evidence: Their feature maps: grids that cover the photograph, or the photograph reduced
            in proportion. A last row or column of cells may reach over the edge, or be missing.
        options: How features are normalised and read.
        backend: Name of the rendering backend.
        executor: Where the views are worked on; the layer does not depend on it.
        progress: Called with the views done and all there are.

    Returns:
        Values (n, channels) float32, zeros where nothing was seen, and the weights (n,) they
        rest on.

    Raises:
        InputError: If there are no views, one has no features, or a feature is not finite.
        ShapeError: If a grid does not fit its photograph, or widths differ between views.
    """
    options = options or FeatureUpliftOptions()
    ordered = voting_views(views, evidence, "features")
    adjoint = RenderAdjoint(
        gaussians=gaussians,
        options=options_for(gaussians, backend),
        backend=backend,
    )
    lifting = _Lifting(adjoint=adjoint, evidence=evidence, options=options)
    values, weights = _weighted_sums(lifting, ordered, executor, progress)
    seen = weights > 0
    values /= torch.where(seen, weights, 1.0).unsqueeze(1)
    values[~seen] = 0
    return Features(
        values=values,
        weights=weights,
        info=LayerInfo(
            method="uplift_features",
            options=asdict(options),
            views=tuple(view.name for view in ordered),
        ),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Lifting:
    """What features of all views are lifted with."""

    adjoint: RenderAdjoint
    evidence: FeatureSource
    options: FeatureUpliftOptions


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Sums:
    """Some channels of a view's features, summed on the Gaussians that it shows."""

    channels: slice
    width: int
    """Channels of the view's features."""

    gaussians: Int64[Tensor, "m"]
    """Those it shows."""

    values: Float[Tensor, "m some"]
    weights: Float[Tensor, "m"]
    """How much of each the view shows."""

    @property
    def is_last(self) -> bool:
        return self.channels.stop >= self.width


def _weighted_sums(
    lifting: _Lifting,
    ordered: Sequence[View],
    executor: Executor,
    progress: Callable[[int, int], None] | None,
) -> tuple[Tensor, Tensor]:
    """Features (n, channels) summed with blending weights over all views, and the weights (n,)."""
    count = len(lifting.adjoint.gaussians)
    weights = torch.zeros(count)
    values: Tensor | None = None
    done = 0
    with closing(executor.map(_view_sums, ordered, shared=lifting)) as found:
        for sums in found:
            if values is None:
                values = torch.zeros(count, sums.width)
            if sums.width != values.shape[1]:
                raise ShapeError(
                    f"evidence: expected {values.shape[1]} channels of view {ordered[done].name}, "
                    f"as of view {ordered[0].name}, got {sums.width}."
                )
            # What the view does not show gets nothing from it, which leaves its bits.
            values[:, sums.channels].index_put_((sums.gaussians,), sums.values, accumulate=True)
            if not sums.is_last:
                continue
            weights[sums.gaussians] += sums.weights
            done += 1
            if progress is not None:
                progress(done, len(ordered))
    if values is None:
        raise InputError("views: expected at least one view with features, got none.")
    return values, weights


def _view_sums(lifting: _Lifting, view: View) -> Iterator[_Sums]:
    """A view's weighted features, some channels at a time."""
    grid = checked_grid(view, lifting.evidence.features(view.name))
    covered, camera = camera_of_grid(view, grid)
    options, adjoint = lifting.options, lifting.adjoint
    if options.longest_side is not None:
        longest = max(camera.width, camera.height)
        if longest > options.longest_side:
            scale = options.longest_side / longest
            camera = camera.resized(
                max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
            )
    features = grid.features.float().cpu()
    with adjoint.prepared(camera) as prepared:
        for start in range(0, grid.channels, _CHANNELS):
            part = slice(start, start + _CHANNELS)
            image = read_grid(
                features[..., part],
                cells=(covered[0] / grid.stride, covered[1] / grid.stride),
                size=(camera.height, camera.width),
            )
            sums, weights = adjoint.back_project(prepared, image)
            shown = torch.nonzero(weights > 0).squeeze(1)
            yield _Sums(
                channels=part,
                width=grid.channels,
                gaussians=shown,
                values=sums[shown],
                weights=weights[shown],
            )


def read_grid(
    features: Float[Tensor, "rows columns c"], *, cells: tuple[float, float], size: tuple[int, int]
) -> Float[Tensor, "height width c"]:
    r"""An image of a grid of cells, read at the centres of pixels.

    With V cells over H rows of pixels, row y of the image lies at the grid's row

    .. math:: v = (y + \tfrac12) \frac{V}{H} - \tfrac12

    in units in which cell centres are whole numbers. Beyond the outermost centres the image
    keeps their values.

    Args:
        features: One feature a cell.
        cells: How many cells high and wide the image is; need not be whole, nor the grid's.
        size: Rows and columns of the image.
    """
    rows, columns = features.shape[:2]
    row_taps = grid_taps(rows, cells[0], size[0])
    column_taps = grid_taps(columns, cells[1], size[1])
    # First along the columns of the small grid, then down: the large image is written once.
    resampled = _blend(features, column_taps, dim=1)
    return _blend(resampled, row_taps, dim=0)


def read_features_at(
    view: View, grid: FeatureMap, *, size: tuple[int, int], pixels: Int64[Tensor, "p"]
) -> Float[Tensor, "p c"]:
    """A view's features at the centres of some pixels, bilinear between the centres of cells.

    Args:
        view: The view.
        grid: Its features, on a grid that covers the photograph.
        size: Rows and columns of the image that pixels are counted in, in proportion to the
            photograph.
        pixels: Numbers of pixels, row by row.

    Raises:
        InputError: If a feature is not finite.
        ShapeError: If the grid does not fit its photograph.
    """
    covered, _ = camera_of_grid(view, checked_grid(view, grid))
    cells = (covered[0] / grid.stride, covered[1] / grid.stride)
    features = grid.features.float().cpu()
    first_row, second_row, down = (
        taps[pixels // size[1]] for taps in grid_taps(features.shape[0], cells[0], size[0])
    )
    first, second, right = (
        taps[pixels % size[1]] for taps in grid_taps(features.shape[1], cells[1], size[1])
    )
    upper = torch.lerp(features[first_row, first], features[first_row, second], right[:, None])
    lower = torch.lerp(features[second_row, first], features[second_row, second], right[:, None])
    return torch.lerp(upper, lower, down[:, None])


Taps = tuple[Tensor, Tensor, Tensor]
"""Of each pixel along an axis the two cells that it reads, and the second one's weight."""


def grid_taps(count: int, cells: float, pixels: int) -> Taps:
    """The cells that pixels read along an axis, see `read_grid`.

    Args:
        count: Cells that there are.
        cells: Cells that the pixels cover; need not be whole, nor `count`.
        pixels: How many pixels there are.
    """
    position = (torch.arange(pixels, dtype=torch.float64) + 0.5) * (cells / pixels) - 0.5
    position = position.clamp(0, count - 1)
    first = position.floor().long()
    return first, (first + 1).clamp_max(count - 1), (position - first).float()


def _blend(image: Tensor, taps: Taps, *, dim: int) -> Tensor:
    first, second, second_weight = taps
    if not bool(second_weight.any()):
        return image.index_select(dim, first)
    shape = [1, 1, 1]
    shape[dim] = -1
    return torch.lerp(
        image.index_select(dim, first), image.index_select(dim, second), second_weight.view(shape)
    )


def camera_of_grid(view: View, grid: FeatureMap) -> tuple[tuple[int, int], Camera]:
    """Rows and columns of pixels that the grid counts its cells in, and their camera."""
    rows, columns = view.camera.height, view.camera.width
    # Whole cells over a photograph that they do not divide: a part of a cell more or less.
    covers = abs(grid.height - rows) < grid.stride and abs(grid.width - columns) < grid.stride
    if covers:
        return (rows, columns), view.camera
    return (grid.height, grid.width), camera_of_map(view, grid.height, grid.width)


def checked_grid(view: View, grid: FeatureMap) -> FeatureMap:
    """The features of a view, if they are finite and cover its photograph.

    Raises:
        InputError: If a feature is not finite.
        ShapeError: If the grid does not fit its photograph.
    """
    bad = ~torch.isfinite(grid.features)
    if bool(bad.any()):
        raise InputError(
            f"evidence: expected finite features of view {view.name}, "
            f"{int(bad.sum())} of {bad.numel()} values are NaN or infinite."
        )
    if grid.features.numel() == 0:
        raise ShapeError(
            f"evidence: expected at least one cell and channel of view {view.name}, "
            f"got shape {tuple(grid.features.shape)}."
        )
    rows, columns = grid.features.shape[:2]
    for name, cells, pixels in (("rows", rows, grid.height), ("columns", columns, grid.width)):
        if abs(cells * grid.stride - pixels) >= grid.stride:
            raise ShapeError(
                f"evidence: expected {name} of cells of {grid.stride} pixels that cover "
                f"{pixels} pixels of view {view.name}, got {cells}."
            )
    return grid
