"""Labelled surfaces: triangles or points of the world with ids, such as the scans of data sets."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core.boundary import convert_fields
from splatseg.core.evidence import UNLABELLED
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
        check_shape("faces", self.faces, (None, 3))
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
            check_shape("normals", self.normals, (len(self.points), 3))
            object.__setattr__(self, "normals", _positions("normals", self.normals))

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        return f"LabelledPoints({len(self):,} points, labels: {_names(self.labels)})"


def _positions(name: str, values: Tensor) -> Tensor:
    check_shape(name, values, (None, 3))
    check_finite(name, values)
    return values.detach().cpu().double()


def checked_labels(name: str, given: Mapping[str, Tensor], rows: int) -> dict[str, Tensor]:
    """Ids of rows, by the name of what they tell: int32, one a row, none below -1."""
    return dict(_checked(name, given, rows))


def _checked(name: str, given: Mapping[str, Tensor], rows: int) -> Iterator[tuple[str, Tensor]]:
    for key, ids in given.items():
        check_shape(f"{name}[{key!r}]", ids, (rows,))
        low, high = (int(ids.min()), int(ids.max())) if rows else (0, 0)
        if low < UNLABELLED or high > torch.iinfo(torch.int32).max:
            raise RangeError(
                f"{name}[{key!r}]: expected ids from -1 to 2147483647, got [{low}, {high}]."
            )
        yield str(key), ids.cpu().to(torch.int32)


def _names(labels: Mapping[str, Tensor]) -> str:
    return ", ".join(labels) or "none"
