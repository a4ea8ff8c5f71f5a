"""Points and surfaces with labels: laser scans, labelled meshes, and boxes of what moved."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.camera import Camera
from splatseg.core.evidence import UNLABELLED
from splatseg.core.options import NonNegative, Positive
from splatseg.core.rigid import normalised, rotation_from_quaternion
from splatseg.errors import InputError, RangeError


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LabelledMesh:
    """Triangles whose corners or faces have ids. Which side of a face is seen does not matter.

    Raises:
        ShapeError: If there is not one label a vertex, or a face.
        RangeError: If a vertex is NaN or infinite, a face has corners that are no vertices, or an
            id is below -1.
        InputError: If there is no face, or a name of labels stands twice.
    """

    vertices: Float[Tensor, "n 3"]
    """In the world, scene units, float64."""

    faces: Int[Tensor, "m 3"]
    """Vertices of the corners, int64; at least one face."""

    vertex_labels: Mapping[str, Int[Tensor, "n"]] = field(default_factory=dict[str, Tensor])
    """int32 ids of vertices by the name of what they tell (``label``), -1 void."""

    face_labels: Mapping[str, Int[Tensor, "m"]] = field(default_factory=dict[str, Tensor])
    """int32 ids of faces alike, under other names."""

    def __post_init__(self) -> None:
        convert_fields(self)
        object.__setattr__(self, "vertices", _positions("vertices", self.vertices))
        if not len(self.faces):
            raise InputError("faces: expected at least one triangle, got none.")
        faces = self.faces.cpu().long()
        count = len(self.vertices)
        low, high = int(faces.min()), int(faces.max())
        if low < 0 or high >= count:
            raise RangeError(
                f"faces: expected indices of {count} vertices, in [0, {count}), got "
                f"[{low}, {high}]."
            )
        object.__setattr__(self, "faces", faces)
        for name, rows in (("vertex_labels", count), ("face_labels", len(faces))):
            object.__setattr__(self, name, checked_labels(name, getattr(self, name), rows))
        twice = sorted(set(self.vertex_labels) & set(self.face_labels))
        if twice:
            raise InputError(
                f"face_labels: expected names that vertex_labels has not, got {twice[0]!r}."
            )

    def __repr__(self) -> str:
        return (
            f"LabelledMesh({len(self.vertices):,} vertices, {len(self.faces):,} faces, "
            f"labels: {_names(self.labels)})"
        )

    @property
    def labels(self) -> Mapping[str, Int[Tensor, "rows"]]:
        """Labels of vertices and of faces together, by their names."""
        return {**self.vertex_labels, **self.face_labels}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LabelledPoints:
    """Points of surfaces with ids, such as a labelled scan.

    Raises:
        ShapeError: If there is not one label or normal a point.
        RangeError: If a point is NaN or infinite, or an id is below -1.
        InputError: If there is no point.
    """

    points: Float[Tensor, "n 3"]
    """In the world, scene units, float64; at least one."""

    labels: Mapping[str, Int[Tensor, "n"]]
    """int32 ids by the name of what they tell (``semantic``), -1 void."""

    normals: Float[Tensor, "n 3"] | None = None
    """Directions in which the surface faces, of any length and either sign; a zero is none."""

    def __post_init__(self) -> None:
        convert_fields(self)
        object.__setattr__(self, "points", _positions("points", self.points))
        if not len(self.points):
            raise InputError("points: expected at least one point, got none.")
        object.__setattr__(self, "labels", checked_labels("labels", self.labels, len(self.points)))
        if self.normals is not None:
            object.__setattr__(self, "normals", _positions("normals", self.normals))

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        return f"LabelledPoints({len(self):,} points, labels: {_names(self.labels)})"


def _positions(name: str, values: Tensor) -> Tensor:
    check_finite(name, values)
    return values.detach().cpu().double()


def checked_labels(name: str, given: Mapping[str, Tensor], rows: int) -> dict[str, Tensor]:
    """Ids of rows, by the name of what they tell: int32, one a row, none below -1."""
    checked: dict[str, Tensor] = {}
    for key, ids in given.items():
        check_shape(f"{name}[{key!r}]", ids, (rows,))
        low, high = (int(ids.min()), int(ids.max())) if rows else (0, 0)
        if low < UNLABELLED or high > torch.iinfo(torch.int32).max:
            raise RangeError(
                f"{name}[{key!r}]: expected ids from -1 to 2147483647, got [{low}, {high}]."
            )
        checked[str(key)] = ids.cpu().to(torch.int32)
    return checked


def _names(labels: Mapping[str, Tensor]) -> str:
    return ", ".join(labels) or "none"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scan:
    """One scan, or several that were put together; it may have no point.

    Raises:
        ShapeError: If there is not one intensity or label a point.
        RangeError: If a position is NaN or infinite, or an id is below -1.
    """

    name: str
    """Of the scan in its data set, such as ``0000000005``."""

    points: Float[Tensor, "n 3"]
    """In the world, scene units, float64. Rays without a return are not there."""

    rows: Int[Tensor, "n"] | None = None
    """Which value of the file each point is, int64, ascending, so that labels can be written in
    the file's own order; None where all are there."""

    recorded: int | None = None
    """How many values the file has, with those without a return; None where all are points."""

    origin: Float[Tensor, "3"] | None = None
    """Where the sensor stood, world, float64; None where points of several places are together."""

    intensity: Float[Tensor, "n"] | None = None
    """Share of the light that came back, float32, as the file has it: of no common unit."""

    labels: Mapping[str, Int[Tensor, "n"]] = field(default_factory=dict[str, Tensor])
    """int32 ids by the name of what they tell (``semantic``, ``instance``), -1 void."""

    time: float | None = None
    """When it was measured, on the clock of the data set."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_finite("points", self.points)
        count = len(self.points)
        object.__setattr__(self, "points", self.points.detach().cpu().double())
        if self.origin is not None:
            check_finite("origin", self.origin)
            object.__setattr__(self, "origin", self.origin.detach().cpu().double())
        if self.intensity is not None:
            object.__setattr__(self, "intensity", self.intensity.detach().cpu().float())
        if self.rows is not None:
            object.__setattr__(self, "rows", self.rows.detach().cpu().long())
        object.__setattr__(self, "labels", checked_labels("labels", self.labels, count))

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        return (
            f"Scan({self.name!r}, {len(self):,} points, labels: {', '.join(self.labels) or 'none'})"
        )

    def take(self, rows: Int[Tensor, "m"]) -> "Scan":
        """The scan of some of its points; `rows` of it tells which values of the file they are.

        Args:
            rows: Which points, ascending.
        """
        return replace(
            self,
            points=self.points[rows],
            rows=rows if self.rows is None else self.rows[rows],
            recorded=len(self) if self.recorded is None else self.recorded,
            intensity=None if self.intensity is None else self.intensity[rows],
            labels={name: ids[rows] for name, ids in self.labels.items()},
        )

    def recorded_labels(self, ids: Int[Tensor, "n"], missing: int = -1) -> Int[Tensor, "recorded"]:
        """Ids in the order of the file's values, `missing` where there is no point.

        Raises:
            ShapeError: If there is not one id a point.
        """
        check_shape("ids", ids, (len(self),))
        if self.rows is None:
            return ids.cpu().int()
        count = self.recorded if self.recorded is not None else int(self.rows.max()) + 1
        out = torch.full((count,), missing, dtype=torch.int32)
        out[self.rows] = ids.cpu().int()
        return out


@runtime_checkable
class ScanSource(Protocol):
    """Scans by name, read when asked for: nothing holds a whole drive."""

    @property
    def scan_names(self) -> Sequence[str]:
        """Scans in the order in which they were measured."""
        ...

    def scan(self, name: str) -> Scan:
        """One of them.

        Raises:
            InputError: If there is none of that name, or its file is broken.
        """
        ...


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

    size: tuple[Positive, Positive, Positive]
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
        check_finite("centre", self.centre)
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
    points: Float[Tensor, "p 3"], boxes: Sequence[MovingBox], *, margin: NonNegative = 0.0
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
    at = points.detach().cpu().double()
    inside = torch.zeros(len(at), dtype=torch.bool)
    for box in boxes:
        local = (at - box.centre) @ rotation_from_quaternion(box.rotation)
        inside |= (local.abs() <= _half(box, margin)).all(dim=1)
    return inside


@boundary
def pixels_of_boxes(
    camera: Camera, boxes: Sequence[MovingBox], *, margin: NonNegative = 0.0
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
