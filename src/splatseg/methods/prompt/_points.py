r"""Points of masks: where they are taken, and the points of the world that they are.

A point of a view becomes one of the world by (Prompt SA-GS, eq. 6)

.. math:: \arg\min_\mu \{ d(\mu) : d(\mu) > 0,\; \| P \mu - p \|_1 < \varepsilon \}

the nearest centre of a Gaussian that projects close to it. That may be a centre that nobody sees:
of a faint Gaussian before the object, or of one that another thing hides. With ``weight`` it is the
point on its ray at the depth of the Gaussian that has most blending weight in its row of W.

Inside a mask, the first point is the one farthest from the rim; each further one is where the
lesser of its distance to the rim and half the distance to the points before is largest.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatseg.core import Gaussians, View
from splatseg.core.boundary import boundary
from splatseg.methods.prompt._options import Lifting, PointSampling
from splatseg.render import PreparedView

_AROUND = (0.5, 2.0)
"""Distance of points around a mask from it, in radii of its largest circle."""

_TIE = 1e-3

_MIN_AROUND = 3.0
"""The same in pixels, at least: recorded masks are ragged."""


@boundary
def points_inside(
    mask: Bool[Tensor, "height width"],
    count: int,
    *,
    how: PointSampling = "inside",
    generator: torch.Generator | None = None,
) -> Float[Tensor, "k 2"]:
    """Points of a mask, x and y of pixel centres; fewer where it has fewer pixels.

    Args:
        mask: The mask.
        count: How many.
        how: See `PromptOptions.sampling`.
        generator: Of random ones.
    """
    if how == "random":
        return _random(mask, count, generator)
    return _spread(_distance(mask), mask, count)


@boundary
def points_around(
    mask: Bool[Tensor, "height width"],
    count: int,
    *,
    how: PointSampling = "inside",
    generator: torch.Generator | None = None,
) -> Float[Tensor, "k 2"]:
    """Points close to a mask and not in it, far from each other; none where there is no room.

    Args:
        mask: The mask.
        count: How many.
        how: ``random`` takes any in the band around the mask.
        generator: Of random ones.
    """
    if not count or not bool(mask.any()):
        return torch.zeros(0, 2)
    import cv2

    radius = float(_distance(mask).max())
    away = torch.from_numpy(
        cv2.distanceTransform((~mask).numpy().astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    )
    near, far = (max(factor * radius, _MIN_AROUND) for factor in _AROUND)
    band = (away >= near) & (away <= max(far, near + 1))
    if not bool(band.any()):
        return torch.zeros(0, 2)
    if how == "random":
        return _random(band, count, generator)
    return _spread(torch.full(mask.shape, float("inf")), band, count)


def _distance(mask: Tensor) -> Float[Tensor, "height width"]:
    """Distance of each pixel to the nearest outside the mask; the picture's edge is a rim."""
    import cv2

    padded = np.pad(mask.numpy().astype(np.uint8), 1)
    found = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return torch.from_numpy(found[1:-1, 1:-1].copy())


def _random(mask: Tensor, count: int, generator: torch.Generator | None) -> Tensor:
    pixels = torch.nonzero(mask)
    chosen = torch.randperm(len(pixels), generator=generator)[:count]
    return pixels[chosen].flip(1).float() + 0.5


def _spread(room: Tensor, mask: Tensor, count: int) -> Tensor:
    """Pixels far from the rim and from each other."""
    rows, columns = torch.nonzero(mask, as_tuple=True)
    score = room[rows, columns].clone()
    if bool(torch.isinf(score).all()):
        # Without a rim the first is the one farthest from the middle.
        x, y = columns.float(), rows.float()
        score = torch.hypot(x - x.mean(), y - y.mean())
        room = torch.full_like(room, float("inf"))
    limit = room[rows, columns]
    chosen: list[int] = []
    nearest = torch.full_like(score, float("inf"))
    for _ in range(min(count, len(rows))):
        # Of equal places the one farthest from all before.
        further = torch.minimum(limit, nearest / 2) + _TIE * nearest
        at = int((further if chosen else score).argmax())
        if chosen and nearest[at] <= 0:
            break
        chosen.append(at)
        away = torch.hypot((columns - columns[at]).float(), (rows - rows[at]).float())
        nearest = torch.minimum(nearest, away)
    index = torch.tensor(chosen, dtype=torch.int64)
    return torch.stack((columns[index], rows[index]), dim=1).float() + 0.5


@boundary
def lifted(
    view: View,
    prepared: PreparedView,
    gaussians: Gaussians,
    pixels: Float[Tensor, "p 2"],
    *,
    how: Lifting = "weight",
    tolerance: float = 10.0,
) -> tuple[Float[Tensor, "p 3"], Int64[Tensor, "p"]]:
    """Points of the world that pixels show, float64, and the Gaussian of each, -1 for none.

    Args:
        view: The view.
        prepared: The same, prepared.
        gaussians: The Gaussians of the scene.
        pixels: x and y.
        how: See `PromptOptions.lifting`.
        tolerance: Epsilon of eq. 6, pixels.
    """
    pixels = pixels.double()
    if how == "centre":
        return _nearest_centres(view, gaussians, pixels, tolerance)
    strongest = prepared.contributors(pixels.floor().long(), 1).ids[:, 0].cpu().long()
    centres = gaussians.means.detach().cpu().double()[strongest.clamp_min(0)]
    _, depth = view.camera.project(centres)
    usable = (strongest >= 0) & (depth > 0)
    points = view.camera.unproject(pixels, torch.where(usable, depth, 1.0))
    return points, torch.where(usable, strongest, -1)


def _nearest_centres(
    view: View, gaussians: Gaussians, pixels: Tensor, tolerance: float
) -> tuple[Tensor, Tensor]:
    """Eq. 6."""
    means = gaussians.means.detach().cpu().double()
    projected, depth = view.camera.project(means)
    before = torch.nonzero(depth > 0).squeeze(1)
    projected, depth = projected[before], depth[before]
    found = torch.full((len(pixels),), -1, dtype=torch.int64)
    for row, pixel in enumerate(pixels):
        close = torch.nonzero((projected - pixel).abs().sum(dim=1) < tolerance).squeeze(1)
        if len(close):
            found[row] = before[close[depth[close].argmin()]]
    return means[found.clamp_min(0)], found
