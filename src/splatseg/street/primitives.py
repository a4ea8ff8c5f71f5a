"""Primitives: codes with places in the world, made of voxels that hold points.

Each level is a grid of its own. As published, every voxel that holds a point gets a primitive at
every level, and rays look at the fine ones over the coarse ones.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from splatseg._check import check_choice, check_finite, check_range, check_shape
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.threads import one_torch_thread
from splatseg.errors import InputError, RangeError
from splatseg.lift.point_shapes import thin
from splatseg.street.mesh import PrimitiveMesh
from splatseg.street.shapes import ShapeAutoEncoder, primitive_scale, sphere_code
from splatseg.street.shapes.template import VERTICES

CoarseRule = Literal["everywhere", "sparse"]
"""everywhere: each level covers all points, as published. sparse: a level covers the voxels in
which the next finer one has too few points."""

StartShape = Literal["sphere", "encoded"]
"""sphere: codes of the near sphere, as published. encoded: what the encoder makes of the points
of a voxel."""

_UNIT = 1e-3
_DECODED = 8192
"""Primitives that are decoded together where no gradient is wanted."""

_MAX_INDEX = 1 << 20
_ENCODED_POINTS = 128
_ENCODED = 256
_MIN_ENCODED_POINTS = 8


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

    def mesh(self, shapes: ShapeAutoEncoder) -> PrimitiveMesh:
        """Their vertices in the world, without gradients.

        Raises:
            ShapeError: If codes have not the size of the shapes' codes.
        """
        check_shape("codes", self.codes, (None, shapes.code_size))
        vertices = torch.zeros(len(self), VERTICES, 3)
        with torch.no_grad(), one_torch_thread():
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
    coarse: CoarseRule = "everywhere",
    start: StartShape = "sphere",
    min_points: int = 1,
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
        coarse: Where levels above the finest have primitives.
        start: What the codes are at first. A voxel with fewer than 8 points is a sphere.
        min_points: Points that a voxel needs; with coarse ``sparse`` what fails is left to the
            next level, and the coarsest level takes all.
        sphere: `shapes.sphere_code` of the shapes, where the caller has it already; None searches
            for it, which takes about a second.

    Returns:
        Primitives ordered by level and voxel.

    Raises:
        ShapeError: If points are not (n, 3).
        RangeError: If a point is not finite or too far away to count voxels, or a length is not
            positive.
        InputError: If there are no points, no voxel holds enough of them, or the shapes have no
            encoder that ``encoded`` asks for.

    Example:
        >>> from splatseg.street.shapes import load_shapes
        >>> made = voxel_primitives(torch.tensor([[0.1, 0.1, 0.1], [0.9, 0.1, 0.1]]),
        ...                         shapes=load_shapes())
        >>> made.levels.tolist()
        [0, 0, 1]
    """
    check_shape("points", points, (None, 3))
    check_finite("points", points)
    check_choice("coarse", coarse, ("everywhere", "sparse"))
    check_choice("start", start, ("sphere", "encoded"))
    check_range("min_points", min_points, 1, 1_000_000)
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
    left = torch.ones(len(cloud), dtype=torch.bool)
    found: list[tuple[Tensor, Tensor]] = []
    for level, size in enumerate(units):
        last = level == len(units) - 1
        rows = left.nonzero()[:, 0]
        enough = 1 if last and coarse == "sparse" else min_points
        centres, owners = _voxels(cloud[rows], size, enough)
        if coarse == "sparse":
            left[rows[owners >= 0]] = False
        codes = sphere.expand(len(centres), -1)
        if start == "encoded":
            filled = _Filled(cloud[rows], owners, centres, primitive_scale(size))
            codes = _encoded(shapes, filled, sphere)
        found.append((centres, codes))
    counts = [len(centres) for centres, _ in found]
    if not sum(counts):
        raise InputError(
            f"points: expected voxels with {min_points} points each, got none among "
            f"{len(points)} points."
        )
    repeats = torch.tensor(counts)
    return Primitives(
        codes=torch.cat([codes for _, codes in found]),
        centres=torch.cat([centres for centres, _ in found]),
        scales=torch.tensor([primitive_scale(size) for size in units]).repeat_interleave(repeats),
        levels=torch.arange(len(units)).repeat_interleave(repeats),
        sizes=units,
    )


def _voxels(points: Tensor, size: float, enough: int) -> tuple[Tensor, Tensor]:
    """Means of the points of voxels that hold enough of them, and the voxel of each point or -1."""
    if not len(points):
        return points.new_zeros(0, 3), torch.zeros(0, dtype=torch.int64)
    furthest = float(points.abs().max())
    if furthest / size >= _MAX_INDEX - 1:
        raise RangeError(
            f"points: expected coordinates within {_MAX_INDEX} voxels of the origin, got "
            f"{furthest:g} for voxels of {size:g}."
        )
    cells = thin(points, size)
    kept = torch.bincount(cells.cell_of) >= enough
    index = torch.where(kept, kept.cumsum(0) - 1, -1)
    return cells.centres[kept], index[cells.cell_of]


def _encoded(shapes: ShapeAutoEncoder, voxels: "_Filled", sphere: Tensor) -> Tensor:
    """Codes of the points of voxels, spheres where they are few."""
    codes = sphere.repeat(len(voxels.centres), 1)
    inside = (voxels.owners >= 0).nonzero()[:, 0]
    x, y, z = voxels.points[inside].numpy().T
    order = inside[torch.from_numpy(np.lexsort((z, y, x, voxels.owners[inside].numpy())))]
    counts = torch.bincount(voxels.owners[inside], minlength=len(codes))
    starts = counts.cumsum(0) - counts
    dense = (counts >= _MIN_ENCODED_POINTS).nonzero()[:, 0]
    share = torch.arange(_ENCODED_POINTS)
    with torch.no_grad(), one_torch_thread():
        for part in dense.split(_ENCODED):
            # Evenly over a voxel's points; a repeated point changes no maximum.
            steps = share * counts[part, None] // _ENCODED_POINTS
            rows = order[starts[part, None] + steps]
            local = voxels.points[rows] - voxels.centres[part, None]
            codes[part] = shapes.encode((local / voxels.scale).float())
    return functional.normalize(codes, dim=1)


class _Filled(NamedTuple):
    """Points, the voxel of each or -1, the voxels' centres, and the unit of their shapes."""

    points: Tensor
    owners: Tensor
    centres: Tensor
    scale: float
