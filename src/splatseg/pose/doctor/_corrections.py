"""Corrections of cameras and points that the doctor tries, one for each usual mistake."""

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import Camera, PointCloud
from splatseg.core.boundary import boundary

Array = NDArray[np.float64]

FLIP = np.diag([1.0, -1.0, -1.0])
"""OpenCV from OpenGL camera axes and back: half a turn about x."""

_SAME_FACTOR = 1e-6


@boundary
def axis_rotations(*, mirrored: bool = False) -> tuple[Array, ...]:
    """The 24 rotations that take axes to axes (or the 24 reflections), the simplest first."""
    found: list[Array] = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if (np.linalg.det(matrix) < 0) == mirrored:
                found.append(matrix)
    identity = np.eye(3)
    return tuple(sorted(found, key=lambda m: float(np.abs(m - identity).sum())))


def is_identity(matrix: Array) -> bool:
    """Whether a 3 x 3 matrix changes nothing."""
    return bool(np.allclose(matrix, np.eye(3)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraCorrection:
    """What is done to all cameras of a capture. The defaults change nothing.

    The pose becomes ``axes @ cam_from_world``, or ``axes @ world_from_cam @ world_axes`` where
    the matrices turn out to be inverted; the intrinsics are exchanged, scaled, centred and
    shifted in this order.
    """

    axes: Array
    """(3, 3) true camera axes from those given."""

    inverted: bool = False
    """World-to-camera matrices stand where camera-to-world ones should, or the other way."""

    world_axes: Array | None = None
    """(3, 3) factor on the right where poses are inverted; None is the identity."""

    swapped: bool = False
    """Width and height were exchanged: fx with fy, cx with cy."""

    centred: bool = False
    """The principal point is the middle of the photograph."""

    scale: float = 1.0
    """Factor of all intrinsics: they belong to an image of another size."""

    focal: float = 1.0
    """Further factor of the focal lengths alone."""

    shift: tuple[float, float] = (0.0, 0.0)
    """Added to the principal point, pixels of the photograph."""

    def intrinsics(self, camera: Camera) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy of the corrected camera."""
        fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
        if self.swapped:
            fx, fy, cx, cy = fy, fx, cy, cx
        if self.centred:
            cx, cy = camera.width / 2 / self.scale, camera.height / 2 / self.scale
        factor = self.scale * self.focal
        return (
            fx * factor,
            fy * factor,
            cx * self.scale + self.shift[0],
            cy * self.scale + self.shift[1],
        )

    def poses(self, poses: Array) -> Array:
        """cam_from_world (n, 4, 4) of the corrected cameras."""
        if not self.inverted:
            return _embedded(self.axes) @ poses
        world = np.eye(3) if self.world_axes is None else self.world_axes
        return _embedded(self.axes) @ np.linalg.inv(poses) @ _embedded(world)

    def apply(self, camera: Camera) -> Camera:
        """One corrected camera."""
        fx, fy, cx, cy = self.intrinsics(camera)
        pose = self.poses(camera.cam_from_world.detach().numpy()[None])[0]
        return replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, cam_from_world=torch.from_numpy(pose))

    @property
    def faults(self) -> int:
        """How many different things it changes; the shift does not count."""
        return (
            int(not is_identity(self.axes))
            + int(self.inverted)
            + int(self.swapped)
            + int(self.centred)
            + int(abs(math.log(self.scale)) > _SAME_FACTOR)
            + int(abs(math.log(self.focal)) > _SAME_FACTOR)
        )


def no_correction() -> CameraCorrection:
    """The correction that changes nothing."""
    return CameraCorrection(axes=np.eye(3))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointCorrection:
    """What is done to the start points: x -> scale * matrix @ x + offset."""

    matrix: Array
    """(3, 3), a rotation or a reflection."""

    scale: float = 1.0
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    source: str | None = None
    """Where it is written down, such as transforms.json's applied_transform."""

    def apply(self, cloud: PointCloud) -> PointCloud:
        """The corrected points."""
        moved = self.array(cloud.points.double().numpy())
        return PointCloud(points=torch.from_numpy(moved).float(), colours=cloud.colours)

    def array(self, points: Array) -> Array:
        """The corrected points of an array (n, 3)."""
        return self.scale * points @ self.matrix.T + np.array(self.offset)

    @property
    def changes_nothing(self) -> bool:
        """Whether it is the identity."""
        return is_identity(self.matrix) and self.scale == 1 and not any(self.offset)


def _embedded(rotation: Array) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    return matrix
