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
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg._check import check_shape
from splatseg.core import Camera, View
from splatseg.core.rigid import quaternion_from_rotation, rotation_from_quaternion
from splatseg.errors import InputError, RangeError
from splatseg.render._path_keys import key_poses
from splatseg.render._path_poses import Poses, radian_length
from splatseg.render._path_spline import poses_along_spline

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
