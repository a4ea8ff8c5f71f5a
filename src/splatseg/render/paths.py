r"""A smooth camera path through what was photographed, for films of a scene.

The path is a uniform cubic B-spline over some of the captured poses: with the four control poses
around a place and the basis :math:`b_0 \dots b_3`, which is positive and adds up to 1,

.. math:: x(u) = \sum_j b_j(u) \, x_j, \qquad q(u) \propto \sum_j \pm b_j(u) \, q_j

with signs that make neighbouring quaternions agree. A B-spline does not pass through its control
points but stays in the convex hull of any four that follow each other, so the path smooths the
shaking of a hand and yet stays where photographs were taken, which is where the scene is known
and where there are no walls. Speed is constant: every frame covers the same length of pose space,
in which turning by one radian counts as far as half the capture is wide.

References:
    Kim, Kim and Shin, A General Construction Scheme for Unit Quaternion Curves (1995).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg._check import check_shape
from splatseg.core import Camera, View
from splatseg.core.rigid import quaternion_from_rotation, rotation_from_quaternion
from splatseg.errors import InputError, RangeError

_MOST_KEYS = 30
_RADIAN = 0.5
# Rounds of averaging each key's orientation with its neighbours': people look about far more
# than a film should.
_CALM = 6
# A tour that comes back is taken if it is hardly longer than one that does not.
_CLOSED = 1.35
# Leaving the captured places by some length costs this many times as much as the length.
_DETOUR = 4.0
_FORWARD = 0.95
# Of the middle nine tenths of the captured places.
_ELLIPSE = 0.8
_DENSE = 32
# Looking this near to straight up or down (sine of the angle), the horizon gives no up.
_STEEP = (0.15, 0.45)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Poses:
    """Places and orientations, world from camera."""

    centres: Float[Tensor, "n 3"]
    quaternions: Float[Tensor, "n 4"]

    def __len__(self) -> int:
        return len(self.centres)

    def __getitem__(self, index: Tensor) -> "_Poses":
        return _Poses(centres=self.centres[index], quaternions=self.quaternions[index])


def camera_path(
    views: Sequence[View],
    *,
    frames: int = 240,
    up: Sequence[float] | Float[Tensor, "3"] | None = None,
    focus: float | None = None,
) -> tuple[Camera, ...]:
    """Cameras along a smooth path near the cameras of views.

    Where all views look one way from one place (a forward-facing capture), the path is an
    ellipse across their places. Otherwise it is a spline over up to 30 of them, spread over the
    poses and put in an order that makes the way short and keeps it near captured places; it
    closes if its ends are near each other. The horizon is level.

    Args:
        views: Captured views, in any order; usually the training views.
        frames: How many cameras.
        up: Direction away from the ground, world. None is the mean of the images' up.
        focus: Distance of what is looked at from an ellipse, scene units. None looks straight
            ahead. It has no effect on the other paths.

    Returns:
        Pinhole cameras with the size and focal length that are the most common among the views.

    Raises:
        InputError: If there are no views.
        RangeError: If `frames` or `focus` is not positive.

    Example:
        >>> from splatseg.core import Camera, View
        >>> poses = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
        >>> poses[:, 2, 3] = torch.tensor([0.0, -1.0, -2.0])
        >>> views = [View(name=str(i), camera=Camera(width=8, height=6, fx=9.0, fy=9.0, cx=4.0,
        ...          cy=3.0, cam_from_world=pose)) for i, pose in enumerate(poses)]
        >>> path = camera_path(views, frames=5)
        >>> sorted(round(abs(float(camera.centre[2])), 2) for camera in path)
        [0.0, 0.5, 1.0, 1.5, 2.0]
    """
    if not views:
        raise InputError("views: expected at least one view to make a path of, got none.")
    if frames < 1:
        raise RangeError(f"frames: expected at least 1, got {frames}.")
    if focus is not None and not (math.isfinite(focus) and focus > 0):
        raise RangeError(f"focus: expected a positive distance, got {focus}.")
    world_from_cam = torch.stack([view.camera.world_from_cam.detach().cpu() for view in views])
    rotations = world_from_cam[:, :3, :3]
    level = _level(rotations, up)
    typical = _typical(views)
    if is_forward_facing(views):
        poses = _ellipse(world_from_cam, level, frames=frames, focus=focus)
        return tuple(_camera(typical, pose) for pose in poses)
    captured = _Poses(
        centres=world_from_cam[:, :3, 3], quaternions=quaternion_from_rotation(rotations)
    )
    keys, closed = _keys(captured)
    path = _along_spline(keys, frames=frames, closed=closed, unit=_unit(captured))
    turned = _levelled(rotation_from_quaternion(path.quaternions), level)
    return tuple(
        _camera(typical, _pose(rotation, centre))
        for rotation, centre in zip(turned, path.centres, strict=True)
    )


def is_forward_facing(views: Sequence[View]) -> bool:
    """Whether views look one way from places beside each other, not behind each other.

    The mean of the looking directions has a length of 0.95 or more, and the places spread
    across it at least twice as far as along it. A drive down a street is not forward-facing.
    """
    if len(views) < 3:
        return False
    pose = torch.stack([view.camera.world_from_cam.detach().cpu() for view in views])
    mean = pose[:, :3, 2].mean(dim=0)
    if float(mean.norm()) < _FORWARD:
        return False
    offsets = pose[:, :3, 3] - pose[:, :3, 3].mean(dim=0)
    along = offsets @ (mean / mean.norm())
    across = (offsets.square().sum(dim=1) - along.square()).clamp_min(0)
    return float(across.mean()) > 4 * float(along.square().mean())


def _typical(views: Sequence[View]) -> Camera:
    """The most common size; of its cameras the one with the median focal length, no lens."""
    sizes = [(view.camera.width, view.camera.height) for view in views]
    size = max(sorted(set(sizes)), key=sizes.count)
    cameras = [view.camera for view, own in zip(views, sizes, strict=True) if own == size]
    chosen = sorted(cameras, key=lambda camera: camera.fx)[len(cameras) // 2]
    return replace(chosen, model="pinhole", distortion=())


def _level(
    rotations: Float[Tensor, "n 3 3"], up: Sequence[float] | Tensor | None
) -> Float[Tensor, "3"]:
    """Unit vector away from the ground."""
    if up is None:
        direction = -rotations[:, :, 1].mean(dim=0)
        if float(direction.norm()) < 0.1:
            direction = -rotations[0, :, 1]
    else:
        direction = torch.as_tensor(up, dtype=torch.float64)
        check_shape("up", direction, (3,))
        if not float(direction.norm()) > 0:
            raise RangeError("up: expected a direction, got a vector of length zero.")
    return direction / direction.norm()


def _unit(poses: _Poses) -> float:
    """Length that one radian counts as; 1 for a capture from one spot."""
    offsets = poses.centres - poses.centres.mean(dim=0)
    spread = float(offsets.square().sum(dim=1).mean().sqrt())
    return _RADIAN * spread if spread > 1e-9 else 1.0


def _angles(a: Float[Tensor, "*n 4"], b: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n"]:
    """Radians between orientations."""
    # The arc cosine of the product would be off by 1e-8 where they agree.
    chord = torch.minimum((a - b).norm(dim=-1), (a + b).norm(dim=-1))
    return 4 * torch.asin((chord / 2).clamp(max=1.0))


def _keys(captured: _Poses) -> tuple[_Poses, bool]:
    """Control poses in their order along the path, and whether it closes."""
    unit = _unit(captured)
    chosen = captured[_spread(captured, unit)]
    if len(chosen) < 3:
        return chosen, False
    costs = _costs(chosen, captured, unit)
    path, path_length = _tour(costs, closed=False)
    round_, round_length = _tour(costs, closed=True)
    closed = len(chosen) >= 5 and round_length <= _CLOSED * path_length
    ordered = chosen[round_ if closed else path]
    return _calmed(ordered, closed=closed), closed


def _calmed(keys: _Poses, *, closed: bool) -> _Poses:
    """The same places with orientations averaged along the way, weights 1 2 1, a few rounds."""
    quaternions = keys.quaternions
    for _ in range(_CALM):
        around = (
            torch.cat((quaternions[-1:], quaternions, quaternions[:1]))
            if closed
            else torch.cat((quaternions[:1], quaternions, quaternions[-1:]))
        )
        before, after = (
            torch.where((x * quaternions).sum(dim=1, keepdim=True) < 0, -x, x)
            for x in (around[:-2], around[2:])
        )
        blend = before + 2 * quaternions + after
        quaternions = blend / blend.norm(dim=1, keepdim=True)
    return _Poses(centres=keys.centres, quaternions=quaternions)


def _spread(poses: _Poses, unit: float) -> Int64[Tensor, "k"]:
    """Indices of at most 30 poses, each as far as possible from those before it.

    The first is the one nearest the middle; one that repeats a pose is not taken.
    """
    middle = poses.centres.mean(dim=0)
    index = int((poses.centres - middle).norm(dim=1).argmin())
    chosen: list[int] = []
    distance = poses.centres.new_full((len(poses),), math.inf)
    while len(chosen) < _MOST_KEYS:
        chosen.append(index)
        way = (poses.centres - poses.centres[index]).norm(dim=1)
        turn = unit * _angles(poses.quaternions, poses.quaternions[index])
        distance = torch.minimum(distance, way + turn)
        index = int(distance.argmax())
        if float(distance[index]) <= 1e-9:
            break
    return torch.tensor(chosen)


def _costs(keys: _Poses, captured: _Poses, unit: float) -> Float[Tensor, "k k"]:
    """What it costs to go from key to key: way, turn, and how far it strays from the captured.

    To stray is to have, midway, no captured place as near as they are to each other.
    """
    way = (keys.centres[:, None] - keys.centres).norm(dim=-1)
    turn = unit * _angles(keys.quaternions[:, None], keys.quaternions)
    midway = (keys.centres[:, None] + keys.centres) / 2
    stray = torch.cdist(midway.flatten(0, 1), captured.centres).amin(dim=1).view_as(way)
    apart = torch.cdist(captured.centres, captured.centres).fill_diagonal_(torch.inf)
    stray = (stray - apart.amin(dim=1).median()).clamp_min(0)
    return way + turn + _DETOUR * stray


def _tour(costs: Float[Tensor, "k k"], *, closed: bool) -> tuple[Int64[Tensor, "k"], float]:
    """A short order: each key where it costs least, farthest keys first, mended by 2-opt."""
    table: list[list[float]] = costs.tolist()
    order = [0]
    for key in range(1, len(table)):
        row = table[key]
        best, place = row[order[-1]], len(order)
        if closed:
            best += row[order[0]] - table[order[-1]][order[0]]
        elif row[order[0]] < best:
            best, place = row[order[0]], 0
        for i, (a, b) in enumerate(pairwise(order), start=1):
            if row[a] + row[b] - table[a][b] < best:
                best, place = row[a] + row[b] - table[a][b], i
        order.insert(place, key)
    order = _mended(order, table, closed=closed)
    return torch.tensor(order), _length(order, table, closed=closed)


def _length(order: list[int], table: list[list[float]], *, closed: bool) -> float:
    total = sum(table[a][b] for a, b in pairwise(order))
    return total + (table[order[-1]][order[0]] if closed else 0.0)


def _mended(order: list[int], table: list[list[float]], *, closed: bool) -> list[int]:
    """2-opt: turn round any stretch of the order as long as that makes it shorter."""
    count = len(order)
    improved = True
    while improved:
        improved = False
        for i in range(count - 1):
            for j in range(i + 1, count):
                before = order[i - 1] if i > 0 or closed else None
                after = order[(j + 1) % count] if j + 1 < count or closed else None
                if before == order[j] or after == order[i]:
                    continue
                gain = 0.0
                if before is not None:
                    gain += table[before][order[i]] - table[before][order[j]]
                if after is not None:
                    gain += table[order[j]][after] - table[order[i]][after]
                if gain > 1e-9:
                    order[i : j + 1] = order[i : j + 1][::-1]
                    improved = True
    return order


def _along_spline(keys: _Poses, *, frames: int, closed: bool, unit: float) -> _Poses:
    """Frames at equal steps of pose space along the B-spline over the keys."""
    if len(keys) == 1:
        return keys[torch.zeros(frames, dtype=torch.int64)]
    controls = _controls(keys, closed=closed)
    spans = len(controls) - 3
    dense = _spline(controls, torch.linspace(0, spans, spans * _DENSE + 1, dtype=torch.float64))
    way = (dense.centres[1:] - dense.centres[:-1]).norm(dim=1)
    turn = unit * _angles(dense.quaternions[1:], dense.quaternions[:-1])
    length = torch.cat((way.new_zeros(1), (way.square() + turn.square()).sqrt().cumsum(dim=0)))
    # The last frame of a closed film is one step before its first.
    share = torch.arange(frames, dtype=torch.float64) / max(1, frames if closed else frames - 1)
    wanted = share * length[-1]
    high = torch.searchsorted(length, wanted).clamp(1, len(length) - 1)
    low = high - 1
    within = (wanted - length[low]) / (length[high] - length[low]).clamp_min(1e-15)
    return _spline(controls, (low + within) / _DENSE)


def _controls(keys: _Poses, *, closed: bool) -> _Poses:
    """Keys with the neighbours that the ends need, and quaternions of agreeing signs.

    An open spline has its end keys mirrored outwards, so that it begins and ends at them.
    """
    count = len(keys)
    if closed:
        padded = keys[torch.tensor([count - 1, *range(count), 0, 1])]
        centres, quaternions = padded.centres, padded.quaternions
    else:
        quaternions = _agreeing(keys.quaternions)
        centres, quaternions = (
            torch.cat((2 * x[:1] - x[1:2], x, 2 * x[-1:] - x[-2:-1]))
            for x in (keys.centres, quaternions)
        )
    return _Poses(centres=centres, quaternions=_agreeing(quaternions))


def _agreeing(quaternions: Float[Tensor, "n 4"]) -> Float[Tensor, "n 4"]:
    """The same orientations with signs that make each the nearer one to the one before."""
    flips = (quaternions[1:] * quaternions[:-1]).sum(dim=1) < 0
    signs = torch.where(flips, -1.0, 1.0).double().cumprod(dim=0)
    return torch.cat((quaternions[:1], quaternions[1:] * signs[:, None]))


def _spline(controls: _Poses, at: Float[Tensor, "m"]) -> _Poses:
    """The B-spline at parameters from 0 to the number of controls less 3."""
    first = at.floor().long().clamp(0, len(controls) - 4)
    t = (at - first)[:, None]
    basis = (
        (1 - t) ** 3 / 6,
        (3 * t**3 - 6 * t**2 + 4) / 6,
        (-3 * t**3 + 3 * t**2 + 3 * t + 1) / 6,
        t**3 / 6,
    )
    centres = sum(b * controls.centres[first + j] for j, b in enumerate(basis))
    blend = sum(b * controls.quaternions[first + j] for j, b in enumerate(basis))
    quaternions = torch.as_tensor(blend)
    return _Poses(
        centres=torch.as_tensor(centres),
        quaternions=quaternions / quaternions.norm(dim=1, keepdim=True).clamp_min(1e-12),
    )


def _levelled(
    rotations: Float[Tensor, "n 3 3"], level: Float[Tensor, "3"]
) -> Float[Tensor, "n 3 3"]:
    """The same looking directions without roll; steep views keep the roll that they have."""
    forward, own = rotations[:, :, 2], -rotations[:, :, 1]
    sine = torch.linalg.cross(forward, level.expand_as(forward)).norm(dim=1, keepdim=True)
    share = ((sine - _STEEP[0]) / (_STEEP[1] - _STEEP[0])).clamp(0, 1)
    across = level - (forward @ level)[:, None] * forward
    across = across / sine.clamp_min(1e-12)
    # A view that was taken upside down turns over the short way, if at all.
    up = share * across + (1 - share) * own
    return _frame(forward, torch.where(up.norm(dim=1, keepdim=True) < 1e-6, own, up))


def _frame(forward: Float[Tensor, "n 3"], up: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 3"]:
    """World from camera: x right, y down, z forward."""
    right = torch.linalg.cross(forward, up)
    right = right / right.norm(dim=-1, keepdim=True)
    return torch.stack((right, torch.linalg.cross(forward, right), forward), dim=-1)


def _ellipse(
    world_from_cam: Float[Tensor, "n 4 4"],
    level: Float[Tensor, "3"],
    *,
    frames: int,
    focus: float | None,
) -> list[Tensor]:
    """Once round an ellipse across the looking direction, over most of where cameras stood."""
    forward = world_from_cam[:, :3, 2].mean(dim=0)
    forward = forward / forward.norm()
    own = -world_from_cam[:, :3, 1].mean(dim=0, keepdim=True)
    middle = _levelled(_frame(forward[None], own), level)[0]
    centres = world_from_cam[:, :3, 3]
    ends = torch.quantile(centres @ middle, torch.tensor([0.05, 0.95]).double(), dim=0)
    centre = middle @ ends.mean(dim=0)
    radii = _ELLIPSE * (ends[1] - ends[0]) / 2
    turn = 2 * math.pi * torch.arange(frames, dtype=torch.float64) / frames
    round_ = torch.stack((turn.cos(), turn.sin(), torch.zeros_like(turn)), dim=-1) * radii
    places = centre + round_ @ middle.T
    if focus is None:
        rotations = middle.expand(frames, 3, 3)
    else:
        way = centre + focus * forward - places
        way = way / way.norm(dim=1, keepdim=True)
        rotations = _frame(way, -middle[:, 1].expand_as(way))
    return [_pose(rotation, place) for rotation, place in zip(rotations, places, strict=True)]


def _pose(rotation: Float[Tensor, "3 3"], centre: Float[Tensor, "3"]) -> Float[Tensor, "4 4"]:
    """Camera from world of a camera that stands at `centre`."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -rotation.T @ centre
    return pose


def _camera(typical: Camera, pose: Float[Tensor, "4 4"]) -> Camera:
    return replace(typical, cam_from_world=pose)
