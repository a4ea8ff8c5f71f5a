"""Planes around a removed thing, and which parts of them no view saw.

A plane's part is kept in square cells (`Sheet`). Each view that saw the scene is asked at each
cell: does it look through the plane there, does it show the plane, or is the cell hidden.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import Camera, Gaussians, Selection, View
from splatseg.neighbours import NeighbourIndex
from splatseg.render import Rendered, render
from splatseg.render.warp import undistorted_camera

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LONGEST = 640
"""Longest side of the views as they are rendered here, pixels: cells are no finer than that."""

_RIM_VIEWS = 16
"""Views of the thing that give points and claim cells."""

_RIM_POINTS = 2000
"""Points of each of these."""

_SAMPLES, _NEAREST = 512, 48
"""Hypotheses of a plane, and the points of each: a patch of that many nearest points."""

_PLANES, _MIN_INLIERS, _REFITS = 10, 0.02, 3
"""Most planes, the least share of all points that one must have, and fits to its own points."""

THICKNESS = 4.0
"""Distance from a plane, in pixels of the views, at which a point is still on it: fits of 512 x
384 photographs scatter centres by about one."""

BELOW = 3.0
"""Distance behind a plane, in thicknesses, at which a view looks through it. Nothing is behind an
opaque surface, so that what is a little behind it is an error of depth; what is before it may be
another thing."""

_FAR = 20.0
"""Distance of the camera above a plane, in its longest sides: nearly parallel projection."""

MARGIN = 16
"""Cells around a hole that are drawn for the inpainting, half of them for labels."""

_MOST_CELLS = 384
"""Longest side of a plane's image."""

_SEEN = 0.5
"""Weight of the thing above which a pixel is its."""

FREE_VIEWS = 2
"""Views that must look through a cell before it counts as empty: depths err along outlines."""

KERNEL = np.ones((5, 5), np.uint8)
"""Cells that are taken together where single ones err."""


# What views show.


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """What a view showed before the removal and shows after it."""

    camera: Camera
    centre: Array
    rays: Array
    """World directions of the pixels, with 1 along the optical axis, (h, w, 3)."""

    thing: Mask
    """Pixels of the thing, (h, w)."""

    before: Array
    """z-depth of the surface, (h, w); infinite where there is none."""

    after: Array
    image: Array
    """Colours after the removal, (h, w, 3) in [0, 1]."""

    def points(self, depth: Array) -> Array:
        """Points at z-depths (h, w) or (n,) with rays alike."""
        return self.centre + self.rays * depth[..., None]

    def heights(self, plane: "Plane", depth: Array) -> Array:
        """Signed distances of points at z-depths, positive on the camera's side of the plane."""
        own = dot(self.centre, plane.normal) - plane.offset
        slope = dot(self.rays, plane.normal)
        with np.errstate(invalid="ignore"):
            found = own + slope * depth
        # Nothing at all is beyond any plane.
        found = np.where(np.isfinite(depth), found, -np.inf * np.sign(own))
        return found * np.sign(own)


@dataclass(frozen=True, slots=True, eq=False)
class Removal:
    """A scene and what is taken out of it."""

    gaussians: Gaussians
    removed: Selection
    backend: str

    @property
    def stays(self) -> Gaussians:
        """What is left."""
        return self.gaussians[~self.removed.mask]

    def before(self, camera: Camera) -> Rendered:
        """The thing's share of each pixel."""
        signal = self.removed.mask.to(self.gaussians.means)[:, None]
        with torch.no_grad():
            return render(self.gaussians, camera, signal, backend=self.backend)

    def look(self, camera: Camera) -> Look:
        """What a camera showed and shows."""
        drawn = self.before(camera)
        with torch.no_grad():
            left = render(self.stays, camera, backend=self.backend)
        ones = torch.ones(camera.height, camera.width, dtype=torch.float64)
        world = camera.unproject(camera.pixel_centres().double(), ones).numpy()
        centre = camera.centre.double().numpy()
        return Look(
            camera=camera,
            centre=centre,
            rays=world - centre,
            thing=(drawn.image[..., 0] > _SEEN).cpu().numpy(),
            before=_surface(drawn.median_depth),
            after=_surface(left.median_depth),
            image=_colours(left),
        )


def _colours(drawn: Rendered) -> Array:
    """Colours without the black behind what is not quite opaque."""
    alpha = drawn.alpha.clamp_min(_SEEN)[..., None]
    return (drawn.image / alpha).clamp(0, 1).cpu().double().numpy()


def _surface(depth: Tensor) -> Array:
    found = depth.cpu().double().numpy()
    return np.where(found > 0, found, np.inf)


def small_camera(view: View) -> Camera:
    """The pinhole camera of a view, not larger than needed."""
    camera = undistorted_camera(view.camera)
    share = min(1.0, _LONGEST / max(camera.width, camera.height))
    if share == 1:
        return camera
    return camera.resized(max(1, round(share * camera.width)), max(1, round(share * camera.height)))


def rim_cameras(scene: Removal, cameras: Sequence[Camera]) -> list[Camera]:
    """Cameras that see the thing, evenly chosen."""
    shown: list[Camera] = []
    for camera in cameras:
        small = camera.resized(max(1, camera.width // 4), max(1, camera.height // 4))
        if bool((scene.before(small).image[..., 0] > _SEEN).any()):
            shown.append(camera)
    return shown[:: -(-len(shown) // _RIM_VIEWS)] if shown else []


def rim_points(looks: Sequence[Look]) -> tuple[Array, float]:
    """Surface points around and behind the thing, (n, 3), and the size of a pixel there."""
    found: list[Array] = []
    sizes: list[Array] = []
    for look in looks:
        # As far around the thing as it is wide.
        reach = max(4, round(float(np.sqrt(look.thing.sum())) / 2))
        kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
        near = cv2.dilate(look.thing.astype(np.uint8), kernel).astype(np.bool_)
        near &= np.isfinite(look.after)
        index = np.flatnonzero(near)
        index = index[:: max(1, -(-len(index) // _RIM_POINTS))]
        depth = look.after.reshape(-1)[index]
        found.append(look.centre + look.rays.reshape(-1, 3)[index] * depth[:, None])
        sizes.append(look.before[look.thing] / look.camera.fx)
    sizes_all = np.concatenate(sizes)
    sizes_all = sizes_all[np.isfinite(sizes_all)]
    return np.concatenate(found), float(np.median(sizes_all)) if len(sizes_all) else 0.0


# Planes.


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """Points x with normal . x = offset, and those of them that were seen."""

    normal: Array
    offset: float
    points: Array


def dot(points: Array, vector: Array) -> Array:
    """Products without BLAS, whose sums depend on the number of threads."""
    return points[..., 0] * vector[0] + points[..., 1] * vector[1] + points[..., 2] * vector[2]


def _fitted(points: Array) -> tuple[Array, float]:
    """The plane of least squares through points (n, 3), n >= 3."""
    mean = points.mean(axis=0)
    away = points - mean
    spread = np.array([[(away[:, i] * away[:, j]).mean() for j in range(3)] for i in range(3)])
    normal = np.linalg.eigh(spread)[1][:, 0]
    return normal, float(dot(mean, normal))


def find_planes(points: Array, thickness: float) -> list[Plane]:
    """Planes through most of the points, one after another from those that are left."""
    found: list[Plane] = []
    rest = points
    least = max(_NEAREST, round(_MIN_INLIERS * len(points)))
    while len(found) < _PLANES and len(rest) >= least:
        index = NeighbourIndex(torch.from_numpy(rest))
        first = np.unique(np.linspace(0, len(rest) - 1, _SAMPLES).round().astype(np.int64))
        near = index.nearest(torch.from_numpy(rest[first]), _NEAREST).indices.numpy()
        best, inside = 0, np.zeros(len(rest), np.bool_)
        for patch in near:
            normal, offset = _fitted(rest[patch])
            close = np.abs(dot(rest, normal) - offset) < thickness
            count = int(close.sum())
            if count > best:
                best, inside = count, close
        if best < least:
            break
        normal, offset = _fitted(rest[inside])
        for _ in range(_REFITS):
            inside = np.abs(dot(rest, normal) - offset) < thickness
            if int(inside.sum()) < least:
                break
            normal, offset = _fitted(rest[inside])
        else:
            found.append(Plane(normal, offset, rest[inside]))
        # What lies a little further off is of the same surface and makes no plane of its own.
        rest = rest[np.abs(dot(rest, normal) - offset) >= BELOW * thickness]
    return found


# The images of planes.


@dataclass(slots=True, eq=False)
class Sheet:
    """A part of a plane in square cells, as a camera straight above it sees it."""

    plane: Plane
    camera: Camera
    size: float
    """Side of a cell, scene units."""

    thickness: float
    centres: Array
    """World points of the cells, (rows, columns, 3)."""

    colours: Array
    """Colours that views show there, weighted and summed, (rows, columns, 3)."""

    weights: Array
    """Sum of these weights, (rows, columns)."""

    free: NDArray[np.int32]
    """Views that look through each cell."""

    seen: NDArray[np.int32]
    """Views in which the surface is there."""

    shown: NDArray[np.int32]
    """Views that show something there or a little before it, which is not the thing."""

    hole: Mask
    """What is to be filled."""

    def observe(self, look: Look) -> None:
        """Count a view: where it looks through the plane, where it shows it, and how."""
        row, column, inside = pixels_of(look.camera, self.centres)
        height = look.heights(self.plane, look.before)[row, column]
        self.free += inside & (height < -BELOW * self.thickness)
        near = inside & (np.abs(height) <= BELOW * self.thickness) & ~look.thing[row, column]
        self.shown += near
        seen = near & (height <= self.thickness)
        self.seen += seen
        # Straight and near views show most: pixels of a cell go as cosine over squared distance.
        ray = self.centres - look.centre
        squared = dot(ray, self.plane.normal) ** 2
        weight = seen * squared / (ray**2).sum(axis=-1) ** 3
        self.weights += weight
        self.colours += weight[..., None] * look.image[row, column]

    @property
    def known(self) -> Mask:
        """Cells that views saw."""
        return (self.seen >= np.maximum(self.free, FREE_VIEWS)) & (self.weights > 0)

    @property
    def image(self) -> Array:
        """What views show of the plane, (rows, columns, 3) in [0, 1]; black where they do not."""
        return self.colours / np.where(self.weights > 0, self.weights, 1.0)[..., None]

    @property
    def hidden(self) -> Mask:
        """Cells that no view saw or looked through."""
        found = (self.free < FREE_VIEWS) & (self.shown < FREE_VIEWS)
        # Depths of faint texture err here and there.
        return cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_OPEN, KERNEL).astype(np.bool_)

    @property
    def possible(self) -> Mask:
        """Cells where the surface is, or may be."""
        return self.hidden | self.known

    def holds(self, points: Array, cells: Mask) -> Mask:
        """Which points (n, 3) lie on the surface in some of the cells."""
        row, column, inside = pixels_of(self.camera, points)
        height = dot(points, self.plane.normal) - self.plane.offset
        return inside & (np.abs(height) < self.thickness) & cells[row, column]

    def hits(self, look: Look) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
        """Row and column of the cell, and z-depth, where pixels (h, w) meet it; -1 beside it."""
        own = dot(look.centre, self.plane.normal) - self.plane.offset
        slope = dot(look.rays, self.plane.normal)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = -own / slope
        depth = np.where(np.isfinite(depth) & (depth > 0), depth, np.inf)
        points = look.points(np.where(np.isfinite(depth), depth, 0.0))
        row, column, inside = pixels_of(self.camera, points)
        inside &= np.isfinite(depth)
        return np.where(inside, row, -1), np.where(inside, column, -1), depth


def pixels_of(camera: Camera, points: Array) -> tuple[NDArray[np.int64], NDArray[np.int64], Mask]:
    """Row and column of the pixel that shows each point, and whether one does."""
    pose = camera.cam_from_world.double().numpy()
    x, y, z = (dot(points, pose[i, :3]) + pose[i, 3] for i in range(3))
    ahead = z > 0
    z = np.where(ahead, z, 1.0)
    column = np.floor(camera.fx * x / z + camera.cx)
    row = np.floor(camera.fy * y / z + camera.cy)
    inside = ahead & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    row, column = (np.where(inside, value, 0).astype(np.int64) for value in (row, column))
    return row, column, inside


def sheet_of(plane: Plane, looks: Sequence[Look], pixel: float) -> Sheet | None:
    """The part of a plane that the thing hid from some views; None where there is none."""
    thickness = THICKNESS * pixel
    across = _across(plane.normal)
    down = np.cross(-plane.normal, across)
    axes = (across, down)
    hidden: list[Array] = []
    for look in looks:
        slope = dot(look.rays, plane.normal)
        own = dot(look.centre, plane.normal) - plane.offset
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = -own / slope
        open_to = look.heights(plane, look.after) < thickness
        behind = look.heights(plane, look.before) > -BELOW * thickness
        good = look.thing & open_to & behind & np.isfinite(depth) & (depth > 0)
        hidden.append(look.centre + look.rays[good] * depth[good][:, None])
    points = np.concatenate(hidden)
    low, high = (
        np.array([bound(dot(plane.points, axis)) for axis in axes]) for bound in (np.min, np.max)
    )
    flat = np.stack([dot(points, axis) for axis in axes], axis=1)
    # A hole is among what was seen of the surface, not beyond it.
    flat = flat[((flat >= low) & (flat <= high)).all(axis=1)]
    if not len(flat):
        return None
    low, high = flat.min(axis=0), flat.max(axis=0)
    size = max(pixel, float((high - low).max()) / (_MOST_CELLS - 2 * MARGIN))
    columns, rows = (int(n) for n in np.ceil((high - low) / size).astype(int) + 2 * MARGIN)
    camera = _above(plane, axes, (low + high) / 2, (columns, rows), size)
    at = camera.pixel_centres().double()
    reach = torch.full(at.shape[:-1], camera.fx * size, dtype=torch.float64)
    centres = camera.unproject(at, reach).numpy()
    return Sheet(
        plane=plane,
        camera=camera,
        size=size,
        thickness=thickness,
        centres=centres,
        colours=np.zeros((rows, columns, 3)),
        weights=np.zeros((rows, columns)),
        free=np.zeros((rows, columns), np.int32),
        seen=np.zeros((rows, columns), np.int32),
        shown=np.zeros((rows, columns), np.int32),
        hole=np.zeros((rows, columns), np.bool_),
    )


def _across(normal: Array) -> Array:
    """A unit vector in the plane: along the axis that is nearest to lying in it."""
    axis = np.eye(3)[int(np.abs(normal).argmin())]
    found = axis - normal * float(dot(axis, normal))
    return found / np.sqrt(float(dot(found, found)))


def _above(
    plane: Plane, axes: tuple[Array, Array], middle: Array, cells: tuple[int, int], size: float
) -> Camera:
    """A camera far above the middle of a sheet, whose pixels are cells of this size on it."""
    rotation = np.stack((*axes, -plane.normal))
    distance = _FAR * max(cells) * size
    centre = axes[0] * middle[0] + axes[1] * middle[1] + plane.normal * (plane.offset + distance)
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = [-float(dot(centre, axis)) for axis in rotation]
    return Camera(
        width=cells[0],
        height=cells[1],
        fx=distance / size,
        fy=distance / size,
        cx=cells[0] / 2,
        cy=cells[1] / 2,
        cam_from_world=torch.from_numpy(pose),
    )
