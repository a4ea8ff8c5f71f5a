"""Surfaces continued behind a removed thing, where no view ever saw them.

What a thing hid is found in 3D and not in pictures: planes are fitted to what is visible around it,
and a cell of such a plane is filled if a view now looks at it through the removed thing, no view
saw it or through it, and the plane was seen along most of the border of the hole. A plane's own
Gaussians are rendered from straight above it, that one image is inpainted, and each of its cells
in the hole becomes a flat Gaussian. One image a plane, seen by all views, cannot disagree between
views.

References:
    Schnabel et al., Efficient RANSAC for Point-Cloud Shape Detection, CGF 2007: hypotheses from
    local samples, the largest plane first.
    Telea, An Image Inpainting Technique Based on the Fast Marching Method, JGT 2004.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Int64, UInt8
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from splatseg._check import check_shape
from splatseg.core import Camera, Gaussians, Labels, Layer, Selection, View, apply_rows
from splatseg.core.boundary import boundary
from splatseg.core.edited import NEW, Edited
from splatseg.core.instance_tree import InstanceTree
from splatseg.core.models import Inpainting
from splatseg.core.rigid import quaternion_from_rotation
from splatseg.core.sh import SH_C0
from splatseg.errors import InputError
from splatseg.models import find_model
from splatseg.neighbours import NeighbourIndex
from splatseg.render import Rendered, back_project, render
from splatseg.render.warp import undistorted_camera

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

OPENCV = "opencv"
"""Name of the inpainter that needs no weights."""

_LONGEST = 640
"""Longest side of the views as they are rendered here, pixels: cells are no finer than that."""

_MOST_VIEWS, _RIM_VIEWS = 96, 16
"""Views that may look through a plane, and views of the thing that give points and claim cells."""

_RIM_POINTS = 2000
"""Points of each of these."""

_SAMPLES, _NEAREST = 512, 48
"""Hypotheses of a plane, and the points of each: a patch of that many nearest points."""

_PLANES = 10
_MIN_INLIERS = 0.02
"""Most planes, and the least share of all points that one must have."""

_THICKNESS = 4.0
"""Distance from a plane, in pixels of the views, at which a point is still on it: fits of 512 x
384 photographs scatter centres by about one."""

_FAR = 20.0
"""Distance of the camera above a plane, in its longest sides: nearly parallel projection."""

_MARGIN = 16
"""Cells around a hole that are drawn for the inpainting, half of them for labels."""

_MOST_CELLS = 384
"""Longest side of a plane's image."""

_SEEN = 0.5
"""Weight of the thing above which a pixel is its."""

_SUPPORT, _MIN_VISIBILITY, _EXPOSED_ROUNDS = 0.2, 1.0, 2
"""Share of what views see of a Gaussian after a removal that they must have seen before, the least
that they see after it, in pixels, and how often this is asked."""

_FREE_VIEWS = 2
"""Views that must look through a cell before it counts as empty: depths err along outlines."""

_MIN_CELLS, _ROUNDS = 12, 4
"""Least cells of a hole, and rounds in which pixels that were given to refused holes go to what
is behind."""

_OPACITY, _SPREAD, _FLATNESS = 0.9, 0.6, 0.1
"""Opacity of a new Gaussian, and its standard deviations along and across the plane in cells:
together they let less than a hundredth through and blur by less than a pixel."""

_KERNEL = np.ones((5, 5), np.uint8)
"""Cells that are taken together where single ones err."""

_RADIUS = 5.0
"""Pixels around a pixel that Telea's method asks."""


@dataclass(frozen=True, slots=True)
class OpenCvInpainter:
    """OpenCV's inpainting by Telea's fast marching method: no weights, smooth."""

    name: str = OPENCV
    note: str = "smooth: patterns fade in large holes"

    @property
    def settings(self) -> Mapping[str, Any]:
        """Its radius."""
        return {"radius": _RADIUS}

    def inpaint(
        self, image: UInt8[Tensor, "height width 3"], mask: Bool[Tensor, "height width"]
    ) -> UInt8[Tensor, "height width 3"]:
        """The image, painted where the mask is True."""
        holes = mask.numpy().astype(np.uint8)
        painted = cv2.inpaint(image.numpy(), holes, _RADIUS, cv2.INPAINT_TELEA)
        return torch.from_numpy(painted)


@boundary
def find_inpainter(name: str) -> Inpainting:
    """The inpainter of this name: ``opencv``, or a model of another package (`find_model`).

    Raises:
        InputError: If there is none, or it does not inpaint.
    """
    if name == OPENCV:
        return OpenCvInpainter()
    model = find_model(name)
    if not isinstance(model, Inpainting):
        raise InputError(f"fill: expected {OPENCV} or a model that inpaints, {name} does not.")
    return model


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Filled:
    """New Gaussians on the surfaces that a thing hid."""

    gaussians: Gaussians
    """One a cell; may be none."""

    holes: Int64[Tensor, "n"]
    """The hole that each is in."""

    rims: tuple[Int64[Tensor, "m"], ...]
    """For each hole, rows of those Gaussians that stay which lie around it on the same plane."""


@boundary
def fill(
    gaussians: Gaussians,
    removed: Selection,
    views: Sequence[View],
    *,
    inpainter: Inpainting | None = None,
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> Filled:
    """Continue the surfaces around a removed thing to where it hid them from all views.

    Sixteen views at most are held at a time. The result does not depend on the order of the views
    or the number of threads.

    Args:
        gaussians: The scene with the thing.
        removed: The thing.
        views: Views that saw the scene; only their cameras are used.
        inpainter: Paints the images of planes; None is OpenCV's.
        backend: Rendering backend.
        progress: Called with the views done and all there are to do.

    Returns:
        New Gaussians, none where nothing is hidden; rows of `Filled.rims` count those that stay.

    Raises:
        InputError: If there are no views, or the inpainter gives no image of the same size.
    """
    if not views:
        raise InputError("views: expected at least one, got none.")
    cameras = [_camera(view) for view in _spaced(views)]
    scene = _Removal(gaussians, removed, backend)
    rim = _rim_cameras(scene, cameras)
    if not rim:
        return _none(gaussians)
    looks = [scene.look(camera) for camera in rim]
    points, pixel = _rim_points(looks)
    sheets = [
        sheet
        for plane in _planes(points, _THICKNESS * pixel)
        if (sheet := _sheet(plane, looks, pixel)) is not None
    ]
    for done, camera in enumerate(cameras, start=1):
        look = scene.look(camera)
        for sheet in sheets:
            sheet.observe(look)
        if progress is not None:
            progress(done, len(cameras))
    _choose(sheets, looks)
    painter = inpainter or OpenCvInpainter()
    parts, holes, rims = [gaussians[:0]], [torch.zeros(0, dtype=torch.int64)], []
    for sheet in sheets:
        for part, rim_rows in _holes_filled(sheet, scene, painter):
            holes.append(torch.full((len(part),), len(rims)))
            parts.append(part)
            rims.append(rim_rows)
    return Filled(gaussians=Gaussians.concatenate(parts), holes=torch.cat(holes), rims=tuple(rims))


@boundary
def exposed(
    gaussians: Gaussians, removed: Selection, views: Sequence[View], *, backend: str = "auto"
) -> Selection:
    """Gaussians that no photograph supports but that a removal would show.

    What lies inside a thing or behind it was hardly seen, so that its colour and place are
    arbitrary. A Gaussian is meant if the views see it five times as much after the removal as
    before; as others appear behind it, that is asked twice.

    Args:
        gaussians: The scene with the thing.
        removed: The thing.
        views: Views that saw the scene; only their cameras are used.
        backend: Rendering backend.

    Returns:
        The Gaussians; none of them is removed already.
    """
    cameras = [_camera(view) for view in _spaced(views)]
    everything = torch.ones(len(gaussians), dtype=torch.bool)
    before = _visibility(gaussians, everything, cameras, backend)
    gone = removed.mask.cpu()
    for _ in range(_EXPOSED_ROUNDS):
        now = _visibility(gaussians, ~gone, cameras, backend)
        found = ~gone & (now > _MIN_VISIBILITY) & (before < _SUPPORT * now)
        if not bool(found.any()) or int((gone | found).sum()) == len(gaussians):
            break
        gone = gone | found
    return Selection(mask=gone & ~removed.mask.cpu())


def _visibility(
    gaussians: Gaussians, mask: Tensor, cameras: Sequence[Camera], backend: str
) -> Tensor:
    """Blending weight of those that a mask has, over all pixels of cameras, float64 (n,)."""
    part = gaussians[mask]
    total = torch.zeros(len(gaussians), dtype=torch.float64)
    for camera in cameras:
        ones = torch.ones(camera.height, camera.width, 1)
        with torch.no_grad():
            total[mask] += back_project(part, camera, ones, backend=backend).weights.cpu().double()
    return total


def _spaced(views: Sequence[View]) -> list[View]:
    """The views by name, evenly fewer where there are many."""
    ordered = sorted(views, key=lambda view: view.name)
    return ordered[:: -(-len(ordered) // _MOST_VIEWS)]


@boundary
def filled_layer(layer: Layer, filled: Filled, joined: Gaussians) -> Layer:
    """A layer that has the new Gaussians behind its rows: each gets what most of its rim has.

    Args:
        layer: A layer of the Gaussians that stay.
        filled: The new ones.
        joined: Those that stay and the new ones behind them.

    Returns:
        A layer of `joined`: the most frequent label or side of the rim, or its feature nearest to
        the mean; without evidence of its own.
    """
    count = len(layer)
    new = torch.tensor([_typical(layer, rim) for rim in filled.rims], dtype=torch.int64)
    edited = Edited(
        gaussians=joined,
        rows=torch.cat((torch.arange(count), new[filled.holes])),
        fractions=torch.cat((torch.ones(count), torch.zeros(len(filled.holes)))),
    )
    return apply_rows(layer, edited)


def _typical(layer: Layer, rim: Tensor) -> int:
    """The row of a rim that has what most of it have; -1 where there is no rim."""
    if not len(rim):
        return NEW
    match layer:
        case InstanceTree():
            return _typical(layer.labels, rim)
        case Labels():
            values = layer.ids[rim].long()
        case Selection():
            values = layer.mask[rim].long()
        case _:
            rows = layer.values[rim].double()
            away = ((rows - rows.mean(dim=0)) ** 2).sum(dim=1)
            return int(rim[int(away.argmin())])
    found, counts = torch.unique(values, return_counts=True)
    most = found[int(counts.argmax())]
    return int(rim[int((values == most).int().argmax())])


def _none(gaussians: Gaussians) -> Filled:
    return Filled(gaussians=gaussians[:0], holes=torch.zeros(0, dtype=torch.int64), rims=())


# What views show.


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
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

    def heights(self, plane: "_Plane", depth: Array) -> Array:
        """Signed distances of points at z-depths, positive on the camera's side of the plane."""
        own = _dot(self.centre, plane.normal) - plane.offset
        slope = _dot(self.rays, plane.normal)
        with np.errstate(invalid="ignore"):
            found = own + slope * depth
        # Nothing at all is beyond any plane.
        found = np.where(np.isfinite(depth), found, -np.inf * np.sign(own))
        return found * np.sign(own)


@dataclass(frozen=True, slots=True, eq=False)
class _Removal:
    """A scene and what is taken out of it."""

    gaussians: Gaussians
    removed: Selection
    backend: str

    @property
    def stays(self) -> Gaussians:
        return self.gaussians[~self.removed.mask]

    def weight(self, camera: Camera) -> Rendered:
        """The thing's share of each pixel."""
        signal = self.removed.mask.to(self.gaussians.means)[:, None]
        return render(self.gaussians, camera, signal, backend=self.backend)

    def look(self, camera: Camera) -> _Look:
        with torch.no_grad():
            drawn = self.weight(camera)
            left = render(self.stays, camera, backend=self.backend)
        ones = torch.ones(camera.height, camera.width, dtype=torch.float64)
        world = camera.unproject(camera.pixel_centres().double(), ones).numpy()
        centre = camera.centre.double().numpy()
        return _Look(
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


def _camera(view: View) -> Camera:
    """The pinhole camera of a view, not larger than needed."""
    camera = undistorted_camera(view.camera)
    share = min(1.0, _LONGEST / max(camera.width, camera.height))
    if share == 1:
        return camera
    return camera.resized(max(1, round(share * camera.width)), max(1, round(share * camera.height)))


def _rim_cameras(scene: _Removal, cameras: Sequence[Camera]) -> list[Camera]:
    """Cameras that see the thing, evenly chosen."""
    shown: list[Camera] = []
    for camera in cameras:
        small = camera.resized(max(1, camera.width // 4), max(1, camera.height // 4))
        with torch.no_grad():
            if bool((scene.weight(small).image > _SEEN).any()):
                shown.append(camera)
    return shown[:: -(-len(shown) // _RIM_VIEWS)] if shown else []


def _rim_points(looks: Sequence[_Look]) -> tuple[Array, float]:
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
class _Plane:
    """Points x with normal . x = offset, and those of them that were seen."""

    normal: Array
    offset: float
    points: Array


def _dot(points: Array, vector: Array) -> Array:
    """Products without BLAS, whose sums depend on the number of threads."""
    return points[..., 0] * vector[0] + points[..., 1] * vector[1] + points[..., 2] * vector[2]


def _fitted(points: Array) -> tuple[Array, float]:
    """The plane of least squares through points (n, 3), n >= 3."""
    mean = points.mean(axis=0)
    away = points - mean
    spread = np.array([[(away[:, i] * away[:, j]).mean() for j in range(3)] for i in range(3)])
    normal = np.linalg.eigh(spread)[1][:, 0]
    return normal, float(_dot(mean, normal))


def _planes(points: Array, thickness: float) -> list[_Plane]:
    """Planes through most of the points, one after another from those that are left."""
    found: list[_Plane] = []
    rest = points
    least = max(_NEAREST, round(_MIN_INLIERS * len(points)))
    while len(found) < _PLANES and len(rest) >= least:
        index = NeighbourIndex(torch.from_numpy(rest))
        first = np.unique(np.linspace(0, len(rest) - 1, _SAMPLES).round().astype(np.int64))
        near = index.nearest(torch.from_numpy(rest[first]), _NEAREST).indices.numpy()
        best, inside = 0, np.zeros(len(rest), np.bool_)
        for patch in near:
            normal, offset = _fitted(rest[patch])
            close = np.abs(_dot(rest, normal) - offset) < thickness
            count = int(close.sum())
            if count > best:
                best, inside = count, close
        if best < least:
            break
        for _ in range(3):
            normal, offset = _fitted(rest[inside])
            inside = np.abs(_dot(rest, normal) - offset) < thickness
            if int(inside.sum()) < least:
                break
        else:
            found.append(_Plane(normal, offset, rest[inside]))
        # What lies a little further off is of the same surface and makes no plane of its own.
        rest = rest[np.abs(_dot(rest, normal) - offset) >= 2 * thickness]
    return found


# The images of planes.


@dataclass(slots=True, eq=False)
class _Sheet:
    """A part of a plane in square cells, as a camera straight above it sees it."""

    plane: _Plane
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

    hole: Mask
    """What is to be filled."""

    def observe(self, look: _Look) -> None:
        """Count a view: where it looks through the plane, where it shows it, and how."""
        row, column, inside = _pixels(look.camera, self.centres)
        height = look.heights(self.plane, look.before)[row, column]
        self.free += inside & (height < -self.thickness)
        seen = inside & (np.abs(height) <= self.thickness) & ~look.thing[row, column]
        self.seen += seen
        # Straight and near views show most: pixels of a cell go as cosine over squared distance.
        ray = self.centres - look.centre
        squared = _dot(ray, self.plane.normal) ** 2
        weight = seen * squared / (ray**2).sum(axis=-1) ** 3
        self.weights += weight
        self.colours += weight[..., None] * look.image[row, column]

    @property
    def known(self) -> Mask:
        """Cells that views saw."""
        return (self.seen >= np.maximum(self.free, _FREE_VIEWS)) & (self.weights > 0)

    @property
    def image(self) -> Array:
        """What views show of the plane, (rows, columns, 3) in [0, 1]; black where they do not."""
        return self.colours / np.where(self.weights > 0, self.weights, 1.0)[..., None]

    @property
    def hidden(self) -> Mask:
        """Cells that no view saw or looked through."""
        found = (self.free < _FREE_VIEWS) & (self.seen < _FREE_VIEWS)
        # Depths of faint texture err here and there.
        return cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_OPEN, _KERNEL).astype(np.bool_)

    @property
    def possible(self) -> Mask:
        """Cells where the surface is, or may be."""
        return self.hidden | self.known

    def hits(self, look: _Look) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
        """Row and column of the cell, and z-depth, where pixels (h, w) meet it; -1 beside it."""
        own = _dot(look.centre, self.plane.normal) - self.plane.offset
        slope = _dot(look.rays, self.plane.normal)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = -own / slope
        depth = np.where(np.isfinite(depth) & (depth > 0), depth, np.inf)
        points = look.points(np.where(np.isfinite(depth), depth, 0.0))
        row, column, inside = _pixels(self.camera, points)
        inside &= np.isfinite(depth)
        return np.where(inside, row, -1), np.where(inside, column, -1), depth


def _pixels(camera: Camera, points: Array) -> tuple[NDArray[np.int64], NDArray[np.int64], Mask]:
    """Row and column of the pixel that shows each point, and whether one does."""
    pose = camera.cam_from_world.double().numpy()
    x, y, z = (_dot(points, pose[i, :3]) + pose[i, 3] for i in range(3))
    ahead = z > 0
    z = np.where(ahead, z, 1.0)
    column = np.floor(camera.fx * x / z + camera.cx)
    row = np.floor(camera.fy * y / z + camera.cy)
    inside = ahead & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    row, column = (np.where(inside, value, 0).astype(np.int64) for value in (row, column))
    return row, column, inside


def _sheet(plane: _Plane, looks: Sequence[_Look], pixel: float) -> _Sheet | None:
    """The part of a plane that the thing hid from some views; None where there is none."""
    thickness = _THICKNESS * pixel
    across = _across(plane.normal)
    down = np.cross(-plane.normal, across)
    axes = (across, down)
    hidden: list[Array] = []
    for look in looks:
        slope = _dot(look.rays, plane.normal)
        own = _dot(look.centre, plane.normal) - plane.offset
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = -own / slope
        open_to = look.heights(plane, look.after) < -thickness
        behind = look.heights(plane, look.before) > -thickness
        good = look.thing & open_to & behind & np.isfinite(depth) & (depth > 0)
        hidden.append(look.centre + look.rays[good] * depth[good][:, None])
    points = np.concatenate(hidden)
    low, high = (
        np.array([bound(_dot(plane.points, axis)) for axis in axes]) for bound in (np.min, np.max)
    )
    flat = np.stack([_dot(points, axis) for axis in axes], axis=1)
    # A hole is among what was seen of the surface, not beyond it.
    flat = flat[((flat >= low) & (flat <= high)).all(axis=1)]
    if not len(flat):
        return None
    low, high = flat.min(axis=0), flat.max(axis=0)
    size = max(pixel, float((high - low).max()) / (_MOST_CELLS - 2 * _MARGIN))
    columns, rows = (int(n) for n in np.ceil((high - low) / size).astype(int) + 2 * _MARGIN)
    camera = _above(plane, axes, (low + high) / 2, (columns, rows), size)
    at = camera.pixel_centres().double()
    reach = torch.full(at.shape[:-1], camera.fx * size, dtype=torch.float64)
    centres = camera.unproject(at, reach).numpy()
    return _Sheet(
        plane=plane,
        camera=camera,
        size=size,
        thickness=thickness,
        centres=centres,
        colours=np.zeros((rows, columns, 3)),
        weights=np.zeros((rows, columns)),
        free=np.zeros((rows, columns), np.int32),
        seen=np.zeros((rows, columns), np.int32),
        hole=np.zeros((rows, columns), np.bool_),
    )


def _across(normal: Array) -> Array:
    """A unit vector in the plane: along the axis that is nearest to lying in it."""
    axis = np.eye(3)[int(np.abs(normal).argmin())]
    found = axis - normal * float(_dot(axis, normal))
    return found / np.sqrt(float(_dot(found, found)))


def _above(
    plane: _Plane, axes: tuple[Array, Array], middle: Array, cells: tuple[int, int], size: float
) -> Camera:
    """A camera far above the middle of a sheet, whose pixels are cells of this size on it."""
    rotation = np.stack((*axes, -plane.normal))
    distance = _FAR * max(cells) * size
    centre = axes[0] * middle[0] + axes[1] * middle[1] + plane.normal * (plane.offset + distance)
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = [-float(_dot(centre, axis)) for axis in rotation]
    return Camera(
        width=cells[0],
        height=cells[1],
        fx=distance / size,
        fy=distance / size,
        cx=cells[0] / 2,
        cy=cells[1] / 2,
        cam_from_world=torch.from_numpy(pose),
    )


# What is filled, and with what.


def _choose(sheets: Sequence[_Sheet], looks: Sequence[_Look]) -> None:
    """Mark the cells to fill: what each pixel of the thing should show now, nearest first."""
    refused = [np.zeros_like(sheet.hole) for sheet in sheets]
    for _ in range(_ROUNDS):
        wins = [np.zeros_like(sheet.hole) for sheet in sheets]
        for look in looks:
            _claim(sheets, look, wins, refused)
        again = False
        for sheet, won, no in zip(sheets, wins, refused, strict=True):
            # Views sample far cells sparsely.
            joined = cv2.morphologyEx(won.astype(np.uint8), cv2.MORPH_CLOSE, _KERNEL)
            hole = joined.astype(np.bool_) & sheet.possible
            sheet.hole = np.zeros_like(hole)
            for part in _components(hole & ~no):
                if _is_surrounded(sheet, part):
                    sheet.hole |= part
                else:
                    no |= part
                    again = True
        if not again:
            break


def _claim(
    sheets: Sequence[_Sheet], look: _Look, wins: Sequence[Mask], refused: Sequence[Mask]
) -> None:
    """Of one view, give each pixel of the thing to the nearest cell that may be there."""
    best = np.full(look.thing.shape, np.inf)
    which = np.full(look.thing.shape, -1)
    cells: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
    for number, sheet in enumerate(sheets):
        row, column, depth = sheet.hits(look)
        cells.append((row, column))
        may = look.thing & (row >= 0)
        may &= look.heights(sheet.plane, look.before) > -sheet.thickness
        may &= look.heights(sheet.plane, look.after) < -sheet.thickness
        may &= (sheet.possible & ~refused[number])[row, column]
        nearer = may & (depth < best)
        best[nearer], which[nearer] = depth[nearer], number
    for number, (row, column) in enumerate(cells):
        own = which == number
        wins[number][row[own], column[own]] = True


def _components(mask: Mask) -> Iterator[Mask]:
    count, numbers = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    for number in range(1, count):
        part = numbers == number
        if int(part.sum()) >= _MIN_CELLS:
            yield part


def _is_surrounded(sheet: _Sheet, part: Mask) -> bool:
    """Whether most cells of a hole have seen surface as the nearest that is not hidden.

    And not empty space, as beyond the edge of a table. No surface goes on further than it was seen.
    """
    known = sheet.known
    observed = known | (sheet.free >= _FREE_VIEWS)
    if int(known.sum()) < int(part.sum()):
        return False
    rows, columns = distance_transform_edt(~observed, return_distances=False, return_indices=True)
    return bool(known[rows[part], columns[part]].mean() > 0.5)


def _holes_filled(
    sheet: _Sheet, scene: _Removal, inpainter: Inpainting
) -> Iterator[tuple[Gaussians, Tensor]]:
    """New Gaussians for each hole of a sheet, and the rows around it."""
    if not sheet.hole.any():
        return
    image = torch.from_numpy((sheet.image * 255).round().astype(np.uint8))
    painted = inpainter.inpaint(image, torch.from_numpy(~sheet.known))
    check_shape("inpainted image", painted, tuple(image.shape))
    colours = painted.double() / 255
    stays = scene.stays
    means = stays.means.double().cpu().numpy()
    row, column, inside = _pixels(sheet.camera, means)
    inside &= np.abs(_dot(means, sheet.plane.normal) - sheet.plane.offset) < sheet.thickness
    for part in _components(sheet.hole):
        kernel = np.ones((_MARGIN + 1, _MARGIN + 1), np.uint8)
        around = cv2.dilate(part.astype(np.uint8), kernel).astype(np.bool_)
        rim = torch.from_numpy(np.flatnonzero(inside & around[row, column]))
        yield _new_gaussians(sheet, part, colours, stays), rim


def _new_gaussians(sheet: _Sheet, part: Mask, colours: Tensor, like: Gaussians) -> Gaussians:
    """One flat Gaussian a cell."""
    chosen = torch.from_numpy(part)
    means = torch.from_numpy(sheet.centres)[chosen].to(like.means)
    axes = sheet.camera.cam_from_world[:3, :3].double().T
    turn = quaternion_from_rotation(axes).to(like.rotations)
    scale = sheet.size * torch.tensor([_SPREAD, _SPREAD, _FLATNESS], dtype=torch.float64)
    sh = torch.zeros(len(means), *like.sh.shape[1:]).to(like.sh)
    sh[:, 0] = ((colours[chosen] - 0.5) / SH_C0).to(like.sh)
    extra = {
        name: torch.zeros(len(means), *values.shape[1:]).to(values)
        for name, values in like.extra.items()
    }
    return like.replace(
        means=means,
        rotations=turn.expand(len(means), 4),
        scales=scale.to(like.scales).expand(len(means), 3),
        opacities=torch.full((len(means),), _OPACITY).to(like.opacities),
        sh=sh,
        extra=extra,
    )
