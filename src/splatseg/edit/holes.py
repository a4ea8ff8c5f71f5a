"""Surfaces continued behind a removed thing, where no view ever saw them.

What a thing hid is found in 3D and not in pictures: planes are fitted to what is visible around it,
and a cell of such a plane is filled if a view now looks at it through the removed thing, no view
saw it or through it, and the plane was seen around it in most directions. What views show of the
plane makes one image as from straight above it, that image is inpainted, and each of its cells in
the hole becomes a flat Gaussian in place of those that lie there unseen. One image a plane, seen by
all views, cannot disagree between views.

References:
    Schnabel et al., Efficient RANSAC for Point-Cloud Shape Detection, CGF 2007: hypotheses from
    local samples, the largest plane first.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Int64
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_shape
from splatseg.core import Camera, Features, Gaussians, Labels, Layer, Selection, View, apply_rows
from splatseg.core.boundary import boundary
from splatseg.core.edited import NEW, Edited
from splatseg.core.instance_tree import InstanceTree
from splatseg.core.models import Inpainting
from splatseg.core.rigid import quaternion_from_rotation
from splatseg.core.sh import SH_C0
from splatseg.edit.inpainting import ExemplarInpainter
from splatseg.edit.planes import (
    BELOW,
    FREE_VIEWS,
    KERNEL,
    MARGIN,
    THICKNESS,
    Look,
    Mask,
    Removal,
    Sheet,
    find_planes,
    rim_cameras,
    rim_points,
    sheet_of,
    small_camera,
)
from splatseg.errors import InputError
from splatseg.render import back_project

_MOST_VIEWS = 96
"""Views that may look through a plane."""

_SUPPORT, _MIN_VISIBILITY, _EXPOSED_ROUNDS = 0.2, 1.0, 2
"""Share of what views see of a Gaussian after a removal that they must have seen before, the least
that they see after it, in pixels, and how often this is asked."""

_MIN_CELLS, _ROUNDS = 12, 4
"""Least cells of a hole, and rounds in which pixels that were given to refused holes go to what
is behind."""

_DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))
_MIN_DIRECTIONS = 4
"""Steps, and the least number of directions in which a hidden cell must have seen surface first:
beside a wall a floor is in five of eight."""

_OPACITY, _SPREAD, _FLATNESS = 0.9, 0.6, 0.1
"""Opacity of a new Gaussian, and its standard deviations along and across the plane in cells:
together they let less than a hundredth through and blur by less than a pixel."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Filled:
    """New Gaussians on the surfaces that a thing hid."""

    gaussians: Gaussians
    """One a cell; may be none."""

    replaced: Selection
    """Of the scene with the thing: those that stay and lie where no view saw the surface, so that
    their colours are arbitrary. They are to be removed as well."""

    holes: Int64[Tensor, "n"]
    """The hole that each is in."""

    rims: tuple[Int64[Tensor, "m"], ...]
    """For each hole, the Gaussians around it on the same plane: rows of the scene without the thing
    and what is replaced."""


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
        inpainter: Paints the images of planes; None is `ExemplarInpainter`.
        backend: Rendering backend.
        progress: Called with the views done and all there are to do.

    Returns:
        New Gaussians, none where nothing is hidden.

    Raises:
        InputError: If there are no views, or the inpainter gives no image of the same size.
    """
    cameras = [small_camera(view) for view in _spaced(views)]
    scene = Removal(gaussians, removed, backend)
    rim = rim_cameras(scene, cameras)
    if not rim:
        return _none(gaussians)
    looks = [scene.look(camera) for camera in rim]
    points, pixel = rim_points(looks)
    sheets = [
        sheet
        for plane in find_planes(points, THICKNESS * pixel)
        if (sheet := sheet_of(plane, looks, pixel)) is not None
    ]
    for done, camera in enumerate(cameras, start=1):
        look = scene.look(camera)
        for sheet in sheets:
            sheet.observe(look)
        if progress is not None:
            progress(done, len(cameras))
    _choose(sheets, looks)
    means = scene.stays.means.double().cpu().numpy()
    arbitrary = np.zeros(len(means), np.bool_)
    for sheet in sheets:
        arbitrary |= sheet.holds(means, sheet.hole & sheet.hidden)
    painter = inpainter or ExemplarInpainter()
    parts, holes, rims = [gaussians[:0]], [torch.zeros(0, dtype=torch.int64)], []
    number = np.cumsum(~arbitrary) - 1
    for sheet in sheets:
        for part, around in _holes_filled(sheet, gaussians, painter):
            holes.append(torch.full((len(part),), len(rims)))
            parts.append(part)
            rim = sheet.holds(means, around) & ~arbitrary
            rims.append(torch.from_numpy(number[rim]))
    replaced = torch.zeros(len(gaussians), dtype=torch.bool)
    replaced[~removed.mask.cpu()] = torch.from_numpy(arbitrary)
    return Filled(
        gaussians=Gaussians.concatenate(parts),
        replaced=Selection(mask=replaced),
        holes=torch.cat(holes),
        rims=tuple(rims),
    )


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

    Raises:
        InputError: If there are no views.
    """
    cameras = [small_camera(view) for view in _spaced(views)]
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
    if not views:
        raise InputError("views: expected at least one, got none.")
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
        case Features():
            rows = layer.values[rim].double()
            away = ((rows - rows.mean(dim=0)) ** 2).sum(dim=1)
            return int(rim[int(away.argmin())])
        case _:
            return int(rim[0])
    found, counts = torch.unique(values, return_counts=True)
    most = found[int(counts.argmax())]
    return int(rim[int((values == most).int().argmax())])


def _none(gaussians: Gaussians) -> Filled:
    return Filled(
        gaussians=gaussians[:0],
        replaced=Selection(mask=torch.zeros(len(gaussians), dtype=torch.bool)),
        holes=torch.zeros(0, dtype=torch.int64),
        rims=(),
    )


# What is filled, and with what.


def _choose(sheets: Sequence[Sheet], looks: Sequence[Look]) -> None:
    """Mark the cells to fill: what each pixel of the thing should show now, nearest first."""
    refused = [np.zeros_like(sheet.hole) for sheet in sheets]
    enclosed = [_enclosed(sheet) for sheet in sheets]
    for _ in range(_ROUNDS):
        wins = [np.zeros_like(sheet.hole) for sheet in sheets]
        for look in looks:
            _claim(sheets, look, wins, refused)
        again = False
        for sheet, won, no, good in zip(sheets, wins, refused, enclosed, strict=True):
            # Views sample far cells sparsely.
            joined = cv2.morphologyEx(won.astype(np.uint8), cv2.MORPH_CLOSE, KERNEL)
            hole = joined.astype(np.bool_) & sheet.possible
            sheet.hole = np.zeros_like(hole)
            for part in _components(hole & ~no):
                if good[part].mean() > 0.5 and int(sheet.known.sum()) >= int(part.sum()):
                    sheet.hole |= part & good
                    part = part & ~good
                if part.any():
                    no |= part
                    again = True
        if not again:
            break


def _claim(
    sheets: Sequence[Sheet], look: Look, wins: Sequence[Mask], refused: Sequence[Mask]
) -> None:
    """Of one view, give each pixel of the thing to the nearest cell that may be there."""
    best = np.full(look.thing.shape, np.inf)
    which = np.full(look.thing.shape, -1)
    cells: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
    for number, sheet in enumerate(sheets):
        row, column, depth = sheet.hits(look)
        cells.append((row, column))
        may = look.thing & (row >= 0)
        may &= look.heights(sheet.plane, look.before) > -BELOW * sheet.thickness
        after = look.heights(sheet.plane, look.after)
        # Where no view saw the surface, what is there now is not it.
        here = np.where(
            sheet.hidden[row, column], after < sheet.thickness, after < -BELOW * sheet.thickness
        )
        may &= here & (sheet.possible & ~refused[number])[row, column]
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


def _enclosed(sheet: Sheet) -> Mask:
    """Cells that have seen surface around them, and not empty space, as beyond the edge of a table.

    What is not hidden is looked for in eight directions.
    """
    known, free = sheet.known, sheet.free >= FREE_VIEWS
    around = np.zeros(known.shape, np.int32)
    through = np.zeros(known.shape, np.int32)
    for down, right in _DIRECTIONS:
        around += _first_met(known, free, down, right)
        through += _first_met(free & ~known, known, down, right)
    return (around >= _MIN_DIRECTIONS) & (around > through)


def _first_met(wanted: Mask, other: Mask, down: int, right: int) -> Mask:
    """Whether a walk from each cell against a direction meets a wanted one before another one."""
    if not down:
        return _first_met(wanted.T, other.T, right, 0).T
    found = wanted.copy()
    rows = range(1, len(found)) if down > 0 else range(len(found) - 2, -1, -1)
    for row in rows:
        before = found[row - down]
        if right:
            before = np.roll(before, right)
            before[0 if right > 0 else -1] = False
        found[row] = wanted[row] | (before & ~other[row])
    return found


def _holes_filled(
    sheet: Sheet, like: Gaussians, inpainter: Inpainting
) -> Iterator[tuple[Gaussians, Mask]]:
    """New Gaussians for each hole of a sheet, and the cells in it and around it."""
    if not sheet.hole.any():
        return
    image = torch.from_numpy((sheet.image * 255).round().astype(np.uint8))
    painted = inpainter.inpaint(image, torch.from_numpy(~sheet.known))
    check_shape("inpainted image", painted, tuple(image.shape))
    colours = painted.double() / 255
    kernel = np.ones((MARGIN + 1, MARGIN + 1), np.uint8)
    for part in _components(sheet.hole):
        around = cv2.dilate(part.astype(np.uint8), kernel).astype(np.bool_)
        yield _new_gaussians(sheet, part, colours, like), around


def _new_gaussians(sheet: Sheet, part: Mask, colours: Tensor, like: Gaussians) -> Gaussians:
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
