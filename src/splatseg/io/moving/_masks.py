"""Masks of views without what moves: where boxes of it project to, and what a network calls so."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool
from torch import Tensor
from torch.nn.functional import interpolate, max_pool2d

from splatseg._check import check_choice
from splatseg.core import Capture, View
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.scans import MovingBox, boxes_at, pixels_of_boxes
from splatseg.core.scene import camera_of_map
from splatseg.errors import InputError, RangeError
from splatseg.io.atomic import path_inside
from splatseg.io.evidence import Evidence
from splatseg.io.images import load_mask, save_png
from splatseg.io.moving._times import CLOCKS, Clock, view_times


@dataclass(frozen=True, slots=True, kw_only=True)
class MovingOptions:
    """What is left out with moving things."""

    margin: float = 0.1
    """By how much boxes are larger on every side, metres: what a box of a person leaves over."""

    grow: int = 3
    """Pixels around those of moving classes that are left out too, borders of labels being
    rough."""

    clock: Clock = "recorded"
    """What the times of boxes are. recorded: what the data set has, such as seconds. frames: the
    last number in the name of a view or scan."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_choice("clock", self.clock, CLOCKS)
        if not (math.isfinite(self.margin) and self.margin >= 0):
            raise RangeError(f"margin: expected 0 or more metres, got {self.margin}.")
        if self.grow < 0:
            raise RangeError(f"grow: expected 0 or more pixels, got {self.grow}.")


@boundary
def mask_moving(
    capture: Capture,
    folder: Path,
    *,
    boxes: Sequence[MovingBox] = (),
    labels: Evidence | None = None,
    classes: Sequence[str] = (),
    times: Mapping[str, float] | None = None,
    options: MovingOptions | None = None,
    report: Callable[[str], None] | None = None,
) -> Capture:
    """The capture whose training views have masks without moving things.

    Masks of the capture count as well. Views that show nothing that moves keep theirs.

    Args:
        capture: The capture.
        folder: Where masks are written, PNG by view name: 0 where something moves.
        boxes: Boxes of moving things, see `read_moving`.
        labels: Label maps of views, for `classes`.
        classes: Names of classes of these whose things move, such as ``car``.
        times: When views were taken, by their names; None is `view_times` of the options' clock.
        options: Margins.
        report: Told in a sentence what is left out.

    Raises:
        InputError: If classes are given without label maps, the maps do not know one, a view has
            no time, or no box is there at the time of any view.
        ShapeError: If a label map is not of its view.
        OutputError: If a mask cannot be written.
    """
    options = options or MovingOptions()
    ids = _ids_of(labels, classes)
    known = {} if times is None else times
    if boxes:
        known = view_times(capture, clock=options.clock) if times is None else times
        _check_clock(boxes, [_time_of(view, known) for view in capture.train_views])
    unit = capture.metres_per_unit or 1.0
    views: list[View] = []
    changed = left_out = pixels = 0
    for view in capture.views:
        if view.split != "train":
            views.append(view)
            continue
        moving = torch.zeros(view.camera.height, view.camera.width, dtype=torch.bool)
        if boxes:
            there = boxes_at(boxes, _time_of(view, known))
            moving |= pixels_of_boxes(view.camera, there, margin=options.margin / unit)
        if labels is not None and ids and view.name in labels.view_names:
            moving |= _labelled(labels, view, ids, options.grow)
        pixels += moving.numel()
        if not bool(moving.any()):
            views.append(view)
            continue
        changed, left_out = changed + 1, left_out + int(moving.sum())
        views.append(_masked(view, moving, folder))
    if report is not None:
        share = left_out / max(pixels, 1)
        report(
            f"moving things are left out of {changed} of the {len(capture.train_views)} training "
            f"views, {share:.1%} of their pixels"
        )
    return replace(capture, views=tuple(views))


def _ids_of(labels: Evidence | None, classes: Sequence[str]) -> tuple[int, ...]:
    if not classes:
        return ()
    if labels is None or labels.classes is None:
        raise InputError(
            "classes: expected label maps with names of classes, to know what moves, got "
            f"{'none' if labels is None else 'maps without names'}."
        )
    return tuple(labels.classes.by_name(name).id for name in classes)


def _time_of(view: View, times: Mapping[str, float]) -> float:
    if view.name not in times:
        raise InputError(f"times: expected one of every training view, got none of {view.name!r}.")
    return times[view.name]


def _check_clock(boxes: Sequence[MovingBox], times: Sequence[float]) -> None:
    """Refuse boxes of which none is there when a view was taken: their clock is another."""
    if any(boxes_at(boxes, time) for time in times) or not times:
        return
    raise InputError(
        f"boxes: expected some at the times of views, {min(times):g} to {max(times):g}, got boxes "
        f"from {min(box.start for box in boxes):g} to {max(box.end for box in boxes):g}; is their "
        "clock another (recorded or frames)?"
    )


def _labelled(
    labels: Evidence, view: View, ids: Collection[int], grow: int
) -> Bool[Tensor, "height width"]:
    """Pixels of some classes, those around them too, in the size of the photograph."""
    found = labels.label_map(view.name).ids
    camera_of_map(view, found.shape[0], found.shape[1])
    moving = torch.isin(found, found.new_tensor(sorted(ids))).float()[None, None]
    size = (view.camera.height, view.camera.width)
    if tuple(found.shape) != size:
        moving = interpolate(moving, size=size, mode="nearest-exact")
    side = 2 * grow + 1
    return max_pool2d(moving, side, stride=1, padding=grow)[0, 0] > 0


def _masked(view: View, moving: Bool[Tensor, "height width"], folder: Path) -> View:
    """The view with a mask that lacks some pixels as well, written to the folder."""
    own = load_mask(view)
    used = ~moving if own is None else ~moving & own.bool()
    path = path_inside(folder, f"{view.name}.png")
    save_png(torch.where(used, 255, 0).to(torch.uint8), path)
    return replace(view, mask=path)
