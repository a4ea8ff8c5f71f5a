r"""Features of pixels onto the voxels that their rays hit.

.. math:: f_v = \frac{\sum_{views} \sum_p h_{pv} F_p}{\sum_{views} \sum_p h_{pv}}

with :math:`h_{pv}` 1 for the first voxel that the ray of pixel p hits (section 3.4 of the paper),
the transmittance that reaches it for several voxels of a ray, or the sum of the weights of W over
the Gaussians that lie nearest to it. Large objects need not outweigh small ones: with means of
views each view counts once for a voxel, however many of its pixels hit it. Instead of means, voxels
may be solved for together (`lift.voxels.solving`).

References:
    End-to-End Pipeline for Open-Vocabulary Semantic Novel View Synthesis with 3D Gaussians,
    sections 3.2 to 3.4.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Float, Float64, Int32, Int64
from torch import Tensor

from splatseg._check import check_choice, check_range, check_shape
from splatseg._native import add_hit_features
from splatseg.core import UNLABELLED, FeatureMap, FeatureSource, Gaussians, View
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.voxels import VoxelGrid
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.lift.voting.features import Taps, camera_of_grid, checked_grid, grid_taps, read_grid
from splatseg.lift.voting.uplift import RenderAdjoint, voting_views
from splatseg.lift.voxels.grid import MAX_HITS, GridIndex
from splatseg.lift.voxels.solving import VoxelMixing, parts_of
from splatseg.render import options_for

HitRule = Literal["first", "several", "weights", "solved"]
_CHANNELS = 64
"""Channels whose sums onto Gaussians are held at a time, with the weights of W."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HitOptions:
    """Which voxels a pixel's feature goes to, and how they are averaged."""

    hits: HitRule = "first"
    """first: the first voxel that the ray hits. several: the first ones, each by the light that
    reaches and stops in it. weights: by the weights with which Gaussians make the pixel, to the
    voxels that they lie nearest to. solved: voxels that share cells of feature maps are told apart,
    all together, with neighbours that look alike alike."""

    max_hits: int = 4
    """With several: voxels of a ray, at most."""

    average: Literal["hits", "views"] = "hits"
    """hits: every pixel counts. views: every view counts once for a voxel."""

    blur: float = 1.0
    """With solved: standard deviation by which networks spread what they see, in cells of their
    feature maps."""

    smoothness: float = 0.7
    """With solved: how much a voxel is like its neighbours; 1 counts as much as a whole cell."""

    near: float = 0.01
    """Distance at which rays begin, scene units."""

    far: float | None = None
    """Distance at which they end, scene units. None is nowhere."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_choice("hits", self.hits, get_args(HitRule))
        check_choice("average", self.average, ("hits", "views"))
        if not 1 <= self.max_hits <= MAX_HITS:
            raise RangeError(f"max_hits: expected 1 to {MAX_HITS}, got {self.max_hits}.")
        check_range("blur", self.blur, 0.0, 100.0)
        check_range("smoothness", self.smoothness, 0.0, 1e6)
        far = float("inf") if self.far is None else self.far
        if not 0 <= self.near < far:
            raise RangeError(f"near, far: expected 0 <= near < far, got {self.near} and {far}.")


_FAR = 1e9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LiftedVoxels:
    """Features of voxels, and what they rest on."""

    values: Float[Tensor, "m channels"]
    """Means; zeros where nothing was hit."""

    totals: Float64[Tensor, "m"]
    """Weight of the hits, or with means of views their number; 0 where nothing was hit."""


@boundary
def lift_to_voxels(
    grid: VoxelGrid,
    views: Sequence[View],
    evidence: FeatureSource,
    *,
    options: HitOptions | None = None,
    depths: Float[Tensor, "m"] | None = None,
    gaussians: Gaussians | None = None,
    rows: Int64[Tensor, "n"] | None = None,
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> LiftedVoxels:
    """Give voxels the mean of the features whose rays hit them.

    Each view's features are read once; memory is that of the sums, float32, and of one view. Views
    are summed in the order of their names, and a voxel's pixels in theirs, so that the result does
    not depend on the number of threads.

    Args:
        grid: The voxels.
        views: Those whose features are used.
        evidence: Their feature maps, of any width.
        options: Which voxels a feature goes to.
        depths: With several hits: optical depth of each voxel along its side
            (`optical_depths`).
        gaussians: With weights: the Gaussians of the scene.
        rows: With weights: the voxel of each Gaussian, -1 for none.
        backend: With weights: name of the rendering backend.
        progress: Called with the steps done and all there are, one a view, and with solved some
            more.

    Raises:
        InputError: If there are no views, one has no features, a feature is not finite, or what
            the rule needs is not given.
        ShapeError: If a grid of features does not fit its photograph, or widths differ.
    """
    options = options or HitOptions()
    if options.hits == "several" and depths is None:
        raise InputError("depths: expected the optical depth of each voxel, got none.")
    if options.hits in ("weights", "solved") and (gaussians is None or rows is None):
        raise InputError("gaussians, rows: expected Gaussians and their voxels, got none.")
    ordered = voting_views(views, evidence, "features")
    index = GridIndex(grid) if options.hits in ("first", "several") else None
    sums: _Sums | None = None
    mixing: VoxelMixing | None = None
    channels, steps = None, len(ordered)
    for done, view in enumerate(ordered):
        features = checked_grid(view, evidence.features(view.name))
        channels = features.channels if channels is None else channels
        if features.channels != channels:
            raise ShapeError(
                f"evidence: expected {channels} channels of view {view.name}, as of "
                f"view {ordered[0].name}, got {features.channels}."
            )
        if gaussians is not None and rows is not None and options.hits == "solved":
            check_shape("rows", rows, (len(gaussians),))
            mixing = mixing or VoxelMixing(
                grid=grid,
                gaussians=gaussians,
                rows=rows,
                blur=options.blur,
                smoothness=options.smoothness,
                channels=channels,
                backend=backend,
            )
            mixing.add(view, features)
        else:
            sums = sums or _Sums(voxels=len(grid), channels=channels, options=options)
            if index is not None:
                sums.add_rays(view, features, index, depths)
            elif gaussians is not None and rows is not None:
                sums.add_weights(view, features, gaussians, rows, backend)
        steps = len(ordered) + (0 if mixing is None else parts_of(channels))
        if progress is not None:
            progress(done + 1, steps)
    if mixing is not None:
        values, totals = mixing.solved(
            lambda part: None if progress is None else progress(len(ordered) + part, steps)
        )
        return LiftedVoxels(values=values, totals=totals)
    if sums is None:
        raise InputError("views: expected at least one view with features, got none.")
    return sums.means()


class _Sums:
    """Weighted features of voxels, and weights, summed over views."""

    def __init__(self, *, voxels: int, channels: int, options: HitOptions) -> None:
        self.values = torch.zeros(voxels, channels)
        self._totals = torch.zeros(voxels, dtype=torch.float64)
        self._options = options

    def means(self) -> LiftedVoxels:
        """The sums over the weights; they are not to be added to any more."""
        counted = torch.where(self._totals > 0, self._totals, 1.0).float()
        self.values /= counted[:, None]
        return LiftedVoxels(values=self.values, totals=self._totals)

    def add_rays(
        self, view: View, grid: FeatureMap, index: GridIndex, depths: Tensor | None
    ) -> None:
        """Add what the rays of a view hit."""
        options = self._options
        covered, camera = camera_of_grid(view, grid)
        origin, directions = camera.rays()
        several = options.hits == "several"
        hits, weights = index.trace(
            origin,
            directions.reshape(-1, 3),
            hits=options.max_hits if several else 1,
            depths=depths if several else None,
            near=options.near,
            far=_FAR if options.far is None else options.far,
        )
        down, right = (
            _packed(grid_taps(count, pixels / grid.stride, size))
            for count, pixels, size in (
                (grid.features.shape[0], covered[0], camera.height),
                (grid.features.shape[1], covered[1], camera.width),
            )
        )
        features = grid.features.float().cpu().contiguous()
        by_view = options.average == "views"
        add_hit_features(*down, *right, hits, weights, features, by_view, self.values, self._totals)

    def add_weights(
        self, view: View, grid: FeatureMap, gaussians: Gaussians, rows: Tensor, backend: str
    ) -> None:
        """Add W transposed times the features of a view, summed over the Gaussians of a voxel."""
        check_shape("rows", rows, (len(gaussians),))
        covered, camera = camera_of_grid(view, grid)
        adjoint = RenderAdjoint(
            gaussians=gaussians, options=options_for(gaussians, backend), backend=backend
        )
        there = torch.nonzero(rows != UNLABELLED).squeeze(1)
        features = grid.features.float().cpu()
        factor: Tensor | None = None
        with adjoint.prepared(camera) as prepared:
            for start in range(0, grid.channels, _CHANNELS):
                part = slice(start, start + _CHANNELS)
                image = read_grid(
                    features[..., part],
                    cells=(covered[0] / grid.stride, covered[1] / grid.stride),
                    size=(camera.height, camera.width),
                )
                sums, weights = adjoint.back_project(prepared, image)
                if factor is None:
                    factor = self._counted(weights[there], rows[there])
                added = torch.zeros(len(self.values), sums.shape[1])
                added.index_add_(0, rows[there], sums[there])
                self.values[:, part] += added * factor[:, None]

    def _counted(self, weights: Tensor, target: Tensor) -> Float[Tensor, "m"]:
        """Add the weights of a view to the totals; gives what its sums are multiplied by."""
        seen = torch.zeros_like(self._totals)
        seen.index_add_(0, target, weights.double())
        if self._options.average == "hits":
            self._totals += seen
            return torch.ones(len(seen))
        self._totals += (seen > 0).double()
        return torch.where(seen > 0, 1 / torch.where(seen > 0, seen, 1.0), 0.0).float()


def _packed(taps: Taps) -> tuple[Int32[Tensor, "2 pixels"], Float[Tensor, "pixels"]]:
    first, second, weight = taps
    return torch.stack((first, second)).to(torch.int32).contiguous(), weight.float().contiguous()


@boundary
def optical_depths(
    grid: VoxelGrid, gaussians: Gaussians, rows: Int64[Tensor, "n"]
) -> Float[Tensor, "m"]:
    r"""Optical depth of each voxel along its side, of the Gaussians that lie in or nearest to it.

    A Gaussian of opacity o whose cross-section is a share a of a side of the cell (at most 1) lets
    :math:`1 - o a` of the light pass that goes through the cell, so that

    .. math:: \tau = -\sum_i \log(1 - o_i a_i)

    Args:
        grid: The voxels.
        gaussians: The Gaussians of the scene.
        rows: The voxel of each, -1 for none.
    """
    check_shape("rows", rows, (len(gaussians),))
    scales = gaussians.scales.detach().cpu().double().sort(dim=1, descending=True).values
    # Area of the ellipse of one standard deviation, seen from its broad side.
    area = torch.pi * scales[:, 0] * scales[:, 1] / grid.size**2
    stopped = gaussians.opacities.detach().cpu().double().reshape(-1) * area.clamp_max(1.0)
    depth = -torch.log1p(-stopped.clamp_max(0.999))
    found = torch.zeros(len(grid), dtype=torch.float64)
    there = rows != UNLABELLED
    found.index_add_(0, rows[there], depth[there])
    return found.float()
