r"""A smooth camera path near the captured views, for films of a scene.

The path is a uniform cubic B-spline over some of the captured poses: with the four control poses
around a parameter and the basis :math:`b_0 \dots b_3`, which is positive and adds up to 1,

.. math:: x(u) = \sum_j b_j(u) \, x_j, \qquad q(u) \propto \sum_j \pm b_j(u) \, q_j

with signs that make neighbouring quaternions agree. A B-spline does not pass through its control
points but stays in the convex hull of any four that follow each other, so the path smooths the
shake of a hand-held camera and yet stays near the captured positions, where the scene is
observed and free of obstacles. Speed is constant: every frame covers the same length of pose space,
in which one radian counts as half the spread of the captured positions.

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

# Length of the mean of the viewing directions, 1 where all are the same.
_MIN_MEAN_LENGTH = 0.95
# Size of the ellipse relative to the central nine tenths of the captured positions.
_ELLIPSE_SHARE = 0.8
# Between these sines of the angle to the vertical, the horizon is faded in; below there is none.
_STEEP_SINES = (0.15, 0.45)


def camera_path(
    views: Sequence[View],
    *,
    frames: int = 240,
    up: Sequence[float] | Float[Tensor, "3"] | None = None,
    focus: float | None = None,
) -> tuple[Camera, ...]:
    """Cameras along a smooth path near the cameras of views.

    For forward-facing captures, the path is an ellipse across the captured positions. Otherwise
    it is a spline over up to 30 of the poses, found by farthest-point sampling and ordered as a
    short tour near the captured positions; it closes if its ends are near each other. The
    horizon is level.

    Args:
        views: Captured views, in any order; usually the training views.
        frames: Number of cameras.
        up: Direction away from the ground, world. None is the mean of the cameras' up.
        focus: Distance of the focus point of an ellipse, scene units. None keeps the viewing
            directions parallel. It has no effect on the other paths.

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
    _check_arguments(views, frames, focus)
    world_from_cam = torch.stack([view.camera.world_from_cam.detach().cpu() for view in views])
    rotations = world_from_cam[:, :3, :3]
    level = _level(rotations, up)
    typical = _typical(views)
    if is_forward_facing(views):
        poses = _ellipse(world_from_cam, level, frames=frames, focus=focus)
        return tuple(_camera(typical, pose) for pose in poses)
    captured = Poses(
        centres=world_from_cam[:, :3, 3], quaternions=quaternion_from_rotation(rotations)
    )
    keys, closed = key_poses(captured)
    path = poses_along_spline(keys, frames=frames, closed=closed, unit=radian_length(captured))
    turned = _levelled(rotation_from_quaternion(path.quaternions), level)
    return tuple(
        _camera(typical, _pose(rotation, centre))
        for rotation, centre in zip(turned, path.centres, strict=True)
    )


def is_forward_facing(views: Sequence[View]) -> bool:
    """Whether all viewing directions are similar and the positions lie beside each other.

    The mean of the viewing directions has a length of 0.95 or more, and the positions spread
    across it at least twice as far as along it. A drive down a street is not forward-facing.
    """
    if len(views) < 3:
        return False
    pose = torch.stack([view.camera.world_from_cam.detach().cpu() for view in views])
    mean = pose[:, :3, 2].mean(dim=0)
    if float(mean.norm()) < _MIN_MEAN_LENGTH:
        return False
    offsets = pose[:, :3, 3] - pose[:, :3, 3].mean(dim=0)
    along = offsets @ (mean / mean.norm())
    across = (offsets.square().sum(dim=1) - along.square()).clamp_min(0)
    return float(across.mean()) > 4 * float(along.square().mean())


def _check_arguments(views: Sequence[View], frames: int, focus: float | None) -> None:
    if not views:
        raise InputError("views: expected at least one view to make a path of, got none.")
    if frames < 1:
        raise RangeError(f"frames: expected at least 1, got {frames}.")
    if focus is not None and not (math.isfinite(focus) and focus > 0):
        raise RangeError(f"focus: expected a positive distance, got {focus}.")


def _typical(views: Sequence[View]) -> Camera:
    """The most common size; of its cameras the one with the median focal length, as a pinhole."""
    sizes = [(view.camera.width, view.camera.height) for view in views]
    size = max(sorted(set(sizes)), key=sizes.count)
    cameras = [view.camera for view, own_size in zip(views, sizes, strict=True) if own_size == size]
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


def _levelled(
    rotations: Float[Tensor, "n 3 3"], level: Float[Tensor, "3"]
) -> Float[Tensor, "n 3 3"]:
    """The same viewing directions without roll; steep views keep their roll."""
    forward, camera_up = rotations[:, :, 2], -rotations[:, :, 1]
    sine = torch.linalg.cross(forward, level.expand_as(forward)).norm(dim=1, keepdim=True)
    share = ((sine - _STEEP_SINES[0]) / (_STEEP_SINES[1] - _STEEP_SINES[0])).clamp(0, 1)
    across = level - (forward @ level)[:, None] * forward
    across = across / sine.clamp_min(1e-12)
    # Between the two the up direction is blended.
    up = share * across + (1 - share) * camera_up
    return _frame(forward, torch.where(up.norm(dim=1, keepdim=True) < 1e-6, camera_up, up))


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
    """Poses along an ellipse across the viewing direction, over most of the captured positions."""
    forward = world_from_cam[:, :3, 2].mean(dim=0)
    forward = forward / forward.norm()
    camera_up = -world_from_cam[:, :3, 1].mean(dim=0, keepdim=True)
    world_from_ellipse = _levelled(_frame(forward[None], camera_up), level)[0]
    centres = world_from_cam[:, :3, 3]
    ends = torch.quantile(centres @ world_from_ellipse, torch.tensor([0.05, 0.95]).double(), dim=0)
    centre = world_from_ellipse @ ends.mean(dim=0)
    radii = _ELLIPSE_SHARE * (ends[1] - ends[0]) / 2
    angles = 2 * math.pi * torch.arange(frames, dtype=torch.float64) / frames
    offsets_ = torch.stack((angles.cos(), angles.sin(), torch.zeros_like(angles)), dim=-1) * radii
    positions = centre + offsets_ @ world_from_ellipse.T
    if focus is None:
        rotations = world_from_ellipse.expand(frames, 3, 3)
    else:
        directions = centre + focus * forward - positions
        directions = directions / directions.norm(dim=1, keepdim=True)
        rotations = _frame(directions, -world_from_ellipse[:, 1].expand_as(directions))
    return [
        _pose(rotation, position) for rotation, position in zip(rotations, positions, strict=True)
    ]


def _pose(rotation: Float[Tensor, "3 3"], centre: Float[Tensor, "3"]) -> Float[Tensor, "4 4"]:
    """Camera from world of a camera at `centre`."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -rotation.T @ centre
    return pose


def _camera(typical: Camera, pose: Float[Tensor, "4 4"]) -> Camera:
    return replace(typical, cam_from_world=pose)


# Control poses of a camera path: farthest-point samples of the captured poses in a short tour.


_MAX_KEYS = 30
# Rounds of averaging each key's orientation with its neighbours: hand-held cameras turn far more
# than a film should.
_SMOOTHING_ROUNDS = 6
# A closed tour is taken if it is at most this many times as long as an open one.
_MAX_CLOSED_RATIO = 1.35
# Cost of the distance from the captured positions, relative to the length of the path.
_DETOUR_WEIGHT = 4.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Poses:
    """Positions and orientations, world from camera."""

    centres: Float[Tensor, "n 3"]
    quaternions: Float[Tensor, "n 4"]

    def __len__(self) -> int:
        return len(self.centres)

    def __getitem__(self, index: Tensor) -> "Poses":
        return Poses(centres=self.centres[index], quaternions=self.quaternions[index])


def key_poses(captured: Poses) -> tuple[Poses, bool]:
    """Control poses in their order along the path, and whether the path is closed."""
    unit = radian_length(captured)
    chosen = captured[_farthest_poses(captured, unit)]
    if len(chosen) < 3:
        return chosen, False
    costs = _costs(chosen, captured, unit)
    open_tour, open_length = _tour(costs, closed=False)
    closed_tour, closed_length = _tour(costs, closed=True)
    closed = len(chosen) >= 5 and closed_length <= _MAX_CLOSED_RATIO * open_length
    ordered = chosen[closed_tour if closed else open_tour]
    return _smoothed(ordered, closed=closed), closed


def _smoothed(keys: Poses, *, closed: bool) -> Poses:
    """The same positions with orientations smoothed along the path, weights 1 2 1."""
    quaternions = keys.quaternions
    for _ in range(_SMOOTHING_ROUNDS):
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
    return Poses(centres=keys.centres, quaternions=quaternions)


def _farthest_poses(poses: Poses, unit: float) -> Int64[Tensor, "k"]:
    """Indices of at most 30 poses by farthest-point sampling.

    The first is the one nearest the mean position; repeated poses are not taken.
    """
    centre = poses.centres.mean(dim=0)
    index = int((poses.centres - centre).norm(dim=1).argmin())
    chosen: list[int] = []
    distance = poses.centres.new_full((len(poses),), math.inf)
    while len(chosen) < _MAX_KEYS:
        chosen.append(index)
        distances = (poses.centres - poses.centres[index]).norm(dim=1)
        angles = unit * angles_between(poses.quaternions, poses.quaternions[index])
        distance = torch.minimum(distance, distances + angles)
        index = int(distance.argmax())
        if float(distance[index]) <= 1e-9:
            break
    return torch.tensor(chosen)


def _costs(keys: Poses, captured: Poses, unit: float) -> Float[Tensor, "k k"]:
    """Cost between keys: distance, rotation, and distance of the midpoint from captured positions.

    The last counts beyond the median distance of neighbouring captured positions.
    """
    distances = (keys.centres[:, None] - keys.centres).norm(dim=-1)
    angles = unit * angles_between(keys.quaternions[:, None], keys.quaternions)
    midway = (keys.centres[:, None] + keys.centres) / 2
    detour = torch.cdist(midway.flatten(0, 1), captured.centres).amin(dim=1).view_as(distances)
    apart = torch.cdist(captured.centres, captured.centres).fill_diagonal_(torch.inf)
    detour = (detour - apart.amin(dim=1).median()).clamp_min(0)
    return distances + angles + _DETOUR_WEIGHT * detour


def _tour(costs: Float[Tensor, "k k"], *, closed: bool) -> tuple[Int64[Tensor, "k"], float]:
    """A short tour: cheapest insertion in the order of the keys, improved by 2-opt."""
    table: list[list[float]] = costs.tolist()
    order = [0]
    for key in range(1, len(table)):
        row = table[key]
        best, insert_at = row[order[-1]], len(order)
        if closed:
            best += row[order[0]] - table[order[-1]][order[0]]
        elif row[order[0]] < best:
            best, insert_at = row[order[0]], 0
        for i, (a, b) in enumerate(pairwise(order), start=1):
            if row[a] + row[b] - table[a][b] < best:
                best, insert_at = row[a] + row[b] - table[a][b], i
        order.insert(insert_at, key)
    order = _two_opt(order, table, closed=closed)
    return torch.tensor(order), _length(order, table, closed=closed)


def _length(order: list[int], table: list[list[float]], *, closed: bool) -> float:
    total = sum(table[a][b] for a, b in pairwise(order))
    return total + (table[order[-1]][order[0]] if closed else 0.0)


def _two_opt(order: list[int], table: list[list[float]], *, closed: bool) -> list[int]:
    """2-opt: reverse stretches of the order as long as that makes it shorter."""
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


# Poses of a camera path, and distances between them.


_RADIAN_SHARE = 0.5
"""A radian counts as this share of the spread of the captured positions."""


def radian_length(poses: Poses) -> float:
    """Length that one radian counts as; 1 for a capture from one position."""
    offsets = poses.centres - poses.centres.mean(dim=0)
    spread = float(offsets.square().sum(dim=1).mean().sqrt())
    return _RADIAN_SHARE * spread if spread > 1e-9 else 1.0


def angles_between(a: Float[Tensor, "*n 4"], b: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n"]:
    """Radians between orientations."""
    # The arc cosine of the product would be off by 1e-8 where they agree.
    chord = torch.minimum((a - b).norm(dim=-1), (a + b).norm(dim=-1))
    return 4 * torch.asin((chord / 2).clamp(max=1.0))


# Uniform cubic B-splines over poses.


_SAMPLES_PER_SPAN = 32


def poses_along_spline(keys: Poses, *, frames: int, closed: bool, unit: float) -> Poses:
    """Frames at equal steps of pose space along the B-spline over the keys."""
    if len(keys) == 1:
        return keys[torch.zeros(frames, dtype=torch.int64)]
    controls = _controls(keys, closed=closed)
    spans = len(controls) - 3
    dense = _spline(
        controls, torch.linspace(0, spans, spans * _SAMPLES_PER_SPAN + 1, dtype=torch.float64)
    )
    distances = (dense.centres[1:] - dense.centres[:-1]).norm(dim=1)
    angles = unit * angles_between(dense.quaternions[1:], dense.quaternions[:-1])
    length = torch.cat(
        (distances.new_zeros(1), (distances.square() + angles.square()).sqrt().cumsum(dim=0))
    )
    # The last frame of a closed film is one step before its first.
    share = torch.arange(frames, dtype=torch.float64) / max(1, frames if closed else frames - 1)
    targets = share * length[-1]
    high = torch.searchsorted(length, targets).clamp(1, len(length) - 1)
    low = high - 1
    fractions = (targets - length[low]) / (length[high] - length[low]).clamp_min(1e-15)
    return _spline(controls, (low + fractions) / _SAMPLES_PER_SPAN)


def _controls(keys: Poses, *, closed: bool) -> Poses:
    """Control points: keys with the neighbours that the ends need, in consistent signs.

    An open spline has its end keys mirrored outwards, so that it begins and ends at them.
    """
    count = len(keys)
    if closed:
        padded = keys[torch.tensor([count - 1, *range(count), 0, 1])]
        centres, quaternions = padded.centres, padded.quaternions
    else:
        quaternions = _with_consistent_signs(keys.quaternions)
        centres, quaternions = (
            torch.cat((2 * x[:1] - x[1:2], x, 2 * x[-1:] - x[-2:-1]))
            for x in (keys.centres, quaternions)
        )
    return Poses(centres=centres, quaternions=_with_consistent_signs(quaternions))


def _with_consistent_signs(quaternions: Float[Tensor, "n 4"]) -> Float[Tensor, "n 4"]:
    """The same orientations with signs such that neighbouring quaternions agree."""
    flips = (quaternions[1:] * quaternions[:-1]).sum(dim=1) < 0
    signs = torch.where(flips, -1.0, 1.0).double().cumprod(dim=0)
    return torch.cat((quaternions[:1], quaternions[1:] * signs[:, None]))


def _spline(controls: Poses, parameters: Float[Tensor, "m"]) -> Poses:
    """The B-spline at parameters from 0 to the number of controls less 3."""
    first = parameters.floor().long().clamp(0, len(controls) - 4)
    t = (parameters - first)[:, None]
    basis = (
        (1 - t) ** 3 / 6,
        (3 * t**3 - 6 * t**2 + 4) / 6,
        (-3 * t**3 + 3 * t**2 + 3 * t + 1) / 6,
        t**3 / 6,
    )
    centres = sum(b * controls.centres[first + j] for j, b in enumerate(basis))
    blend = sum(b * controls.quaternions[first + j] for j, b in enumerate(basis))
    quaternions = torch.as_tensor(blend)
    return Poses(
        centres=torch.as_tensor(centres),
        quaternions=quaternions / quaternions.norm(dim=1, keepdim=True).clamp_min(1e-12),
    )
