"""How well start points agree with cameras: their colours in the photographs, and their places.

Two measures that fail in different ways. Colours: a point in the right place has the colour of
the pixels it projects to; hidden views spoil some, so that what counts is how much more often
than by chance (colours dealt out anew among the same points) they agree. Places: matches
triangulated by the cameras lie on the surfaces that the start points lie on.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import Camera, PointCloud, View
from splatseg.io.images import load_image
from splatseg.neighbours import NeighbourIndex

Array = NDArray[np.float64]

_SAME_COLOUR = 0.08
"""Mean difference of the three channels up to which a pixel has a point's colour."""

_NEAR = 0.02
"""Distance to the nearest start point, as a share of the depth, that counts as the same place."""


_PLACES = 2000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointScore:
    """What the photographs say of start points under some cameras."""

    colour: float | None
    """Agreement beyond chance (kappa): 0 is chance, 1 is all. None without colours."""

    position: float | None
    """Share of triangulated matches that have a start point next to them. None without matches."""

    seen: float
    """Share of the points that lie in front of and inside at least two views."""

    @property
    def value(self) -> float:
        """One number: colours where seen, and places, averaged over what is known."""
        parts = [p for p in (self.colour, self.position) if p is not None]
        known = sum(parts) / len(parts) if parts else 0.0
        return known * min(1.0, 2.0 * self.seen)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Photographs:
    """Reduced photographs of some views, kept in memory."""

    views: tuple[int, ...]
    images: tuple[Tensor, ...]
    """(3, h, w) float32 in [0, 1]."""


def load_photographs(views: Sequence[View], chosen: Sequence[int], *, longest: int) -> Photographs:
    """The photographs of chosen views, reduced (area-weighted)."""
    images = tuple(
        load_image(views[i], longest=longest).permute(2, 0, 1).float() / 255 for i in chosen
    )
    return Photographs(views=tuple(chosen), images=images)


def sample_points(cloud: PointCloud, max_points: int, *, seed: int = 0) -> PointCloud:
    """At most `max_points` points, drawn at random."""
    if len(cloud) <= max_points:
        return cloud
    rng = np.random.default_rng(seed)
    index = torch.from_numpy(np.sort(rng.permutation(len(cloud))[:max_points]))
    colours = None if cloud.colours is None else cloud.colours[index]
    return PointCloud(points=cloud.points[index], colours=colours)


def colour_score(
    photographs: Photographs, cameras: Sequence[Camera], cloud: PointCloud, *, seed: int = 0
) -> tuple[float | None, float]:
    """Agreement of colours beyond chance, and the share of points that two views or more see.

    Args:
        photographs: Some views of the capture.
        cameras: Cameras of all views of the capture.
        cloud: Points to look at, in the world of the cameras.
        seed: Of how colours are dealt out to tell what chance gives.
    """
    points = cloud.points.double()
    colours = None if cloud.colours is None else cloud.colours.float() / 255
    rng = np.random.default_rng(seed)
    shuffled = torch.from_numpy(rng.permutation(len(points)))
    count = torch.zeros(len(points))
    agreed = torch.zeros(2)
    pairs = 0
    for view, image in zip(photographs.views, photographs.images, strict=True):
        camera = cameras[view]
        pixels, depth = camera.project(points)
        inside = (depth > 1e-9) & (pixels >= 0).all(dim=1)
        inside &= (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
        index = inside.nonzero()[:, 0]
        count[index] += 1
        if colours is None or not len(index):
            continue
        size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
        grid = (2 * pixels[index] / size - 1).float()
        seen = torch.nn.functional.grid_sample(
            image[None], grid[None, None], align_corners=False, padding_mode="border"
        )[0, :, 0].T
        pairs += len(index)
        for k, order in enumerate((index, shuffled[index])):
            difference = (seen - colours[order]).abs().mean(dim=1)
            agreed[k] += (difference < _SAME_COLOUR).sum()
    share = float((count >= 2).double().mean()) if len(points) else 0.0
    if colours is None:
        return None, share
    if pairs == 0:
        return 0.0, share
    right, chance = (agreed / pairs).tolist()
    return (right - chance) / max(1 - chance, 1e-6), share


def position_score(triangulated: Array, depth: Array, points: Array) -> float | None:
    """Share of triangulated places with a start point nearer than 2 % of their depth."""
    if len(triangulated) < 50 or len(points) == 0:
        return None
    if len(triangulated) > _PLACES:
        index = np.random.default_rng(0).permutation(len(triangulated))[:_PLACES]
        triangulated, depth = triangulated[index], depth[index]
    found = NeighbourIndex(torch.from_numpy(points)).nearest(
        torch.from_numpy(triangulated), 1, max_distance=_NEAR * float(depth.max())
    )
    return float((found.distances[:, 0].numpy() < _NEAR * depth).mean())
