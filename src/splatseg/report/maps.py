"""Scenes from above: labelled points of a drive, and cameras with what they saw."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from torch import Tensor

from splatseg.core import ClassTable, Gaussians, View
from splatseg.report.colours import Colour, colour_of
from splatseg.report.images import Gallery, GalleryImage

_LONG, _SHORT = 1200, 160
"""Longest side of a picture, and the least that the other may be, pixels."""

_PAPER: Colour = (28, 29, 34)
_DIM: Colour = (62, 63, 70)
_OUTLIERS = 0.002
"""Share of the points at either end of an axis that the picture may leave out."""


class LabelledPoints:
    """Some of the points of many scans, evenly, with their ids: as many as a picture needs.

    Which points are kept depends on their numbers alone.

    Args:
        limit: How many are kept, at most.
    """

    def __init__(self, limit: int = 400_000) -> None:
        self._limit, self._step, self._seen = limit, 1, 0
        self._rows: list[Tensor] = []
        self._points: list[Tensor] = []
        self._ids: list[Tensor] = []
        self._truth: list[Tensor] = []

    def add(
        self,
        points: Float[Tensor, "n 3"],
        ids: Int[Tensor, "n"],
        *,
        truth: Int[Tensor, "n"] | None = None,
    ) -> None:
        """Take the points of a scan, world, with their ids and true ids, -1 where they have none.

        Without `truth` no point of the scan has one.
        """
        true = torch.full((len(points),), -1, dtype=torch.int32) if truth is None else truth
        rows = torch.arange(self._seen, self._seen + len(points))
        self._seen += len(points)
        kept = rows % self._step == 0
        self._rows.append(rows[kept])
        self._points.append(points.detach().cpu()[kept].double())
        self._ids.append(ids.detach().cpu()[kept].int())
        self._truth.append(true.detach().cpu()[kept].int())
        while sum(map(len, self._rows)) > self._limit:
            self._step *= 2
            stays = [part % self._step == 0 for part in self._rows]
            for held in (self._rows, self._points, self._ids, self._truth):
                held[:] = [part[some] for part, some in zip(held, stays, strict=True)]

    @property
    def points(self) -> Float[Tensor, "n 3"]:
        """Those that were kept."""
        return torch.cat(self._points) if self._points else torch.zeros(0, 3, dtype=torch.float64)

    @property
    def ids(self) -> Int[Tensor, "n"]:
        """Their ids."""
        return torch.cat(self._ids) if self._ids else torch.zeros(0, dtype=torch.int32)

    @property
    def truth(self) -> Int[Tensor, "n"]:
        """Their true ids, -1 where scans brought none."""
        return torch.cat(self._truth) if self._truth else torch.zeros(0, dtype=torch.int32)


def point_map(
    points: Float[Tensor, "n 3"],
    ids: Int[Tensor, "n"],
    colours: ClassTable | None,
    *,
    up: tuple[float, float, float],
) -> UInt8[Tensor, "height width 3"]:
    """Points in the colours of their ids from above, the highest over those below.

    The longer way of the drive runs across. Points without a label are dim, and under all others.

    Args:
        points: World, scene units; at least one.
        ids: Of each, -1 for none.
        colours: Of the ids.
        up: Away from the ground, of any length but 0.
    """
    places: NDArray[np.float64] = points.detach().cpu().double().numpy()
    right, deep, above = _ground_axes(places, np.array(up, np.float64))
    flat = np.stack((places @ right, places @ deep), axis=1)
    low, high = np.quantile(flat, (_OUTLIERS, 1 - _OUTLIERS), axis=0)
    # Room for the points at the rim, and for a drive of one point.
    span = np.maximum(high - low, 1e-6) * 1.04
    middle = (low + high) / 2
    scale = _LONG / max(float(span.max()), 1e-6)
    width, height = (max(_SHORT, min(_LONG, math.ceil(scale * side))) for side in span.tolist())
    at = np.floor((flat - middle) * (scale, -scale) + (width / 2, height / 2)).astype(np.int64)
    canvas = np.full((height, width, 3), _PAPER, np.uint8)
    known = ids.detach().cpu().numpy() >= 0
    order = np.lexsort((places @ above, known))
    present, index = np.unique(ids.detach().cpu().numpy(), return_inverse=True)
    tone_of = [_DIM if id < 0 else colour_of(int(id), colours) for id in present]
    palette = np.array(tone_of, np.uint8)
    tones = palette[index.reshape(-1)][order]
    # Few points are drawn larger.
    dot = min(5, max(1, round(0.8 * (width * height / max(len(places), 1)) ** 0.5)))
    for across, downwards in np.ndindex(dot, dot):
        x, y = at[order, 0] + across - dot // 2, at[order, 1] + downwards - dot // 2
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        canvas[y[inside], x[inside]] = tones[inside]
    return torch.from_numpy(canvas)


def _ground_axes(
    places: NDArray[np.float64], up: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Right, deep and up: the places lie along the first as widely as they can."""
    length = float(np.linalg.norm(up))
    above = up / length if length > 1e-9 else np.array((0.0, 0.0, 1.0))
    ground = np.eye(3) - np.outer(above, above)
    some = places[:: max(1, len(places) // 20_000)]
    # Of places that are equal any direction on the ground will do.
    flat = np.vstack(((some - some.mean(axis=0)) @ ground, 1e-6 * ground))
    right: NDArray[np.float64] = np.linalg.svd(flat, full_matrices=False)[2][0]
    right = right * (1.0 if right[np.abs(right).argmax()] > 0 else -1.0)
    return right, np.cross(above, right), above


# Where cameras stood and what they saw, from above and from the side.


_SIZE, _FINE = 560, 2
"""Width and height of a map, pixels; it is drawn finer and then reduced."""

_MAX_POINTS = 200_000
_SOLID = 0.3
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
    above = -standing.poses[:, 1, :3].mean(axis=0) if up is None else np.array(up, np.float64)
    axes = np.stack(_ground_axes(standing.eyes, above))
    points, colours = _points(gaussians)
    maps: list[GalleryImage] = []
    for side in ("above", "side"):
        chart = _Map.around(points, standing, axes=axes, side=side)
        canvas = chart.canvas(points, colours, highest=float((standing.eyes @ axes[2]).max()))
        maps.append(GalleryImage(chart.with_cameras(canvas, standing)))
    return Gallery(
        "Cameras and points",
        ("from above", "from the side"),
        (("", tuple(maps)),),
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
