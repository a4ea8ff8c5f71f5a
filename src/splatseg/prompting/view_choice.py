"""A few views of many: those that look at what matters, spread over the scene."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import Gaussians, View

_NEAR = 1e-6
_MAX_POINTS = 5_000
"""Points that are projected to find out what a view looks at."""


def choose_views(
    gaussians: Gaussians, views: Sequence[View], weights: Float[Tensor, "n"], *, most: int
) -> list[View]:
    """At most `most` views that have Gaussians of positive weight in their image.

    The first is the one with the most weight in its image, occlusion aside. Each further one is
    where that weight, relative to the largest, times the distance to the nearest view chosen
    already is largest. In the order of choice; none where no view has any weight.

    Args:
        gaussians: The Gaussians of the scene.
        views: To choose from.
        weights: How much each Gaussian matters, 0 or more.
        most: At least 1.
    """
    rows, heavy = _sample(weights.detach().double().cpu())
    points = gaussians.means.detach().cpu()[rows].double()
    shown = torch.tensor([_weight_in_image(view, points, heavy) for view in views])
    candidates = torch.nonzero(shown > 0).squeeze(1)
    if len(candidates) <= most:
        order = torch.argsort(shown[candidates], descending=True, stable=True)
        return [views[int(i)] for i in candidates[order]]
    centres = torch.stack([view.camera.centre.double() for view in views])[candidates]
    worth = shown[candidates] / shown.max()
    chosen = [int(worth.argmax())]
    distance = torch.linalg.vector_norm(centres - centres[chosen[0]], dim=1)
    while len(chosen) < most:
        score = worth * distance
        score[chosen] = -1
        chosen.append(int(score.argmax()))
        further = torch.linalg.vector_norm(centres - centres[chosen[-1]], dim=1)
        distance = torch.minimum(distance, further)
    return [views[int(candidates[i])] for i in chosen]


def _sample(weights: Tensor) -> tuple[Tensor, Tensor]:
    """Rows that stand for all, and their weights: quantiles of the weight, rows in order."""
    rows = torch.nonzero(weights > 0).squeeze(1)
    if len(rows) <= _MAX_POINTS:
        return rows, weights[rows]
    cumulative = torch.cumsum(weights[rows], dim=0)
    share = cumulative[-1] / _MAX_POINTS
    targets = (torch.arange(_MAX_POINTS, dtype=torch.float64) + 0.5) * share
    chosen = torch.searchsorted(cumulative, targets).clamp_max(len(rows) - 1)
    return rows[chosen], share.expand(_MAX_POINTS)


def _weight_in_image(view: View, points: Tensor, weights: Tensor) -> float:
    """Weight of the points in a view's image. Lens distortion is that of the camera's model."""
    camera = view.camera
    pixels, depth = camera.project(points)
    inside = (depth > _NEAR) & (pixels >= 0).all(dim=1)
    inside &= (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
    return float(weights[inside].sum())
