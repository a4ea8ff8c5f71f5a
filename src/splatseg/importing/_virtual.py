"""Virtual cameras for a splat scene without photographs, so that everything else works on it.

First the extent of the scene in a level frame, then candidates (around it looking in, or at free
places within looking out), then the choice among them.
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from msgspec import Meta
from torch import Tensor

from splatseg.core import Camera, Gaussians, View
from splatseg.core.boundary import boundary
from splatseg.core.threads import one_torch_thread
from splatseg.errors import InputError
from splatseg.neighbours import NeighbourIndex
from splatseg.render import back_project, render

_SOLID = 0.1
_QUANTILE = 0.02
_LARGEST = 0.95


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Extent:
    """The robust extent of a scene in level axes: right, ahead, up."""

    world_from_level: Float[Tensor, "3 3"]
    """Rotation whose columns are the level axes in the world, float64."""

    centre: Float[Tensor, "3"]
    """Middle of the bounds, level axes."""

    half: Float[Tensor, "3"]
    """Half the size of the bounds, level axes."""

    solid: Float[Tensor, "m 3"]
    """Centres of Gaussians that are not faint, level axes."""

    mass: Float[Tensor, "n"]
    """How much each Gaussian matters: opacity times area, no single one too much; sums to 1."""

    @property
    def radius(self) -> float:
        """Half the diagonal of the bounds."""
        return float(torch.linalg.vector_norm(self.half))

    def world(self, points_level: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Points in world axes."""
        return points_level @ self.world_from_level.T


def extent_of(gaussians: Gaussians, up: tuple[float, float, float]) -> Extent:
    """Measure a scene, floaters and far splats left out.

    The bounds hold the middle 96 % of the centres of the Gaussians with an opacity of at least
    0.1 along each axis (of all, where fewer than fifty are that solid).

    Raises:
        InputError: If there is no Gaussian, or all are in one place.
    """
    if not len(gaussians):
        raise InputError("gaussians: expected at least one, got none.")
    rotation = level_axes(up)
    points = gaussians.means.detach().cpu().double() @ rotation
    solid = gaussians.opacities.detach().cpu() >= _SOLID
    if int(solid.sum()) < 50:
        solid = torch.ones_like(solid)
    kept = points[solid]
    ordered = kept.sort(dim=0).values
    last = len(kept) - 1
    low = ordered[round(_QUANTILE * last)]
    high = ordered[round((1 - _QUANTILE) * last)]
    size = gaussians.scales.detach().cpu().double()
    # A few Gaussians are a scene too, and a single one has the size of its own.
    pad = size[solid].median(dim=0).values.max()
    half = (high - low) / 2 + pad
    if not float(half.max()) > 0:
        raise InputError("gaussians: expected a scene with an extent, got all in one point.")
    area = size.sort(dim=1).values[:, 1:].prod(dim=1)
    largest = area[solid].sort().values[round(_LARGEST * last)]
    mass = gaussians.opacities.detach().cpu().double() * area.clamp_max(largest)
    inside = ((points - (low + high) / 2).abs() <= 1.5 * half).all(dim=1)
    mass = torch.where(inside, mass, torch.zeros_like(mass))
    return Extent(
        world_from_level=rotation,
        centre=(low + high) / 2,
        half=half.clamp_min(1e-3 * float(half.max())),
        solid=kept,
        mass=(mass / mass.sum().clamp_min(1e-30)).float(),
    )


def level_axes(up: tuple[float, float, float]) -> Float[Tensor, "3 3"]:
    """Rotation world_from_level whose last column is up.

    Raises:
        InputError: If up is no direction.
    """
    third = torch.tensor(up, dtype=torch.float64)
    length = float(torch.linalg.vector_norm(third))
    if not 0 < length < float("inf"):
        raise InputError(f"up: expected a direction, got {up}.")
    third = third / length
    # The axis of the world that is most level, so that results do not hang on rounding.
    helper = torch.zeros(3, dtype=torch.float64)
    helper[int(third.abs().argmin())] = 1.0
    second = torch.linalg.cross(third, helper)
    second = second / torch.linalg.vector_norm(second)
    return torch.stack((torch.linalg.cross(second, third), second, third), dim=1)


OUTSIDE_VIEW = 50.0
"""Horizontal field of view of cameras that look in, degrees."""

INSIDE_VIEW = 75.0
"""The same of cameras that look out."""

_TURNS = 16
_HEIGHTS = (-12.0, 12.0, 36.0, 62.0)
_NEARER = (1.0, 0.6)
_MARGIN = 1.12
_GRID = (7, 7, 4)
_INNER = 0.85
_CLEARANCE = 0.08
_POSITIONS = 24
_DIRECTIONS = 8
_PITCHES = (-22.0, 4.0)

VIEWS_A_PLACE = _DIRECTIONS * len(_PITCHES)
"""How many cameras stand at each free place, all round."""


Size = tuple[int, int]
"""Width and height of pictures."""


def outside(extent: Extent, size: Size) -> list[Camera]:
    """Cameras around the scene, at heights from below to far above.

    The first half has all of the bounds in the picture. The second stands nearer, and where one
    side of the bounds is the longest by far, it looks at its ends in turn as well as at its middle.
    """
    half = extent.half
    signs = torch.cartesian_prod(*([torch.tensor([-1.0, 1.0], dtype=torch.float64)] * 3))
    corners = signs * half
    tangent_x = math.tan(math.radians(OUTSIDE_VIEW) / 2)
    tangent_y = tangent_x * size[1] / size[0]
    cameras: list[Camera] = []
    half_lengths, axes = half.sort(descending=True)
    along = torch.zeros(3, dtype=torch.float64)
    along[axes[0]] = half_lengths[0] - half_lengths[1]
    for near, height, turn in itertools.product(_NEARER, _HEIGHTS, range(_TURNS)):
        away = _direction(2 * math.pi * (turn + 0.5 * (height > 0)) / _TURNS, height)
        rotation = _looking(-away)
        x, y, z = (corners @ rotation.T).unbind(-1)
        needed = torch.maximum(x.abs() / tangent_x, y.abs() / tangent_y) - z
        distance = _MARGIN * float(needed.max()) * near
        target = extent.centre + (turn % 3 - 1) * (1 - near) * along
        cameras.append(_camera(extent, target + distance * away, rotation, size, OUTSIDE_VIEW))
    return cameras


def inside(extent: Extent, size: Size) -> list[Camera]:
    """Cameras at free places within the bounds, in all directions; none where nothing is free."""
    cameras: list[Camera] = []
    for eye, pitch, turn in itertools.product(free_positions(extent), _PITCHES, range(_DIRECTIONS)):
        forward = _direction(2 * math.pi * (turn + 0.5 * (pitch > 0)) / _DIRECTIONS, pitch)
        cameras.append(_camera(extent, eye, _looking(forward), size, INSIDE_VIEW))
    return cameras


def _direction(azimuth: float, height: float) -> Tensor:
    """A unit direction in level axes: azimuth in radians, height above the horizon in degrees."""
    pitch = math.radians(height)
    return torch.tensor(
        [
            math.cos(pitch) * math.cos(azimuth),
            math.cos(pitch) * math.sin(azimuth),
            math.sin(pitch),
        ],
        dtype=torch.float64,
    )


def free_positions(extent: Extent) -> list[Tensor]:
    """Points of a grid within the bounds that are away from all solid Gaussians, spread out."""
    axes = [
        torch.linspace(-_INNER, _INNER, n, dtype=torch.float64) * extent.half[k]
        for k, n in enumerate(_GRID)
    ]
    grid = torch.cartesian_prod(*axes) + extent.centre
    distance = NeighbourIndex(extent.solid).nearest(grid, 1).distances[:, 0]
    clear = distance > _CLEARANCE * extent.radius
    free, room = grid[clear], distance[clear]
    if not len(free):
        return []
    # Farthest points first, beginning with the one that has most room.
    chosen = [int(room.argmax())]
    apart = torch.linalg.vector_norm(free - free[chosen[0]], dim=1)
    while len(chosen) < min(_POSITIONS, len(free)):
        chosen.append(int(apart.argmax()))
        apart = torch.minimum(apart, torch.linalg.vector_norm(free - free[chosen[-1]], dim=1))
    return [free[i] for i in chosen]


def _looking(forward: Tensor) -> Tensor:
    """Rotation cam_from_level of a camera that looks along `forward`, level."""
    right = torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    right = right / torch.linalg.vector_norm(right)
    return torch.stack((right, torch.linalg.cross(forward, right), forward))


def _camera(extent: Extent, eye: Tensor, rotation: Tensor, size: Size, view: float) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation @ extent.world_from_level.T
    pose[:3, 3] = -rotation @ eye
    width, height = size
    focal = width / 2 / math.tan(math.radians(view) / 2)
    return Camera(
        width=width,
        height=height,
        fx=focal,
        fy=focal,
        cx=width / 2,
        cy=height / 2,
        cam_from_world=pose,
    )


SceneKind = Literal["object", "room"]
Side = Annotated[int, Meta(ge=16, le=16384)]
"""Pixels."""

TEST_EVERY = 8
"""Views 0, 8, 16 ... become test views, as in captures without a split."""

SURROUNDED = 0.6
"""A scene is a room if this share of the view all round is covered at the median free place
within it. Objects have up to 0.4, rooms 0.75 and more."""

VIEWS: Mapping[SceneKind, int] = MappingProxyType({"object": 40, "room": 96})
"""Most views where nobody says: a room is larger than what a view of it shows."""

OFTEN = 6
"""So many views that show a place well are enough: labels of it are decided by votes."""

_SMALL = 96
_CELLS = 40
# A cell of many Gaussians counts up to so many times as much as one of the mean number.
_MAX_DETAIL = 4.0
# What each further view of a cell counts, of the one before.
_AGAIN = 0.7
_NEAR_INSIDE, _NEAR_OUTSIDE = 0.08, 0.25
_MAX_NEAR = 0.2
_MIN_ALPHA = {"object": 0.02, "room": 0.5}
_GAIN = 2e-3
_FAINT = 0.05
_PIXELS_A_CELL = 12
_MIN_VIEWS = 12
# A flat thing has a free place or two within its bounds, and is no room.
_MIN_POSITIONS = 6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class VirtualViews:
    """Views without photographs and how they came about."""

    views: tuple[View, ...]
    kind: SceneKind
    """``object``: looked at from around. ``room``: looked at from within."""

    up: tuple[float, float, float]
    coverage: float
    """Share of the visible mass (opacity times area) that at least one view shows."""


@one_torch_thread()  # its sums would round differently with the number of threads
@boundary
def place_cameras(
    gaussians: Gaussians,
    *,
    up: tuple[float, float, float],
    count: Annotated[int, Meta(ge=1, le=10000)] | None = None,
    width: Side = 800,
    height: Side = 600,
    kind: SceneKind | None = None,
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> VirtualViews:
    """Place cameras so that they cover the visible surface of a scene.

    Candidates stand around the robust bounds of the scene looking in, or at free places within
    looking out. Each is drawn small; its alpha and median depth say which cells of a grid (a
    fortieth of the longest side) it shows, and how well. Then the candidate that adds most is
    taken, again and again. A cell counts by the Gaussians in it, since things have more of them
    than bare walls; it counts in full when it is large in the picture, less with every view that
    shows it, and nothing more after `OFTEN`. The result depends on the Gaussians alone.

    Args:
        gaussians: The scene.
        up: Direction away from the ground, world.
        count: Most views; fewer are placed when nothing is left to gain, twelve at least. None
            takes `VIEWS` of its kind.
        width: Pixels a row.
        height: Rows.
        kind: ``object`` or ``room``; None finds out.
        backend: Who renders.
        progress: Is told how many candidates are drawn, and of how many.

    Raises:
        InputError: If there is no Gaussian, or no candidate sees any.
    """
    extent = extent_of(gaussians, up)
    small = (_SMALL, max(16, round(_SMALL * height / width)))
    within = inside(extent, small)
    if kind is None:
        kind = _kind(gaussians, extent, within, backend)
    candidates = within if kind == "room" and within else outside(extent, small)
    previews: list[_PreviewRender] = []
    for i, camera in enumerate(candidates):
        overview = candidates is not within and i < len(candidates) // 2
        preview = _preview(gaussians, extent, camera, kind=kind, overview=overview, backend=backend)
        if preview is not None:
            previews.append(preview)
        if progress is not None:
            progress(i + 1, len(candidates))
    if not previews:
        raise InputError("gaussians: expected a scene that can be seen, but no camera sees it.")
    # Half of the views of an object show it whole; the others stand where they add most.
    overview = [i for i, g in enumerate(previews) if g.overview]
    chosen = _greedy(previews, count or VIEWS[kind], begin=overview, detail=_detail(extent))
    cameras = _in_order([previews[i].camera.resized(width, height) for i in chosen], extent)
    seen = _seen(gaussians, [previews[i].camera for i in chosen], backend)
    # Every fourth candidate is enough to tell what can be seen at all.
    visible = seen | _seen(gaussians, [g.camera for g in previews[::4]], backend)
    whole = float(extent.mass[visible].sum())
    views = [
        View(
            name=f"virtual_{i:04d}",
            camera=camera,
            split="test" if i % TEST_EVERY == 0 and len(cameras) > 1 else "train",
        )
        for i, camera in enumerate(cameras)
    ]
    return VirtualViews(
        views=tuple(views),
        kind=kind,
        up=up,
        coverage=float(extent.mass[seen].sum()) / whole if whole > 0 else 0.0,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _PreviewRender:
    """What a candidate shows."""

    camera: Camera
    cells: Tensor
    """Cells of the grid, each once."""

    worth: Tensor
    """How well each is shown, (0, 1]."""

    overview: bool
    """Whether it stands so far away that the whole scene is in the picture."""


def _kind(
    gaussians: Gaussians, extent: Extent, within: Sequence[Camera], backend: str
) -> SceneKind:
    """Whether somebody at a free place within the bounds is surrounded by the scene.

    The median over places of how much of the view all round is covered: beside an object most
    of it is empty.
    """
    if len(within) < _MIN_POSITIONS * VIEWS_A_PLACE:
        return "object"
    positions = [
        within[i : i + VIEWS_A_PLACE : 2] for i in range(0, len(within), 2 * VIEWS_A_PLACE)
    ]
    nothing = gaussians.means.new_zeros(len(gaussians), 1)
    covered: list[float] = []
    with torch.no_grad():
        for cameras in positions:
            alphas = [
                float(render(gaussians, camera, nothing, backend=backend).alpha.mean())
                for camera in cameras
            ]
            covered.append(sum(alphas) / len(alphas))
    return "room" if sorted(covered)[len(covered) // 2] >= SURROUNDED else "object"


def _seen(gaussians: Gaussians, cameras: Sequence[Camera], backend: str) -> Tensor:
    """Which Gaussians make at least a hundredth of a pixel somewhere."""
    seen = torch.zeros(len(gaussians), dtype=torch.bool)
    for camera in cameras:
        ones = gaussians.means.new_ones(camera.height, camera.width, 1)
        with torch.no_grad():
            weights = back_project(gaussians, camera, ones, backend=backend).weights
        seen |= weights.cpu() > 0.01
    return seen


def _preview(
    gaussians: Gaussians,
    extent: Extent,
    camera: Camera,
    *,
    kind: SceneKind,
    overview: bool,
    backend: str,
) -> _PreviewRender | None:
    """The cells a candidate shows; None where something stands before it or it shows nothing."""
    with torch.no_grad():
        nothing = gaussians.means.new_zeros(len(gaussians), 1)
        drawn = render(gaussians, camera, nothing, backend=backend)
    alpha, depth = drawn.alpha.cpu(), drawn.median_depth.cpu().double()
    # What never stops half of the light has no median; its expected depth serves.
    depth = torch.where(depth > 0, depth, drawn.depth.cpu().double())
    solid = (depth > 0) & (alpha > _FAINT)
    if float(alpha.mean()) < _MIN_ALPHA[kind] or not bool(solid.any()):
        return None
    to_centre = float(torch.linalg.vector_norm(camera.centre - extent.world(extent.centre)))
    near = _NEAR_INSIDE * extent.radius if kind == "room" else _NEAR_OUTSIDE * to_centre
    if float((solid & (depth < near)).double().mean()) > _MAX_NEAR:
        return None
    pixels = camera.pixel_centres()[solid]
    points = camera.unproject(pixels, depth[solid]) @ extent.world_from_level
    inside_bounds = ((points - extent.centre).abs() <= 1.3 * extent.half).all(dim=1)
    cells, inverse = _cells(points[inside_bounds], extent).unique(return_inverse=True)
    if not len(cells):
        return None
    # Pixels a cell: a few make it well seen, more add nothing.
    weight = torch.zeros(len(cells), dtype=torch.float64)
    weight.index_add_(0, inverse, alpha[solid][inside_bounds].double())
    worth = (weight / _PIXELS_A_CELL).clamp_max(1.0)
    return _PreviewRender(camera=camera, cells=cells, worth=worth, overview=overview)


def _cells(points_level: Tensor, extent: Extent) -> Tensor:
    """The cell of the grid that each point lies in."""
    cell = 2 * float(extent.half.max()) / _CELLS
    index = torch.floor((points_level - extent.centre) / cell).long() + 2 * _CELLS
    return (index[:, 0] * 4 * _CELLS + index[:, 1]) * 4 * _CELLS + index[:, 2]


def _detail(extent: Extent) -> tuple[Tensor, Tensor]:
    """Cells that hold solid Gaussians, ascending, and how much each counts, about 1."""
    inside = ((extent.solid - extent.centre).abs() <= 1.3 * extent.half).all(dim=1)
    cells, counts = _cells(extent.solid[inside], extent).unique(return_counts=True)
    share = counts.double() / counts.double().mean().clamp_min(1e-9)
    return cells, 0.5 + share.clamp_max(_MAX_DETAIL)


def _greedy(
    previews: Sequence[_PreviewRender],
    count: int,
    *,
    begin: Sequence[int],
    detail: tuple[Tensor, Tensor],
) -> list[int]:
    """Candidates by what they add, until enough are taken or nothing is left to gain.

    The first half is taken from `begin`, as far as there are any.
    """
    every = torch.cat([g.cells for g in previews]).unique()
    rows = [torch.searchsorted(every, g.cells) for g in previews]
    # A cell that shows a surface and holds no centre counts as one of few.
    held, share = detail
    at = torch.searchsorted(held, every).clamp_max(max(len(held) - 1, 0))
    counts = torch.full((len(every),), 0.5, dtype=torch.float64)
    if len(held):
        counts = torch.where(held[at] == every, share[at], counts)
    often = torch.zeros(len(every), dtype=torch.float64)
    chosen: list[int] = []
    while len(chosen) < min(count, len(previews)):
        value = torch.where(often < OFTEN, counts * _AGAIN**often, torch.zeros_like(often))
        first = [i for i in begin if i not in chosen] if len(chosen) < (count + 1) // 2 else []
        able = first or [i for i in range(len(previews)) if i not in chosen]
        gains = {i: float((value[rows[i]] * previews[i].worth).sum()) for i in able}
        best = max(able, key=gains.__getitem__)
        if not first and len(chosen) >= _MIN_VIEWS and gains[best] < _GAIN * float(counts.sum()):
            break
        chosen.append(best)
        often[rows[best]] += previews[best].worth
    return chosen


def _in_order(cameras: Sequence[Camera], extent: Extent) -> list[Camera]:
    """Cameras in an order in which a path through them turns one way."""

    def turn(camera: Camera) -> tuple[float, float]:
        forward = camera.cam_from_world[2, :3] @ extent.world_from_level
        eye = camera.centre @ extent.world_from_level - extent.centre
        return math.atan2(float(forward[1]), float(forward[0])), float(eye[2])

    return [replace(c) for c in sorted(cameras, key=turn)]
