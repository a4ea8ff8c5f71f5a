"""Where cameras stood and what they saw, from above and from the side."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import UInt8
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from torch import Tensor

from splatseg.core import Gaussians, View
from splatseg.report.images import Gallery, GalleryImage
from splatseg.report.legend import Colour

_SIZE, _FINE = 560, 2
"""Width and height of a map, pixels; it is drawn finer and then reduced."""

_MAX_POINTS = 200_000
_SOLID = 0.3
_PAPER: Colour = (28, 29, 34)
_TRAIN: Colour = (255, 178, 64)
_HELD_OUT: Colour = (92, 200, 255)
_REACH = 0.035
"""Length of a camera on the map, in sides of the map."""


def camera_map(
    gaussians: Gaussians, views: Sequence[View], *, up: tuple[float, float, float] | None
) -> Gallery | None:
    """Two maps of the scene with its cameras; None where there are no views.

    Args:
        gaussians: The scene.
        views: With their cameras.
        up: Away from the ground; None takes the mean of what is up in the views.
    """
    if not views:
        return None
    standing = _Cameras.of(views)
    axes = _axes(standing, up)
    points, colours = _points(gaussians)
    maps: list[GalleryImage] = []
    for side in ("above", "side"):
        chart = _Map.around(points, standing, axes=axes, side=side)
        canvas = chart.canvas(points, colours, highest=float((standing.eyes @ axes[2]).max()))
        maps.append(GalleryImage(image=chart.with_cameras(canvas, standing)))
    return Gallery(
        title="Cameras and points",
        columns=("from above", "from the side"),
        rows=(("", tuple(maps)),),
        note="Gaussians in their colours, training cameras orange, held-out ones blue; each opens "
        "towards what it saw. From above, what is higher than the highest camera is left out.",
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Cameras:
    poses: NDArray[np.float64]
    """(views, 4, 4) cam_from_world."""

    eyes: NDArray[np.float64]
    """(views, 3) their centres."""

    views: Sequence[View]

    @staticmethod
    def of(views: Sequence[View]) -> "_Cameras":
        poses = np.stack([view.camera.cam_from_world.double().cpu().numpy() for view in views])
        eyes = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
        return _Cameras(poses=poses, eyes=eyes, views=views)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Map:
    """A parallel projection of the scene onto a square."""

    axes: NDArray[np.float64]
    """Rows: right, deep, up."""

    side: str
    middle: NDArray[np.float64]
    span: float
    """Width of the map, scene units."""

    @staticmethod
    def around(
        points: NDArray[np.float64], cameras: _Cameras, *, axes: NDArray[np.float64], side: str
    ) -> "_Map":
        """A map that holds all cameras, and all but the outermost of the points."""
        shown = [0, 1] if side == "above" else [0, 2]
        standing = (cameras.eyes @ axes.T)[:, shown]
        low, high = standing.min(axis=0), standing.max(axis=0)
        if len(points):
            few = (points[:: max(1, len(points) // 20_000)] @ axes.T)[:, shown]
            inner, outer = np.quantile(few, (0.01, 0.99), axis=0)
            low, high = np.minimum(low, inner), np.maximum(high, outer)
        span = 1.12 * max(float((high - low).max()), 1e-9)
        return _Map(axes=axes, side=side, middle=(low + high) / 2, span=span)

    def pixels(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """(..., 2) where points of the world are on the map."""
        shown = (places @ self.axes.T)[..., [0, 1] if self.side == "above" else [0, 2]]
        flat = (shown - self.middle) / self.span
        return _SIZE * _FINE * np.stack((0.5 + flat[..., 0], 0.5 - flat[..., 1]), axis=-1)

    def canvas(
        self, points: NDArray[np.float64], colours: NDArray[np.uint8], *, highest: float
    ) -> NDArray[np.uint8]:
        """The points, those in front over those behind."""
        size = _SIZE * _FINE
        canvas = np.full((size, size, 3), _PAPER, dtype=np.uint8)
        depth = points @ self.axes[1] if self.side == "side" else -(points @ self.axes[2])
        order = np.argsort(-depth, kind="stable")
        if self.side == "above":
            order = order[-depth[order] <= highest]
        at = self.pixels(points[order]).astype(int)
        # Few points are drawn larger.
        dot = min(6, max(2, round(0.9 * size / max(len(points), 1) ** 0.5)))
        for across, downwards in np.ndindex(dot, dot):
            x, y = at[:, 0] + across, at[:, 1] + downwards
            inside = (x >= 0) & (x < size) & (y >= 0) & (y < size)
            canvas[y[inside], x[inside]] = colours[order][inside]
        return canvas

    def with_cameras(
        self, canvas: NDArray[np.uint8], cameras: _Cameras
    ) -> UInt8[Tensor, "height width 3"]:
        """The canvas with a small pyramid for each camera, reduced to its final size."""
        picture = Image.fromarray(canvas)
        draw = ImageDraw.Draw(picture)
        for pose, eye, view in zip(cameras.poses, cameras.eyes, cameras.views, strict=True):
            corners = eye + _REACH * self.span * _cone(view) @ pose[:3, :3]
            tip = self.pixels(eye)
            ring = [tuple(spot) for spot in self.pixels(corners).tolist()]
            colour = _TRAIN if view.split == "train" else _HELD_OUT
            for one, other in zip(ring, [*ring[1:], ring[0]], strict=True):
                draw.line((*tip.tolist(), *one), fill=colour, width=_FINE)
                draw.line((*one, *other), fill=colour, width=_FINE)
            draw.ellipse((*(tip - 3).tolist(), *(tip + 3).tolist()), fill=colour)
        small = picture.resize((_SIZE, _SIZE), Image.Resampling.BOX)
        return torch.from_numpy(np.array(small))


def _axes(cameras: _Cameras, up: tuple[float, float, float] | None) -> NDArray[np.float64]:
    """Rows: right, deep, up. The cameras lie along the first as widely as they can."""
    above = np.array(up) if up is not None else -cameras.poses[:, 1, :3].mean(axis=0)
    length = float(np.linalg.norm(above))
    above = above / length if length > 1e-9 else np.array((0.0, 0.0, 1.0))
    eyes = cameras.eyes
    flat = (eyes - eyes.mean(axis=0)) @ (np.eye(3) - np.outer(above, above))
    # Of equal cameras any direction on the ground will do.
    flat = np.vstack((flat, 1e-6 * (np.eye(3) - np.outer(above, above))))
    right = np.linalg.svd(flat, full_matrices=False)[2][0]
    right = right * (1.0 if right[np.abs(right).argmax()] > 0 else -1.0)
    return np.stack((right, np.cross(above, right), above)).astype(np.float64)


def _points(gaussians: Gaussians) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Centres and colours of what is solid, thinned evenly."""
    rows = torch.nonzero(gaussians.opacities.cpu() > _SOLID).squeeze(1)
    rows = rows[:: max(1, len(rows) // _MAX_POINTS)]
    colours = gaussians.colours.detach().cpu()[rows].clamp(0, 1) * 255 + 0.5
    return gaussians.means.detach().cpu()[rows].double().numpy(), colours.to(torch.uint8).numpy()


def _cone(view: View) -> NDArray[np.float64]:
    """The corners of the image, one unit in front of the camera, in its frame."""
    camera = view.camera
    corners = [(0, 0), (camera.width, 0), (camera.width, camera.height), (0, camera.height)]
    rays = [((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0) for x, y in corners]
    return np.array(rays)
