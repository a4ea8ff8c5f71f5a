"""Primitives as one triangle mesh: what rays hit, and whose vertices carry features."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, RangeError
from splatseg.lift.point_shapes import thin
from splatseg.street.shapes import (
    FACES,
    VERTICES,
    ShapeAutoEncoder,
    primitive_scale,
    sphere_code,
    template,
)


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


# Primitives: codes with places in the world, made of voxels that hold points.
#
# Each level is a grid of its own. As published, every voxel that holds a point gets a primitive at
# every level, and rays look at the fine ones over the coarse ones.


_UNIT = 1e-3
_DECODED = 8192
"""Primitives that are decoded together where no gradient is wanted."""

_MAX_INDEX = 1 << 20


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Primitives:
    """Deformable primitives in the world.

    Raises:
        ShapeError: If the arrays are not one row a primitive.
        RangeError: If a value is not finite, a code has not the length 1, a scale is not positive,
            or a level has no size.
    """

    codes: Float[Tensor, "m mu"]
    """Of their shapes, of length 1, float32."""

    centres: Float[Tensor, "m 3"]
    """Where the template's middle is, world, scene units, float32."""

    scales: Float[Tensor, "m"]
    """Length of the unit of the shape, scene units, float32."""

    levels: Int[Tensor, "m"]
    """Level of each, int64; 0 is the finest."""

    sizes: tuple[float, ...]
    """Side of the voxels of each level, scene units, ascending."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_shape("levels", self.levels, (None,))
        count = len(self.levels)
        check_shape("codes", self.codes, (count, None))
        check_shape("centres", self.centres, (count, 3))
        check_shape("scales", self.scales, (count,))
        for name in ("codes", "centres", "scales"):
            check_finite(name, getattr(self, name))
            object.__setattr__(self, name, getattr(self, name).detach().float())
        object.__setattr__(self, "levels", self.levels.long())
        if list(self.sizes) != sorted(self.sizes) or not all(size > 0 for size in self.sizes):
            raise RangeError(f"sizes: expected positive lengths, ascending, got {self.sizes}.")
        if not count:
            return
        lengths = torch.linalg.vector_norm(self.codes, dim=1)
        if float((lengths - 1).abs().max()) > _UNIT:
            worst = lengths[(lengths - 1).abs().argmax()]
            raise RangeError(f"codes: expected codes of length 1, got one of {float(worst):g}.")
        if float(self.scales.min()) <= 0:
            raise RangeError(
                f"scales: expected positive lengths, got one of {float(self.scales.min()):g}."
            )
        if not 0 <= int(self.levels.min()) <= int(self.levels.max()) < len(self.sizes):
            raise RangeError(
                f"levels: expected levels of {len(self.sizes)} sizes, got "
                f"[{int(self.levels.min())}, {int(self.levels.max())}]."
            )

    def __len__(self) -> int:
        """How many there are."""
        return len(self.levels)

    @boundary
    def subset(self, rows: Int[Tensor, "n"] | Bool[Tensor, "m"]) -> "Primitives":
        """Some of them, with the sizes of all levels."""
        return Primitives(
            codes=self.codes[rows],
            centres=self.centres[rows],
            scales=self.scales[rows],
            levels=self.levels[rows],
            sizes=self.sizes,
        )

    @boundary
    def mesh(self, shapes: ShapeAutoEncoder) -> PrimitiveMesh:
        """Their vertices in the world, without gradients.

        Raises:
            ShapeError: If codes have not the size of the shapes' codes.
        """
        check_shape("codes", self.codes, (None, shapes.code_size))
        vertices = torch.zeros(len(self), VERTICES, 3)
        with torch.no_grad():
            for start in range(0, len(self), _DECODED):
                part = slice(start, start + _DECODED)
                vertices[part] = world_vertices(
                    shapes, self.codes[part], self.centres[part], self.scales[part]
                )
        return PrimitiveMesh(vertices=vertices.view(-1, 3), levels=self.levels, sizes=self.sizes)


def world_vertices(
    shapes: ShapeAutoEncoder,
    codes: Float[Tensor, "m mu"],
    centres: Float[Tensor, "m 3"],
    scales: Float[Tensor, "m"],
) -> Float[Tensor, "m 42 3"]:
    r"""Vertices of primitives in the world, :math:`c + s\,G(z)`, differentiable in all three.

    Args:
        shapes: The decoder G.
        codes: z, of any length but 0.
        centres: c, world, scene units.
        scales: s, scene units.
    """
    return centres[:, None] + scales[:, None, None] * shapes.decode(codes)


@boundary
def voxel_primitives(
    points: Float[Tensor, "n 3"],
    *,
    shapes: ShapeAutoEncoder,
    sizes: Sequence[float] = (0.5, 1.0),
    metres_per_unit: float = 1.0,
    sphere: Float[Tensor, "mu"] | None = None,
) -> Primitives:
    """One primitive in each voxel that holds points, level by level; the order of points is free.

    Grids start at the origin of the world, so that blocks of one drive share their voxels. A
    primitive stands at the mean of its points, and its scale is `shapes.primitive_scale`: the
    template goes through the corners of a voxel around it.

    Args:
        points: On surfaces, world, scene units.
        shapes: The auto-encoder of the codes.
        sizes: Sides of the voxels of the levels, metres.
        metres_per_unit: Length of a scene unit.
        sphere: `shapes.sphere_code` of the shapes, where the caller has it already; None searches
            for it, which takes about a second.

    Returns:
        Primitives ordered by level and voxel.

    Raises:
        ShapeError: If points are not (n, 3).
        RangeError: If a point is not finite or too far away to count voxels, or a length is not
            positive.
        InputError: If there are no points.

    Example:
        >>> from splatseg.street.shape_files import load_shapes
        >>> made = voxel_primitives(torch.tensor([[0.1, 0.1, 0.1], [0.9, 0.1, 0.1]]),
        ...                         shapes=load_shapes())
        >>> made.levels.tolist()
        [0, 0, 1]
    """
    check_shape("points", points, (None, 3))
    check_finite("points", points)
    if not len(points):
        raise InputError("points: expected at least one point to put a primitive at, got none.")
    if not 0 < metres_per_unit < math.inf:
        raise RangeError(f"metres_per_unit: expected a positive length, got {metres_per_unit:g}.")
    if not sizes or not all(0 < size < math.inf for size in sizes):
        raise RangeError(f"sizes: expected positive lengths in metres, got {tuple(sizes)}.")
    cloud = points.detach().cpu().double()
    units = tuple(size / metres_per_unit for size in sorted(sizes))
    sphere = (sphere_code(shapes) if sphere is None else sphere).detach().cpu().float()
    check_shape("sphere", sphere, (shapes.code_size,))
    centres = [_voxels(cloud, size) for size in units]
    counts = torch.tensor([len(level) for level in centres])
    return Primitives(
        codes=sphere.repeat(int(counts.sum()), 1),
        centres=torch.cat(centres),
        scales=torch.tensor([primitive_scale(size) for size in units]).repeat_interleave(counts),
        levels=torch.arange(len(units)).repeat_interleave(counts),
        sizes=units,
    )


def _voxels(points: Tensor, size: float) -> Tensor:
    """Means of the points of voxels that hold some."""
    furthest = float(points.abs().max())
    if furthest / size >= _MAX_INDEX - 1:
        raise RangeError(
            f"points: expected coordinates within {_MAX_INDEX} voxels of the origin, got "
            f"{furthest:g} for voxels of {size:g}."
        )
    return thin(points, size).centres
