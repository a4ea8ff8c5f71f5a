r"""Which views words are looked for in and points are projected into, and the points themselves.

Prompt SA-GS clusters views by where they are and how they are turned: k-means over

.. math:: x_j = \bigl((c_j - \bar c) / r,\; \mathrm{vec}(R_j)\bigr), \qquad
          r^2 = \tfrac{1}{N} \sum_j \| c_j - \bar c \|^2

with :math:`c_j` the centre of view j and :math:`R_j` its rotation; the view nearest to the centre
of each cluster is taken. Positions are taken from their mean, so that the origin does not matter.

A point of a view becomes one of the world by (Prompt SA-GS, eq. 6)

.. math:: \arg\min_\mu \{ d(\mu) : d(\mu) > 0,\; \| P \mu - p \|_1 < \varepsilon \}

the nearest centre of a Gaussian that projects close to it. That may be a centre that nobody sees:
of a faint Gaussian before the object, or of one that another thing hides. With ``weight`` it is the
point on its ray at the depth of the Gaussian that has most blending weight in its row of W.

Inside a mask, the first point is the one farthest from the rim; each further one is where the
lesser of its distance to the rim and half the distance to the points before is largest.

References:
    Prompt SA-GS (2024), section 4 and Table 1.
"""

import zlib
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import Gaussians, View
from splatseg.methods.prompt.options import InitialViews, Lifting, PointSampling
from splatseg.render import PreparedView

TOLERANCE = 10.0
"""Epsilon of eq. 6, in pixels, by the sum of both coordinates' differences."""

_ROUNDS = 100
_STARTS = 10


def initial_views(
    views: Sequence[View], *, how: InitialViews = "kmeans", count: int = 4, seed: int = 0
) -> tuple[View, ...]:
    """The views that words are looked for in, in the order of their names.

    Args:
        views: All views that may be used, at least one.
        how: See `PromptOptions.initial`.
        count: How many; all there are where they are fewer.
        seed: Of random choices.
    """
    ordered = sorted(views, key=lambda view: view.name)
    count = 1 if how == "single" else min(count, len(ordered))
    rng = np.random.default_rng(seed)
    if how == "random":
        chosen = rng.choice(len(ordered), count, replace=False)
    else:
        chosen = _nearest_to_centres(view_positions(ordered), count, rng)
    return tuple(ordered[index] for index in sorted(int(one) for one in chosen))


def view_positions(views: Sequence[View]) -> NDArray[np.float64]:
    """Position and rotation of each view, (views, 12)."""
    centres = np.stack([view.camera.centre.double().numpy() for view in views])
    rotations = np.stack(
        [view.camera.cam_from_world[:3, :3].double().numpy().ravel() for view in views]
    )
    centres = centres - centres.mean(axis=0)
    radius = np.sqrt(np.square(centres).sum(axis=1).mean())
    return np.concatenate((centres / max(radius, 1e-12), rotations), axis=1)


def _nearest_to_centres(
    points: NDArray[np.float64], count: int, rng: np.random.Generator
) -> list[int]:
    """The point nearest to each centre of k-means, of the best of some starts.

    Lloyd's steps in plain double sums: the result does not depend on the number of threads.
    """
    best, found = np.inf, [0]
    for _ in range(_STARTS):
        centres = _spread(points, count, rng)
        for _ in range(_ROUNDS):
            squares = _squares(points, centres)
            own = squares.argmin(axis=1)
            moved = np.stack(
                [
                    points[own == one].mean(axis=0) if (own == one).any() else centres[one]
                    for one in range(count)
                ]
            )
            if np.array_equal(moved, centres):
                break
            centres = moved
        squares = _squares(points, centres)
        total = float(squares.min(axis=1).sum())
        if total < best - 1e-12:
            best, found = total, _distinct(squares)
    return found


def _spread(
    points: NDArray[np.float64], count: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Starts of k-means++: each far from those before."""
    chosen = [int(rng.integers(len(points)))]
    while len(chosen) < count:
        squares = _squares(points, points[chosen]).min(axis=1)
        total = squares.sum()
        if total <= 0:
            chosen += [one for one in range(len(points)) if one not in chosen][:1]
            continue
        chosen.append(int(rng.choice(len(points), p=squares / total)))
    return points[chosen]


def _squares(points: NDArray[np.float64], centres: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.square(points[:, None] - centres[None]).sum(axis=2)


def _distinct(squares: NDArray[np.float64]) -> list[int]:
    """The nearest point of each centre, none twice."""
    taken: list[int] = []
    for column in squares.T:
        order = np.argsort(column, kind="stable")
        taken.append(next(int(one) for one in order if int(one) not in taken))
    return taken


def projected_views(
    views: Sequence[View],
    points: Float[Tensor, "k 3"],
    *,
    share: float,
    how: PointSampling = "inside",
    seed: int = 0,
) -> tuple[View, ...]:
    """The views that points are projected into, in the order of their names.

    Args:
        views: All views.
        points: Points of the object, world.
        share: Share of all views, in (0, 1]; at least one is taken.
        how: See `PromptOptions.sampling`.
        seed: Of random choices.
    """
    ordered = sorted(views, key=lambda view: view.name)
    count = max(1, int(share * len(ordered) + 0.5))
    if how == "random":
        rng = np.random.default_rng(seed)
        chosen = [int(one) for one in rng.choice(len(ordered), count, replace=False)]
    else:
        showing = [index for index, view in enumerate(ordered) if _shown(view, points) > 0]
        if len(showing) <= count:
            chosen = showing
        else:
            chosen = _covering([ordered[index] for index in showing], points, count)
            chosen = [showing[index] for index in chosen]
    return tuple(ordered[index] for index in sorted(chosen))


def _shown(view: View, points: Tensor) -> float:
    """Share of points that fall into the picture."""
    pixels, depth = view.camera.project(points.double())
    size = pixels.new_tensor([view.camera.width, view.camera.height])
    inside = (depth > 0) & ((pixels >= 0) & (pixels < size)).all(dim=1)
    return float(inside.double().mean())


def _covering(views: Sequence[View], points: Tensor, count: int) -> list[int]:
    """Views from directions as different as can be.

    First comes the one that shows most, then each time the one farthest from all before, by
    direction and the logarithm of distance.
    """
    middle = points.double().mean(dim=0)
    offsets = np.stack([(view.camera.centre.double() - middle).numpy() for view in views])
    distance = np.maximum(np.linalg.norm(offsets, axis=1), 1e-12)
    places = np.concatenate((offsets / distance[:, None], np.log(distance)[:, None]), axis=1)
    shown = np.array([_shown(view, points) for view in views])
    chosen = [int(np.lexsort((distance, -shown))[0])]
    nearest = np.square(places - places[chosen[0]]).sum(axis=1)
    while len(chosen) < count:
        # What shows only some of the points counts less.
        weighed = nearest * shown
        weighed[chosen] = -1
        chosen.append(int(weighed.argmax()))
        nearest = np.minimum(nearest, np.square(places - places[chosen[-1]]).sum(axis=1))
    return chosen


def seed_of(seed: int, text: str) -> int:
    """A seed for each text, whatever others are asked for."""
    return zlib.crc32(f"{seed}:{text}".encode())


_AROUND = (0.5, 2.0)
"""Distance of points around a mask from it, in radii of its largest circle."""

_TIE = 1e-3

_MIN_AROUND = 3.0
"""The same in pixels, at least: recorded masks are ragged."""


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
    return _spread_pixels(_distance(mask), mask, count)


def neighbouring_points(mask: Bool[Tensor, "height width"], count: int) -> Float[Tensor, "k 2"]:
    """Points close to a mask and not in it, far from each other; none where there is no room.

    Args:
        mask: The mask.
        count: How many.
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
    return _spread_pixels(torch.full(mask.shape, float("inf")), band, count)


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


def _spread_pixels(room: Tensor, mask: Tensor, count: int) -> Tensor:
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


def lifted(
    view: View,
    prepared: PreparedView,
    gaussians: Gaussians,
    pixels: Float[Tensor, "p 2"],
    *,
    how: Lifting = "weight",
) -> tuple[Float[Tensor, "p 3"], Int64[Tensor, "p"]]:
    """Points of the world that pixels show, float64, and the Gaussian of each, -1 for none.

    Args:
        view: The view.
        prepared: The same, prepared.
        gaussians: The Gaussians of the scene.
        pixels: x and y.
        how: See `PromptOptions.lifting`.
    """
    pixels = pixels.double()
    if how == "centre":
        return _nearest_centres(view, gaussians, pixels)
    strongest = prepared.contributors(pixels.floor().long(), 1).ids[:, 0].cpu().long()
    centres = gaussians.means.detach().cpu().double()[strongest.clamp_min(0)]
    _, depth = view.camera.project(centres)
    usable = (strongest >= 0) & (depth > 0)
    points = view.camera.unproject(pixels, torch.where(usable, depth, 1.0))
    return points, torch.where(usable, strongest, -1)


def _nearest_centres(view: View, gaussians: Gaussians, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Eq. 6."""
    means = gaussians.means.detach().cpu().double()
    projected, depth = view.camera.project(means)
    before = torch.nonzero(depth > 0).squeeze(1)
    projected, depth = projected[before], depth[before]
    found = torch.full((len(pixels),), -1, dtype=torch.int64)
    for row, pixel in enumerate(pixels):
        close = torch.nonzero((projected - pixel).abs().sum(dim=1) < TOLERANCE).squeeze(1)
        if len(close):
            found[row] = before[close[depth[close].argmin()]]
    return means[found.clamp_min(0)], found
