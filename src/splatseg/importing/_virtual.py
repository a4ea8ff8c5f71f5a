"""Virtual cameras for a splat scene without photographs, so that everything else works on it."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal

import torch
from torch import Tensor

from splatseg._check import check_range
from splatseg.core import Camera, Gaussians, View
from splatseg.core.boundary import boundary
from splatseg.core.threads import one_torch_thread
from splatseg.errors import InputError
from splatseg.importing._candidates import VIEWS_A_PLACE, Frame, inside, outside
from splatseg.importing._extent import Extent, extent_of
from splatseg.render import back_project, render

SceneKind = Literal["object", "room"]

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
    count: int | None = None,
    width: int = 800,
    height: int = 600,
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
    if count is not None:
        check_range("count", count, 1, 10000)
    check_range("width", width, 16, 16384)
    check_range("height", height, 16, 16384)
    extent = extent_of(gaussians, up)
    small = Frame(width=_SMALL, height=max(16, round(_SMALL * height / width)))
    within = inside(extent, small)
    if kind is None:
        kind = _kind(gaussians, extent, within, backend)
    candidates = within if kind == "room" and within else outside(extent, small)
    glimpses: list[_Glimpse] = []
    for i, camera in enumerate(candidates):
        overview = candidates is not within and i < len(candidates) // 2
        glimpse = _glimpse(gaussians, extent, camera, kind=kind, overview=overview, backend=backend)
        if glimpse is not None:
            glimpses.append(glimpse)
        if progress is not None:
            progress(i + 1, len(candidates))
    if not glimpses:
        raise InputError("gaussians: expected a scene that can be seen, but no camera sees it.")
    # Half of the views of an object show it whole; the others stand where they add most.
    overview = [i for i, g in enumerate(glimpses) if g.overview]
    chosen = _greedy(glimpses, count or VIEWS[kind], begin=overview, detail=_detail(extent))
    cameras = _in_order([glimpses[i].camera.resized(width, height) for i in chosen], extent)
    seen = _seen(gaussians, [glimpses[i].camera for i in chosen], backend)
    # Every fourth candidate is enough to tell what can be seen at all.
    visible = seen | _seen(gaussians, [g.camera for g in glimpses[::4]], backend)
    whole = float(extent.mass[visible].sum())
    return VirtualViews(
        views=_views(cameras),
        kind=kind,
        up=up,
        coverage=float(extent.mass[seen].sum()) / whole if whole > 0 else 0.0,
    )


def _views(cameras: Sequence[Camera]) -> tuple[View, ...]:
    """Views of virtual cameras, some of them held out."""
    return tuple(
        View(
            name=f"virtual_{i:04d}",
            camera=camera,
            split="test" if i % TEST_EVERY == 0 and len(cameras) > 1 else "train",
        )
        for i, camera in enumerate(cameras)
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Glimpse:
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


def _glimpse(
    gaussians: Gaussians,
    extent: Extent,
    camera: Camera,
    *,
    kind: SceneKind,
    overview: bool,
    backend: str,
) -> _Glimpse | None:
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
    return _Glimpse(camera=camera, cells=cells, worth=worth, overview=overview)


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
    glimpses: Sequence[_Glimpse],
    count: int,
    *,
    begin: Sequence[int],
    detail: tuple[Tensor, Tensor],
) -> list[int]:
    """Candidates by what they add, until enough are taken or nothing is left to gain.

    The first half is taken from `begin`, as far as there are any.
    """
    every = torch.cat([g.cells for g in glimpses]).unique()
    rows = [torch.searchsorted(every, g.cells) for g in glimpses]
    # A cell that shows a surface and holds no centre counts as one of few.
    held, share = detail
    at = torch.searchsorted(held, every).clamp_max(max(len(held) - 1, 0))
    counts = torch.full((len(every),), 0.5, dtype=torch.float64)
    if len(held):
        counts = torch.where(held[at] == every, share[at], counts)
    often = torch.zeros(len(every), dtype=torch.float64)
    chosen: list[int] = []
    while len(chosen) < min(count, len(glimpses)):
        value = torch.where(often < OFTEN, counts * _AGAIN**often, torch.zeros_like(often))
        first = [i for i in begin if i not in chosen] if len(chosen) < (count + 1) // 2 else []
        able = first or [i for i in range(len(glimpses)) if i not in chosen]
        gains = {i: float((value[rows[i]] * glimpses[i].worth).sum()) for i in able}
        best = max(able, key=gains.__getitem__)
        if not first and len(chosen) >= _MIN_VIEWS and gains[best] < _GAIN * float(counts.sum()):
            break
        chosen.append(best)
        often[rows[best]] += glimpses[best].worth
    return chosen


def _in_order(cameras: Sequence[Camera], extent: Extent) -> list[Camera]:
    """Cameras in an order in which a path through them turns one way."""

    def turn(camera: Camera) -> tuple[float, float]:
        forward = camera.cam_from_world[2, :3] @ extent.world_from_level
        eye = camera.centre @ extent.world_from_level - extent.centre
        return math.atan2(float(forward[1]), float(forward[0])), float(eye[2])

    return [replace(c) for c in sorted(cameras, key=turn)]
