"""Primitives as one triangle mesh: what rays hit, and whose vertices carry features."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core.boundary import convert_fields
from splatseg.errors import RangeError
from splatseg.street.shapes.template import FACES, VERTICES, template


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PrimitiveMesh:
    """Deformed icospheres in the world, level by level.

    Primitive i has the vertices 42 i to 42 i + 41 and the faces 80 i to 80 i + 79, each with the
    corners of its template face.

    Raises:
        ShapeError: If there are not 42 vertices and one level a primitive.
        RangeError: If a vertex is not finite, or a level has no size.
    """

    vertices: Float[Tensor, "v 3"]
    """World, scene units, float32."""

    levels: Int[Tensor, "m"]
    """Level of each primitive, int64; 0 is the finest."""

    sizes: tuple[float, ...]
    """Side of the voxels of each level, scene units, ascending."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_shape("levels", self.levels, (None,))
        check_shape("vertices", self.vertices, (VERTICES * len(self.levels), 3))
        check_finite("vertices", self.vertices)
        if len(self.levels) and not 0 <= int(self.levels.min()) <= int(self.levels.max()) < len(
            self.sizes
        ):
            raise RangeError(
                f"levels: expected levels of {len(self.sizes)} sizes, got "
                f"[{int(self.levels.min())}, {int(self.levels.max())}]."
            )
        if list(self.sizes) != sorted(self.sizes) or not all(size > 0 for size in self.sizes):
            raise RangeError(f"sizes: expected positive lengths, ascending, got {self.sizes}.")
        object.__setattr__(self, "vertices", self.vertices.float())
        object.__setattr__(self, "levels", self.levels.long())

    def __len__(self) -> int:
        """How many primitives there are."""
        return len(self.levels)

    @property
    def faces(self) -> Int[Tensor, "f 3"]:
        """Corners of every triangle, int64."""
        return primitive_faces(len(self.levels))


def primitive_faces(count: int) -> Int[Tensor, "f 3"]:
    """Corners of the triangles of primitives whose vertices follow each other."""
    _, faces = template()
    first = VERTICES * torch.arange(count)
    return (first[:, None, None] + faces).reshape(FACES * count, 3)
