r"""The closed surface of an object from depth and label maps.

Truncated signed distances are averaged over views (Curless and Levoy, A Volumetric Method for
Building Complex Models from Range Images, 1996). At a voxel x with the z-depth z_v(x) in view v,
whose pixel there has the depth D_v,

.. math:: d_v(x) = \min\left(1, \frac{D_v - z_v(x)}{\tau}\right), \qquad
          F(x) = \frac{\sum_v w_v(x) d_v(x)}{\sum_v w_v(x)}

is positive outside and 0 on the surface. Labels say whose surface a pixel sees:

    the object's, to tau behind it   w = 1, d as above
    another's, in front of it        w = 1, d = 1: free space
    another's, just behind it        w = 1, d = 1: the inside of another thing
    the object's, further behind     w = epsilon, d = -1: perhaps inside
    another's, further behind        w = epsilon, d = 1: perhaps outside

The last two decide only where no view sees the voxel: there F is a vote of silhouettes, which
closes the surface under a thing that stands on a table. F is 1 where no view looks; beyond the box
of the object also where none looks as far as a voxel behind its surface.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core.boundary import boundary
from splatseg.errors import InputError, import_package
from splatseg.io.export import TriangleMesh
from splatseg.mesh.maps import ViewMaps

_TRUNCATION = 6.0
"""tau in voxels."""

_PADDING = 0.06
"""What the grid has around the box on each side, share of its longest side: strays that the box's
quantiles leave out are often thin parts."""

_UNSEEN = 0.02
"""epsilon: fifty views that do not see a voxel count as one that does."""

_BEHIND = 1.0
"""How far behind a surface a voxel is seen, in voxels: it is inside of what has the surface."""

_SMOOTHING = 0.7
"""Standard deviation of the Gaussian that smooths F, in voxels: cubes at the border between two
unseen voxels become slopes."""

_MIN_COMPONENT = 0.03
"""Smallest share that a connected piece has of the voxels of the largest; others are dropped."""

_MIN_RESOLUTION = 16
"""Voxels that the longest side has at least, however small the object is in the views."""

_MIN_THICKNESS = 4
"""Voxels that every side of a box has at least: of a sheet, half of them behind its surface."""

_SLAB = 1 << 18
"""Voxels that are looked at together: about 20 MB."""

_NEAR = 1e-6

Array = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Grid:
    """Voxels about an object."""

    origin: Float[Tensor, "3"]
    """Centre of the first voxel, world."""

    axes: Float[Tensor, "3 3"]
    """world_from_grid: its columns are the grid's axes in the world, right-handed."""

    shape: tuple[int, int, int]
    """Voxels along each axis."""

    voxel: float
    """Side of a voxel, scene units."""

    inner: tuple[slice, slice, slice]
    """The voxels of the box, without what is around it."""

    @classmethod
    def about(
        cls,
        centre: Float[Tensor, "3"],
        size: Float[Tensor, "3"],
        rotation: Float[Tensor, "3 3"],
        *,
        resolution: int,
        min_voxel: float = 0.0,
    ) -> "Grid":
        """The grid of an oriented box.

        Args:
            centre: Of the box, world.
            size: Full lengths along its own axes, scene units.
            rotation: world_from_box.
            resolution: Voxels along the longest side, at least 1.
            min_voxel: Smallest side of a voxel, scene units; the resolution is less where the
                voxels would be smaller, but at least 16.

        Raises:
            InputError: If the box has no extent.
        """
        lengths = size.double().cpu().numpy()
        if not lengths.max() > 0:
            raise InputError("size: expected a box with an extent, got a point.")
        longest = float(lengths.max())
        if min_voxel > 0:
            resolution = min(resolution, max(_MIN_RESOLUTION, int(longest / min_voxel)))
        voxel = longest / resolution
        around = int(np.ceil(_PADDING * resolution)) + 1
        inside = np.maximum(np.ceil(lengths / voxel).astype(int), _MIN_THICKNESS)
        shape = inside + 2 * around
        turned = rotation.double().cpu()
        corner = torch.from_numpy((1 - shape) / 2 * voxel)
        one, two, three = (slice(around, around + int(n)) for n in inside)
        return cls(
            origin=centre.double().cpu() + turned @ corner,
            axes=turned,
            shape=(int(shape[0]), int(shape[1]), int(shape[2])),
            voxel=voxel,
            inner=(one, two, three),
        )

    @property
    def truncation(self) -> float:
        """tau, scene units."""
        return _TRUNCATION * self.voxel

    def to_world(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """World points of positions counted in voxels, (n, 3)."""
        return points * self.voxel @ self.axes.numpy().T + self.origin.numpy()


@boundary
def fuse_object(maps: Sequence[ViewMaps], id: int, grid: Grid) -> TriangleMesh | None:
    """The closed surface of an object, see the module.

    Args:
        maps: Views that show it; their memory is read one view after another.
        id: The object's id in the maps.
        grid: The voxels.

    Returns:
        A watertight surface of one or more pieces; None where no voxel is inside.
    """
    distances = signed_distances(maps, id, grid)
    inside = _pieces(distances < 0)
    if not inside.any():
        return None
    # What is no piece is outside, what is enclosed is inside; other values stay what they are.
    least = np.float32(1e-3)
    distances = np.where(inside, np.minimum(distances, -least), np.maximum(distances, least))
    return _isosurface(distances, grid)


@boundary
def pixel_size(maps: Sequence[ViewMaps], id: int) -> float:
    """How much of an object a pixel covers: the median over views, scene units; 0 without any.

    Of each view it is the median depth of the object's pixels over the focal length.
    """
    sizes: list[float] = []
    for one in maps:
        depth = one.depth[(one.ids == id) & (one.depth > 0)]
        if len(depth):
            sizes.append(float(depth.median()) / max(one.camera.fx, one.camera.fy))
    return float(np.median(sizes)) if sizes else 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Sums:
    """What views said of voxels so far."""

    total: Array
    """Sum of w d."""

    weight: Array
    """Sum of w."""

    direct: NDArray[np.bool_]
    """Whether a view looks there, as far as a voxel behind a surface."""


def signed_distances(maps: Sequence[ViewMaps], id: int, grid: Grid) -> Array:
    """F at each voxel, smoothed."""
    from scipy import ndimage

    sums = _Sums(
        total=np.zeros(grid.shape, np.float32),
        weight=np.zeros(grid.shape, np.float32),
        direct=np.zeros(grid.shape, np.bool_),
    )
    slab = max(1, _SLAB // (grid.shape[1] * grid.shape[2]))
    for one in maps:
        own = one.ids.numpy() == id
        for start in range(0, grid.shape[0], slab):
            _add(sums, one, own, grid, slice(start, min(start + slab, grid.shape[0])))
    distances = np.divide(
        sums.total, sums.weight, out=np.ones_like(sums.total), where=sums.weight > 0
    )
    # What lies behind a surface says nothing of what is beyond the box: the table below it. A
    # voxel's worth of distance puts the surface onto the box.
    direct = sums.direct
    direct[grid.inner] = True
    distances = np.where(direct, distances, np.maximum(distances, np.float32(1 / _TRUNCATION)))
    smooth = ndimage.gaussian_filter(distances, _SMOOTHING, mode="constant", cval=1.0)
    return cast(Array, smooth)


def _add(sums: _Sums, maps: ViewMaps, own: NDArray[np.bool_], grid: Grid, rows: slice) -> None:
    """Add what one view says of some planes of the grid."""
    column, row, z, seen = _projected(maps, grid, rows)
    depth = maps.depth.numpy()
    pixel = row * depth.shape[1] + column
    surface, mine = depth.reshape(-1)[pixel], own.reshape(-1)[pixel]
    # Nothing is seen in a pixel without a depth: all of its ray is free, unless it shows the
    # object, which then is too transparent to say where it is.
    surface = np.where(surface > 0, surface, np.where(mine, np.nan, np.inf))
    ahead = ((surface - z) / grid.voxel).astype(np.float32)
    with np.errstate(invalid="ignore"):
        near = ahead > np.where(mine, np.float32(-_TRUNCATION), np.float32(-_BEHIND))
        value = np.where(mine, np.minimum(ahead / _TRUNCATION, 1), np.float32(1))
    value = np.where(near, value, np.where(mine, np.float32(-1), np.float32(1)))
    seen &= ~np.isnan(ahead)
    share = np.where(seen, np.where(near, np.float32(1), np.float32(_UNSEEN)), np.float32(0))
    sums.total[rows] += np.where(seen, value * share, 0)
    sums.weight[rows] += share
    sums.direct[rows] |= seen & (ahead > -_BEHIND)


def _projected(
    maps: ViewMaps, grid: Grid, rows: slice
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array, NDArray[np.bool_]]:
    """Pixel column and row, z-depth, and whether the image has it, of some planes of the grid.

    ``K (R x + t)`` is affine in the three indices of a voxel: a sum of three vectors, one an axis.
    """
    camera = maps.camera
    pose = camera.cam_from_world.double().cpu()
    steps = camera.K @ pose[:3, :3] @ grid.axes * grid.voxel
    start = camera.K @ (pose[:3, :3] @ grid.origin + pose[:3, 3])
    along = [np.arange(n, dtype=np.float64) for n in grid.shape]
    along[0] = along[0][rows]
    x, y, z = (
        (
            (float(start[i]) + float(steps[i, 0]) * along[0])[:, None, None]
            + (float(steps[i, 1]) * along[1])[:, None]
            + float(steps[i, 2]) * along[2]
        ).astype(np.float32)
        for i in range(3)
    )
    ahead = z > _NEAR
    safe = np.where(ahead, z, 1)
    u, v = x / safe, y / safe
    seen = ahead & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    column, row = (np.where(seen, value, 0).astype(np.int64) for value in (u, v))
    return column, row, z, seen


def _pieces(inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Large pieces, without the hollows that nobody sees into."""
    from scipy import ndimage

    pieces, _ = cast("tuple[NDArray[np.int32], int]", ndimage.label(inside))
    counts = np.bincount(pieces.ravel())
    counts[0] = 0
    large = counts >= _MIN_COMPONENT * max(1, counts.max())
    return cast(NDArray[np.bool_], ndimage.binary_fill_holes(large[pieces]))


def _isosurface(distances: Array, grid: Grid) -> TriangleMesh:
    """Marching cubes at 0, with one more layer of voxels that are outside."""
    measure: Any = import_package("skimage.measure", "a surface", "mesh")
    padded = np.pad(distances, 1, constant_values=1.0)
    # The inside is below 0: skimage calls that ascending, seen along the triangles' normals.
    vertices, faces, _, _ = measure.marching_cubes(padded, 0.0, gradient_direction="descent")
    return TriangleMesh(
        vertices=torch.from_numpy(grid.to_world(vertices.astype(np.float64) - 1)),
        faces=torch.from_numpy(faces.astype(np.int64)),
    )
