r"""What is measured of every mask before training: how large it is in the picture and in 3D.

The scale of a mask is how far its surface points spread,

.. math:: s = \bigl\| 2 \, \mathrm{std}(X) \bigr\|, \qquad
          X = \{\text{world points of the mask's pixels}\},

by the rendered depth and each view's own camera; the rim is eroded first, where depth mixes what is
in front with what is behind. Scales become ranks in [0, 1] among all masks.

References:
    The published code of Segment Any 3D Gaussians, version 2; and Kim et al., GARField (2024).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float64
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import Gaussians, MaskSet, View, camera_of_map
from splatseg.lift.affinity import QUANTILES, scale_rank
from splatseg.lift.training import MaskSets
from splatseg.methods.associate import AssociatedMasks
from splatseg.methods.saga._association import (
    GROUP_SCALE,
    OBJECT_SCALE,
    PART_SCALE,
    LevelMasks,
    level_masks,
    level_scales,
)
from splatseg.render import RenderOptions, options_for, render

INSIDE = 0.9
"""Share of a mask that lies in another where it counts as inside it."""

SMALLER = 0.75
"""Share of the other's area that it has at most: two masks of one thing hold no other."""

MIN_ALPHA = 0.5
"""Pixels that show less than this of the scene have no depth to go by."""

_ERODED = 5
"""Of the nine pixels around a pixel and itself, how many are in an eroded mask's."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MaskTable:
    """The masks of all views, numbered through in the order of the views."""

    first: Mapping[str, int]
    """The number of each view's first mask."""

    areas: Float[Tensor, "masks"]
    """Share of its view that each covers, in [0, 1]."""

    scales: Float64[Tensor, "masks"]
    """Scale of each, scene units; the median where no pixel has depth."""

    ranks: Float[Tensor, "masks"]
    """Scales in [0, 1]: ranks by size, or levels."""

    quantiles: Float64[Tensor, "quantiles"] | None
    """Percentiles of scales, see `AffinityHead.scale_quantiles`; None of levels."""

    levels: tuple[float, float, float]
    """Median ranks of masks that hold others, of those that neither hold nor are held or do
    both, and of those that are held: groups, objects and parts. The median of all, 0.5, where
    there are none."""

    nodes: LevelMasks | None = None
    """What masks are at each level, where scales are levels."""

    def __len__(self) -> int:
        return len(self.areas)

    def by_level(self, found: AssociatedMasks) -> "MaskTable":
        """With the levels of associated masks as scales."""
        names = sorted(self.first, key=lambda name: self.first[name])
        nodes = np.concatenate([np.zeros(0, dtype=np.int64), *(found.nodes[n] for n in names)])
        return replace(
            self,
            ranks=level_scales(found.tree, torch.from_numpy(nodes), self.scales),
            nodes=level_masks(found.tree, torch.from_numpy(nodes)),
            quantiles=None,
            levels=(GROUP_SCALE, OBJECT_SCALE, PART_SCALE),
        )


def mask_table(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: MaskSets,
    *,
    render_options: RenderOptions | None = None,
    backend: str = "auto",
) -> MaskTable:
    """Measure the masks of some views.

    Args:
        gaussians: The Gaussians of the scene.
        views: In the order in which masks are numbered.
        evidence: The masks.
        render_options: Switches of the blending model.
        backend: Name of the rendering backend.
    """
    chosen = render_options or options_for(gaussians, backend)
    first: dict[str, int] = {}
    areas, scales, roles = [], [], []
    count = 0
    for view in views:
        masks = evidence.masks(view.name)
        first[view.name] = count
        count += len(masks)
        dense = [masks.dense(i).numpy() for i in range(len(masks))]
        points, known = _world_points(gaussians, view, masks, chosen, backend)
        scales += [mask_scale(mask, points, known) for mask in dense]
        areas += [float(mask.mean()) if mask.size else 0.0 for mask in dense]
        roles.append(_roles(dense))
    spread = np.asarray(scales, dtype=np.float64)
    measured = spread[np.isfinite(spread)]
    measured = measured if len(measured) else np.zeros(1)
    spread[~np.isfinite(spread)] = float(np.median(measured))
    quantiles = torch.from_numpy(np.percentile(measured, np.linspace(0, 100, QUANTILES)))
    ranks = np.asarray([scale_rank(quantiles, scale) for scale in spread.tolist()])
    role = np.concatenate([np.zeros(0, dtype=np.int64), *roles])
    return MaskTable(
        first=first,
        areas=torch.tensor(areas, dtype=torch.float32),
        scales=torch.from_numpy(spread),
        ranks=torch.from_numpy(ranks.astype(np.float32)),
        quantiles=quantiles,
        levels=_levels(ranks, role),
    )


def mask_scale(
    mask: NDArray[np.bool_], points: NDArray[np.float64], known: NDArray[np.bool_]
) -> float:
    """The scale of one mask, scene units; NaN where none of its pixels has depth.

    Args:
        mask: The pixels, (height, width). Where erosion would leave none, it is left out.
        points: World points of all pixels, (height, width, 3).
        known: Which of them have depth.
    """
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return float("nan")
    box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    padded = np.pad(mask[box].astype(np.int8), 1)
    height, width = mask[box].shape
    around = sum(padded[i : i + height, j : j + width] for i in range(3) for j in range(3))
    eroded = mask[box] & (np.asarray(around) >= _ERODED)
    inside = (eroded if eroded.any() else mask[box]) & known[box]
    if not inside.any():
        return float("nan")
    return float(np.linalg.norm(2 * points[box][inside].std(axis=0)))


def _world_points(
    gaussians: Gaussians, view: View, masks: MaskSet, options: RenderOptions, backend: str
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """World points of a view's pixels, in the size of its masks, and which of them have depth."""
    camera = camera_of_map(view, masks.height, masks.width)
    # Depth alone is asked for; one channel is the least that is rendered.
    signal = torch.zeros(len(gaussians), 1, device=gaussians.means.device)
    with torch.no_grad():
        drawn = render(gaussians, camera, signal, options=options, backend=backend, warp="nearest")
        depth = drawn.depth.detach().cpu().double()
        known = (drawn.alpha.detach().cpu() > MIN_ALPHA) & (depth > 0)
        points = camera.unproject(camera.pixel_centres(), torch.where(known, depth, 1.0))
    return points.double().numpy(), known.numpy()


def _roles(dense: Sequence[NDArray[np.bool_]]) -> NDArray[np.int64]:
    """For each mask of a view: 2 if it holds others, 0 if it is held by one, 1 if both or none."""
    if not dense:
        return np.zeros(0, dtype=np.int64)
    # Every second pixel is enough to tell what lies in what.
    small = torch.from_numpy(np.stack([mask[::2, ::2].reshape(-1) for mask in dense])).float()
    shared = (small @ small.T).numpy()
    area = np.maximum(np.diagonal(shared), 1.0)
    held = (shared >= INSIDE * area[:, None]) & (area[:, None] <= SMALLER * area[None, :])
    role = np.ones(len(dense), dtype=np.int64)
    role[held.any(axis=0)] += 1
    role[held.any(axis=1)] -= 1
    return role


def _levels(ranks: NDArray[np.float64], roles: NDArray[np.int64]) -> tuple[float, float, float]:
    found = [ranks[roles == role] for role in (2, 1, 0)]
    group, middle, part = (float(np.median(some)) if len(some) else 0.5 for some in found)
    return group, middle, part
