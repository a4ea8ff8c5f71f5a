"""Things that move while a scene is recorded: boxes around them, and what lies in the boxes."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.camera import Camera
from splatseg.core.rigid import normalised, rotation_from_quaternion
from splatseg.errors import RangeError

_RAYS = 1 << 16


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MovingBox:
    """A box around a moving thing during a span of time.

    A thing that moves has many: one for each moment at which it was measured.

    Raises:
        ShapeError: If the centre is not three numbers, or the rotation not four.
        RangeError: If a value is not finite, a side has no length, or the span ends before it
            starts.
    """

    centre: Float[Tensor, "3"]
    """World, scene units, float64."""

    size: tuple[float, float, float]
    """Whole length of its sides along its own x, y and z, scene units, positive."""

    rotation: Float[Tensor, "4"]
    """Unit quaternion (w, x, y, z), world_from_box; it is normalised."""

    start: float = -math.inf
    """When it is there first, on the clock of views and scans."""

    end: float = math.inf
    """When it is there last; both ends belong to the span."""

    name: str = ""
    """What it is around, such as ``car 12``."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_shape("centre", self.centre, (3,))
        check_finite("centre", self.centre)
        check_shape("rotation", self.rotation, (4,))
        if not all(math.isfinite(side) and side > 0 for side in self.size):
            raise RangeError(f"size: expected three positive lengths, got {self.size}.")
        if not self.start <= self.end:
            raise RangeError(
                f"start, end: expected a span of time, got {self.start:g} to {self.end:g}."
            )
        object.__setattr__(self, "centre", self.centre.detach().cpu().double())
        object.__setattr__(self, "rotation", normalised(self.rotation.detach().cpu().double()))


@boundary
def boxes_at(boxes: Iterable[MovingBox], time: float) -> tuple[MovingBox, ...]:
    """The boxes that are there at a time.

    Raises:
        RangeError: If the time is NaN.
    """
    if math.isnan(time):
        raise RangeError("time: expected a number, got nan.")
    return tuple(box for box in boxes if box.start <= time <= box.end)


@boundary
def inside_boxes(
    points: Float[Tensor, "p 3"], boxes: Sequence[MovingBox], *, margin: float = 0.0
) -> Bool[Tensor, "p"]:
    """Which points lie in any of some boxes, their faces included.

    Args:
        points: World, scene units.
        boxes: Those of the moment at which the points were measured: `boxes_at`.
        margin: By how much boxes are larger on every side, scene units.

    Raises:
        ShapeError: If the points are not (p, 3).
        RangeError: If the margin is negative or not finite.
    """
    check_shape("points", points, (None, 3))
    _check_margin(margin)
    at = points.detach().cpu().double()
    inside = torch.zeros(len(at), dtype=torch.bool)
    for box in boxes:
        local = (at - box.centre) @ rotation_from_quaternion(box.rotation)
        inside |= (local.abs() <= _half(box, margin)).all(dim=1)
    return inside


@boundary
def pixels_of_boxes(
    camera: Camera, boxes: Sequence[MovingBox], *, margin: float = 0.0
) -> Bool[Tensor, "height width"]:
    r"""Which pixels show any of some boxes: those whose central ray meets one.

    A ray o + t d meets the box of half sides h where, in the axes of the box,

    .. math:: \max_k \min_\pm \frac{\pm h_k - o_k}{d_k} \le
              \min_k \max_\pm \frac{\pm h_k - o_k}{d_k}, \qquad
              0 \le \min_k \max_\pm \frac{\pm h_k - o_k}{d_k}

    Whatever the lens, and where a box reaches behind the camera, that is exact. What stands
    before a box is taken for it too.

    Args:
        camera: The view.
        boxes: Those of its moment: `boxes_at`.
        margin: By how much boxes are larger on every side, scene units.

    Raises:
        RangeError: If the margin is negative or not finite.
    """
    _check_margin(margin)
    shown = torch.zeros(camera.height * camera.width, dtype=torch.bool)
    if not boxes:
        return shown.reshape(camera.height, camera.width)
    origin, directions = camera.rays()
    rays = directions.detach().cpu().double().reshape(-1, 3)
    for box in boxes:
        rotation = rotation_from_quaternion(box.rotation)
        start = (origin.detach().cpu().double() - box.centre) @ rotation
        half = _half(box, margin)
        for first in range(0, len(rays), _RAYS):
            part = slice(first, first + _RAYS)
            shown[part] |= _meets(start, rays[part] @ rotation, half)
    return shown.reshape(camera.height, camera.width)


def _meets(
    start: Float[Tensor, "3"], directions: Float[Tensor, "n 3"], half: Float[Tensor, "3"]
) -> Bool[Tensor, "n"]:
    """Which rays meet the box around 0; one along a face's plane meets what it runs within."""
    across = directions != 0
    safe = torch.where(across, directions, 1.0)
    one, other = (-half - start) / safe, (half - start) / safe
    within = (start.abs() <= half).expand_as(directions)
    empty = torch.where(within, -math.inf, math.inf)
    enter = torch.where(across, torch.minimum(one, other), empty).amax(dim=1)
    leave = torch.where(across, torch.maximum(one, other), -empty).amin(dim=1)
    return (enter <= leave) & (leave >= 0)


def _half(box: MovingBox, margin: float) -> Float[Tensor, "3"]:
    return torch.tensor(box.size, dtype=torch.float64) / 2 + margin


def _check_margin(margin: float) -> None:
    if not (math.isfinite(margin) and margin >= 0):
        raise RangeError(f"margin: expected 0 or more, got {margin}.")
