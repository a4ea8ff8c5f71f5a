r"""Features of several blocks of a network, brought to one width and length, on Gaussians.

As published, the class token of a view is joined to each of its patches, the two are reduced to 64
principal components, and these get length 1:

.. math:: f_n(p) = \frac{P_n (F_n(p) \oplus t - \mu_n)}{\| P_n (F_n(p) \oplus t - \mu_n) \|},
          \qquad n = 1 \dots 4

with :math:`P_n, \mu_n` of all patches of all views, found in one pass over them. Blocks that are no
wider than that, as recorded components are, keep their channels; without a class token patches
stand for themselves. Unprojection onto Gaussians is

.. math:: f_{n,i} = \frac{\sum_{views} \sum_p w_{pi}\, f_n(p)}{\sum_{views} \sum_p w_{pi}},

or as published, equation 2, divided by the number of pixels in which the Gaussian takes part, and
scaled so that the mean square of all Gaussians is that of vectors of length 1. (As it is printed
the sum is not divided; then it would be as large as its Gaussian is seen.)

References:
    Dou et al., CoSSegGaussians (2024), sections 3.2 and 4.1, "Multi-scale Features Setup", eq. 2.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float, Int64
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import normalize

from splatseg.core import LOCAL, Executor, FeatureMap, Gaussians, View
from splatseg.core.models import DeepFeatures
from splatseg.errors import InputError, ShapeError
from splatseg.lift.voting.features import FeatureUpliftOptions, uplift_features
from splatseg.lift.voting.uplift import voting_views
from splatseg.methods.cosseg.options import COMPONENTS, LIFTED_SIDE
from splatseg.render import RenderOptions, options_for, weights


class BlockSource(Protocol):
    """Features of views at several depths of a network."""

    @property
    def view_names(self) -> Sequence[str]:
        """Views that have features."""
        ...

    def deep_features(self, name: str) -> DeepFeatures:
        """Every block of a view, the shallowest first, and the class token."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Projection:
    """The principal components that a block is reduced to."""

    mean: Float[Tensor, "width"]
    axes: Float[Tensor, "width components"]
    """Orthonormal; the largest entry of each is positive."""


class ReducedBlocks:
    """All blocks of a view side by side, each reduced and of length 1.

    Args:
        source: The features.
        views: Names of the views that the components are found of.
        components: Channels that a wider block is reduced to, at least 1.

    Raises:
        InputError: If views differ in their blocks.
        ShapeError: If blocks differ in width between views, or in their grid within one.
    """

    def __init__(
        self, source: BlockSource, views: Sequence[str], *, components: int = COMPONENTS
    ) -> None:
        self._source = source
        first = source.deep_features(views[0])
        self.names: tuple[str, ...] = tuple(first.depths)
        """Names of the blocks, the shallowest first."""
        self._token = first.class_token is not None
        self._channels = tuple(grid.channels for grid in first.maps)
        self._components = components
        self._projections = self._fitted(views)

    @property
    def view_names(self) -> Sequence[str]:
        """Views that have features."""
        return self._source.view_names

    @property
    def columns(self) -> tuple[slice, ...]:
        """The channels of each block."""
        ends = np.cumsum([min(self._components, channels) for channels in self._channels]).tolist()
        return tuple(slice(a, b) for a, b in zip([0, *ends[:-1]], ends, strict=True))

    @property
    def steps(self) -> dict[str, bool]:
        """Which of the published steps there was anything to do for."""
        reduced = any(one is not None for one in self._projections)
        return {"class token": self._token and reduced, "principal components": reduced}

    def features(self, name: str) -> FeatureMap:
        """The blocks of a view, one after the other along the channels."""
        found = self._checked(name)
        parts: list[Tensor] = []
        for index, values in enumerate(self._joined(found)):
            projection = self._projections[index]
            if projection is not None:
                values = (values - projection.mean) @ projection.axes
            parts.append(normalize(values, dim=-1))
        grid = found.maps[0]
        return FeatureMap(
            features=torch.cat(parts, dim=-1),
            stride=grid.stride,
            height=grid.height,
            width=grid.width,
        )

    def _joined(self, found: DeepFeatures) -> list[Tensor]:
        """Patches of each block, with the class token where blocks are to be reduced."""
        parts: list[Tensor] = []
        for grid in found.maps:
            values = grid.features.float().cpu()
            if found.class_token is not None and grid.channels > self._components:
                token = found.class_token.float().cpu().expand(*values.shape[:2], -1)
                values = torch.cat((values, token), dim=-1)
            parts.append(values)
        return parts

    def _checked(self, name: str) -> DeepFeatures:
        found = self._source.deep_features(name)
        if tuple(found.depths) != self.names:
            raise InputError(
                f"evidence: expected the blocks {', '.join(self.names)} of view {name}, got "
                f"{', '.join(found.depths)}."
            )
        if (found.class_token is not None) != self._token:
            raise InputError(
                f"evidence: expected {'a' if self._token else 'no'} class token of view {name}, "
                "as of the others."
            )
        grids = {(one.features.shape[:2], one.stride, one.height, one.width) for one in found.maps}
        if len(grids) != 1:
            raise ShapeError(
                f"evidence: expected blocks of view {name} on one grid, got {len(grids)} grids."
            )
        for depth, channels, one in zip(found.depths, self._channels, found.maps, strict=True):
            if one.channels != channels:
                raise ShapeError(
                    f"evidence: expected {channels} channels of {depth} of view {name}, as of "
                    f"the others, got {one.channels}."
                )
        return found

    def _fitted(self, views: Sequence[str]) -> tuple[Projection | None, ...]:
        """Components of the blocks that are wider than they are to be."""
        wide = [
            index for index, channels in enumerate(self._channels) if channels > self._components
        ]
        moments = {index: _Moments() for index in wide}
        for name in views:
            if not wide:
                break
            joined = self._joined(self._checked(name))
            for index in wide:
                moments[index].add(joined[index].flatten(0, 1).numpy())
        return tuple(
            moments[index].projection(self._components) if index in moments else None
            for index in range(len(self._channels))
        )


class _Moments:
    """Mean and covariance of vectors that come in pieces."""

    def __init__(self) -> None:
        self._count = 0
        self._origin: NDArray[np.float64] = np.zeros(0)
        self._sum: NDArray[np.float64] = np.zeros(0)
        self._products: NDArray[np.float64] = np.zeros((0, 0))

    def add(self, rows: NDArray[np.float32]) -> None:
        """More vectors, one a row."""
        values = rows.astype(np.float64)
        if not self._count:
            # Sums of what is left of the first piece's mean lose no digits to it.
            self._origin = values.mean(axis=0)
            self._sum = np.zeros(values.shape[1])
            self._products = np.zeros((values.shape[1], values.shape[1]))
        values -= self._origin
        self._count += len(values)
        self._sum += values.sum(axis=0)
        self._products += values.T @ values

    def projection(self, components: int) -> Projection:
        """The axes of largest variance."""
        mean = self._sum / max(self._count, 1)
        covariance = self._products / max(self._count, 1) - np.outer(mean, mean)
        _, axes = np.linalg.eigh(covariance)
        axes = axes[:, ::-1][:, :components]
        largest = np.abs(axes).argmax(axis=0)
        axes = axes * np.where(axes[largest, np.arange(axes.shape[1])] < 0, -1.0, 1.0)
        return Projection(
            mean=torch.from_numpy((self._origin + mean).astype(np.float32)),
            axes=torch.from_numpy(np.ascontiguousarray(axes).astype(np.float32)),
        )


_ROWS = 1 << 16
"""Pixels whose entries are counted at a time."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DistilledFeatures:
    """What 2D features say of Gaussians."""

    scales: tuple[Float[Tensor, "n channels"], ...]
    """float16, one array a block, the shallowest first; zeros where nothing was seen."""

    weights: Float[Tensor, "n"]
    """Blending weight in all pixels of all views, summed."""

    names: tuple[str, ...]
    """Names of the blocks."""

    steps: dict[str, bool]
    """Which of the published steps there was anything to do for."""


def distilled_features(
    gaussians: Gaussians,
    views: Sequence[View],
    source: BlockSource,
    *,
    pixels: Int64[Tensor, "n"] | None = None,
    backend: str = "auto",
    executor: Executor = LOCAL,
    progress: Callable[[int, int], None] | None = None,
) -> DistilledFeatures:
    """Lift every block onto Gaussians, each view read once.

    Args:
        gaussians: The Gaussians of the scene.
        views: Those whose features are used.
        source: Their features.
        pixels: What sums are divided by, of `pixel_counts`; None divides by blending weights.
        backend: Name of the rendering backend.
        executor: Where the views are worked on; the features do not depend on it.
        progress: Called with the views done and all there are.

    Raises:
        InputError: If there are no views, one has no features, or they differ in their blocks.
        ShapeError: If a grid does not fit its photograph, or widths differ between views.
    """
    ordered = voting_views(views, source, "features")
    reduced = ReducedBlocks(source, [view.name for view in ordered])
    lifted = uplift_features(
        gaussians,
        ordered,
        reduced,
        options=FeatureUpliftOptions(longest_side=LIFTED_SIDE),
        backend=backend,
        executor=executor,
        progress=progress,
    )
    seen = torch.ones(len(gaussians)) if lifted.weights is None else lifted.weights
    scales: list[Tensor] = []
    for columns in reduced.columns:
        values = lifted.values[:, columns]
        if pixels is not None:
            values = values * (seen / pixels.clamp_min(1))[:, None]
            values = values / max(float(values.square().sum(dim=1).mean().sqrt()), 1e-30)
        scales.append(values.half())
    return DistilledFeatures(
        scales=tuple(scales),
        weights=seen,
        names=reduced.names,
        steps=reduced.steps,
    )


def pixel_counts(
    gaussians: Gaussians,
    views: Sequence[View],
    *,
    backend: str = "auto",
) -> Int64[Tensor, "n"]:
    """In how many pixels of all views each Gaussian takes part: the counter of eq. 2."""
    found = torch.zeros(len(gaussians), dtype=torch.int64)
    options = options_for(gaussians, backend)
    for view in views:
        found += view_pixel_counts(gaussians, view, options, backend)
    return found


def view_pixel_counts(
    gaussians: Gaussians, view: View, options: RenderOptions, backend: str
) -> Int64[Tensor, "n"]:
    """In how many pixels of a view each Gaussian takes part."""
    camera = view.camera
    found = torch.zeros(len(gaussians), dtype=torch.int64)
    flat = torch.arange(camera.height * camera.width)
    for start in range(0, len(flat), _ROWS):
        part = flat[start : start + _ROWS]
        asked = torch.stack((part % camera.width, part // camera.width), dim=-1)
        with torch.no_grad():
            rows = weights(gaussians, camera, asked, options=options, backend=backend)
        found += torch.bincount(rows.ids.long().cpu(), minlength=len(gaussians))
    return found
