r"""Features of several scales on Gaussians, by unprojection.

.. math:: f_{n,i} = \sum_{views} \sum_p w_{pi}\, f_n(p)

is equation 2 as printed, ``sum``. It is larger the more of a Gaussian is seen; ``mean`` divides it
by :math:`\sum w_{pi}`, ``pixels`` by the number of pixels in which the Gaussian takes part, the
counter of which the paper speaks. All but ``mean`` are then scaled so that the mean square of all
Gaussians is that of vectors of length 1.

References:
    Dou et al., CoSSegGaussians (2024), eq. 2.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatseg.core import Gaussians, View
from splatseg.lift.voting.features import FeatureUpliftOptions, uplift_features
from splatseg.lift.voting.uplift import voting_views
from splatseg.methods.cosseg._blocks import BlockSource, ReducedBlocks
from splatseg.render import RenderOptions, options_for, weights

Division = Literal["sum", "mean", "pixels"]

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
    components: int,
    division: Division,
    pixels: Int64[Tensor, "n"] | None = None,
    longest_side: int | None = None,
    render_options: RenderOptions | None = None,
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> DistilledFeatures:
    """Lift every block onto Gaussians, each view read once.

    Args:
        gaussians: The Gaussians of the scene.
        views: Those whose features are used.
        source: Their features.
        components: Channels that wider blocks are reduced to.
        division: What sums are divided by.
        pixels: Of `pixel_counts`, for ``pixels``; None counts them.
        longest_side: Longest side, in pixels, of the views through which features are seen.
        render_options: Switches of the blending model.
        backend: Name of the rendering backend.
        progress: Called with the views done and all there are.

    Raises:
        InputError: If there are no views, one has no features, or they differ in their blocks.
        ShapeError: If a grid does not fit its photograph, or widths differ between views.
    """
    ordered = voting_views(views, source, "features")
    reduced = ReducedBlocks(source, [view.name for view in ordered], components=components)
    lifted = uplift_features(
        gaussians,
        ordered,
        reduced,
        options=FeatureUpliftOptions(longest_side=longest_side),
        render_options=render_options,
        backend=backend,
        progress=progress,
    )
    seen = torch.ones(len(gaussians)) if lifted.weights is None else lifted.weights
    factor = torch.ones(len(gaussians)) if division == "mean" else seen.clone()
    if division == "pixels":
        if pixels is None:
            pixels = pixel_counts(
                gaussians, ordered, render_options=render_options, backend=backend
            )
        factor /= pixels.clamp_min(1)
    scales: list[Tensor] = []
    for columns in reduced.columns:
        values = lifted.values[:, columns] * factor[:, None]
        if division != "mean":
            size = float(values.square().sum(dim=1).mean().sqrt())
            values = values / max(size, 1e-30)
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
    render_options: RenderOptions | None = None,
    backend: str = "auto",
) -> Int64[Tensor, "n"]:
    """In how many pixels of all views each Gaussian takes part: the counter of eq. 2."""
    found = torch.zeros(len(gaussians), dtype=torch.int64)
    options = render_options or options_for(gaussians, backend)
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


def visible(counts: Int64[Tensor, "n"]) -> Bool[Tensor, "n"]:
    """Gaussians that take part in a pixel."""
    return counts > 0
