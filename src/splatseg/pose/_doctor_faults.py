"""What the doctor says of a capture: faults in words, with their thresholds."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg.core import Camera, Capture
from splatseg.core.boundary import boundary
from splatseg.pose._doctor_cameras import (
    FLIP,
    CameraCorrection,
    IntrinsicsEstimate,
    PointCorrection,
    is_identity,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """One thing that is wrong."""

    name: str
    """A short name for programs: ``camera-axes``, ``inverted-poses``, ``scaled-intrinsics``,
    ``focal-length``, ``swapped-intrinsics``, ``principal-point``, ``half-pixel``,
    ``point-frame``, ``pose-frame``, ``up-axis``, ``image-size``, ``unexplained-poses`` or
    ``unexplained-points``."""

    sentence: str
    """What is wrong and how it shows, for people."""

    remedy: str
    """What corrects it; what `Diagnosis.corrected` has done."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Findings:
    """What has been found so far: each part of an examination adds to it; see `Diagnosis`."""

    faults: list[Fault] = field(default_factory=list[Fault])
    doubts: list[str] = field(default_factory=list[str])
    unchecked: list[str] = field(default_factory=list[str])
    figures: dict[str, Any] = field(default_factory=dict[str, Any])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Diagnosis:
    """The result of `diagnose`."""

    capture: Capture
    """As it was given."""

    faults: tuple[Fault, ...]
    """What is wrong, the cameras first. Empty for a healthy capture."""

    doubts: tuple[str, ...]
    """Sentences about what looks odd but is not certain, or not wrong enough to be a fault."""

    unchecked: tuple[str, ...]
    """Sentences about what could not be checked, and why."""

    figures: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """What was measured, in values that JSON holds; see ``docs/doctor.md``."""

    corrected: Capture | None = None
    """The capture with all faults corrected; None where it is healthy or no correction helps."""

    @property
    def healthy(self) -> bool:
        """Whether nothing is wrong as far as it could be checked."""
        return not self.faults


# Which way is up, told by how photographs are held.


Array = NDArray[np.float64]

CERTAIN = 0.4
"""Least length of the mean of the photographs' up directions that says something."""

WRONG = 60.0
"""Degrees between the up axis given and the photographs' from which it is wrong."""

_NAMES = ("+x", "-x", "+y", "-y", "+z", "-z")
_DIRECTIONS = np.array(
    [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float64
)


def photographs_up(cameras: Sequence[Camera]) -> tuple[Array, float]:
    """Mean direction (3,) of the photographs' upper edges in the world, and how sure it is.

    The second value is the length of the mean of the unit vectors: 1 where all photographs
    were held the same way, 0 where they say nothing.
    """
    ups = np.stack([-c.cam_from_world.detach().numpy()[1, :3] for c in cameras])
    mean = ups.mean(axis=0)
    length = float(np.linalg.norm(mean))
    return mean / max(length, 1e-12), length


def degrees_between(first: Array, second: Array) -> float:
    """Angle between two directions."""
    cosine = first @ second / (np.linalg.norm(first) * np.linalg.norm(second))
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def nearest_axis(direction: Array) -> tuple[str, tuple[float, float, float]]:
    """Name and direction of the axis of the world that is closest, such as ``+z``."""
    at = int(np.argmax(_DIRECTIONS @ direction))
    x, y, z = _DIRECTIONS[at].tolist()
    return _NAMES[at], (x, y, z)


def axis_name(direction: Sequence[float]) -> str:
    """A direction in words: the axis it is, or its numbers."""
    at = _DIRECTIONS @ np.array(direction)
    if at.max() > 0.999:
        return _NAMES[int(np.argmax(at))]
    return f"({', '.join(f'{v:.2f}' for v in direction)})"


# From figures to words: which faults a correction stands for, and their thresholds.


HALF_PIXEL = 0.15
"""An estimated shift within this of half a pixel, in both axes, is one of half a pixel."""

HALF_PIXEL_SIGMA = 0.1
"""Greatest standard deviation of an estimate that may be called half a pixel, pixels."""

FAR_OFF = 2.0
"""A principal point off by more than this many pixels (and 0.3 % of the longest side) is a
fault; less is a doubt, because fitted lenses are off by that much."""

FOCAL = 0.02
"""A focal length off by more than this share is a fault."""

SIGMAS = 6.0
"""How many standard deviations an estimate of a fault must be away from nothing."""

_DOUBT_SHIFT, _DOUBT_FOCAL, _DOUBT_SIGMAS = 0.25, 0.004, 4.0
_AXES = "xyz"
_OPENGL_FILES = ("nerfstudio", "blender", "llff")


def camera_faults(correction: CameraCorrection, capture: Capture) -> list[Fault]:
    """The faults that a correction of all cameras stands for."""
    axes = correction.axes
    opengl = capture.format in _OPENGL_FILES
    if correction.inverted and opengl:
        # The inverse of an OpenGL pose needs the half turn again; without it the matrix
        # already had OpenCV axes.
        axes = axes @ FLIP
    kinds = ("world-to-camera", "camera-to-world")
    has, wants = kinds if opengl else reversed(kinds)
    table = (
        (
            correction.inverted,
            "inverted-poses",
            f"The poses are {has} matrices where {wants} ones are expected.",
            "The matrices are inverted.",
        ),
        (
            not is_identity(axes),
            "camera-axes",
            f"The camera axes are mixed up: {_axes(axes)}.",
            "The camera axes of all poses are exchanged.",
        ),
        (
            correction.swapped,
            "swapped-intrinsics",
            "fx and fy, cx and cy are exchanged: the intrinsics belong to the photographs turned "
            "by a quarter.",
            "fx is exchanged with fy, and cx with cy.",
        ),
        (
            correction.scale != 1,
            "scaled-intrinsics",
            f"The intrinsics belong to images {1 / correction.scale:g} times the size of the "
            "photographs.",
            f"fx, fy, cx and cy are multiplied by {correction.scale:g}.",
        ),
        (
            abs(correction.focal - 1) > 1e-9,
            "focal-length",
            f"The focal length is {1 / correction.focal:.4g} times what the photographs show.",
            f"fx and fy are multiplied by {correction.focal:.5g}.",
        ),
        (
            correction.centred,
            "principal-point",
            "The principal point is far from the middle of the photographs, and the middle fits "
            "them.",
            "cx and cy become the middle of the photographs.",
        ),
    )
    return [
        Fault(name=name, sentence=sentence, remedy=remedy)
        for applies, name, sentence, remedy in table
        if applies
    ]


def shift_fault(
    estimate: IntrinsicsEstimate, longest: float
) -> tuple[Fault, tuple[float, float]] | None:
    """A fault of the principal point, and what to add to it; None where there is none."""
    shift, sigma = np.array(estimate.shift), np.array(estimate.shift_sigma)
    near_half = np.abs(np.abs(shift) - 0.5) < HALF_PIXEL
    if near_half.all() and (sigma < HALF_PIXEL_SIGMA).all():
        dx, dy = (math.copysign(0.5, float(v)) for v in shift)
        fault = Fault(
            name="half-pixel",
            sentence="The principal point is off by half a pixel "
            f"({_vector(-shift)} +- {_vector(sigma)} px): it counts pixel centres from another "
            "origin.",
            remedy=f"{dx:+g} is added to cx and {dy:+g} to cy.",
        )
        return fault, (dx, dy)
    length = float(np.linalg.norm(shift))
    certain = length > SIGMAS * float(np.linalg.norm(sigma))
    if certain and length > max(FAR_OFF, 0.003 * longest):
        fault = Fault(
            name="principal-point",
            sentence=f"The principal point is off by {_vector(-shift)} +- {_vector(sigma)} px.",
            remedy=f"{shift[0]:+.2f} is added to cx and {shift[1]:+.2f} to cy.",
        )
        return fault, (float(shift[0]), float(shift[1]))
    return None


def focal_is_off(estimate: IntrinsicsEstimate) -> bool:
    """Whether an estimated factor of the focal length is a fault."""
    off = abs(math.log(estimate.focal))
    return off > FOCAL and off > SIGMAS * estimate.focal_sigma


def intrinsics_doubts(estimate: IntrinsicsEstimate, *, judged: bool) -> list[str]:
    """Sentences about small errors of the intrinsics; `judged` says the shift is a fault."""
    found: list[str] = []
    shift, sigma = np.array(estimate.shift), np.array(estimate.shift_sigma)
    off = (np.abs(shift) > _DOUBT_SHIFT) & (np.abs(shift) > _DOUBT_SIGMAS * sigma)
    if off.any() and not judged:
        found.append(f"the principal point may be off by {_vector(-shift)} +- {_vector(sigma)} px")
    share = abs(math.log(estimate.focal))
    if FOCAL >= share > max(_DOUBT_FOCAL, _DOUBT_SIGMAS * estimate.focal_sigma):
        found.append(
            f"the focal length may be off by {100 * (1 / estimate.focal - 1):+.2f} % "
            f"+- {100 * estimate.focal_sigma:.2f} %"
        )
    return found


def point_fault(correction: PointCorrection, front: float) -> Fault:
    """The fault that a correction of the start points stands for."""
    what = describe_move(correction)
    if correction.source is not None:
        what = f"{correction.source} ({what})"
    return Fault(
        name="point-frame",
        sentence="The start points are in another frame than the cameras: "
        f"{100 * front:.0f} % of them lie in view of two photographs or more, and what is "
        f"there does not fit; {what} brings them together.",
        remedy=f"The start points are moved: {what}.",
    )


@boundary
def describe_move(correction: PointCorrection) -> str:
    """A correction of points in words, such as ``(x, y, z) -> (x, -z, y), times 0.001``."""
    parts: list[str] = []
    rounded = np.rint(correction.matrix)
    if np.abs(rounded - correction.matrix).max() < 0.02:
        if not is_identity(rounded):
            parts.append(f"(x, y, z) -> ({', '.join(_row(row) for row in rounded)})")
    else:
        parts.append("a rotation")
    if abs(correction.scale - 1) > 1e-9:
        parts.append(f"times {correction.scale:.5g}")
    if any(correction.offset):
        parts.append(f"plus {_vector(np.array(correction.offset))}")
    return ", ".join(parts) or "nothing"


def _axes(axes: NDArray[np.float64]) -> str:
    if np.allclose(axes, FLIP):
        return (
            "the poses have y and z the other way round (OpenGL for OpenCV, or OpenCV for OpenGL)"
        )
    return f"right, down and forward are ({', '.join(_row(row) for row in axes)})"


def _row(row: NDArray[np.float64]) -> str:
    at = int(np.argmax(np.abs(row)))
    return ("-" if row[at] < 0 else "") + _AXES[at]


def _vector(values: NDArray[np.float64]) -> str:
    return f"({', '.join(f'{v:.2f}' for v in values)})"
