r"""Colours of a surface: a texture, baked from the views that see each texel.

A view sees a point of an object where the point is within a tolerance of the view's depth, the
pixel shows the object, and the surface looks towards the camera. The colour is the mean over those
views, each weighted by the cosine between the surface's normal and the direction to the camera.
Vertices that no view sees have the colour of the nearest one that is seen, and texels that none
sees have the mean of their triangle's.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, UInt8
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_shape
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, import_package
from splatseg.io.export import TriangleMesh
from splatseg.mesh.maps import ViewMaps
from splatseg.neighbours import NeighbourIndex

_MIN_COSINE = 0.1
"""Views along the surface do not count: a pixel of theirs covers too much of it."""

_CHUNK = 1 << 18
"""Points that are looked at together."""

_MAX_OVERHANG = 1e-9
"""How far outside a triangle the centre of a texel may lie, as a barycentric weight."""

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenColours:
    """Colours of points of a surface."""

    colours: UInt8[Tensor, "n 3"]
    """sRGB; of the nearest point that is seen where none sees a point itself."""

    seen: Bool[Tensor, "n"]
    """Whether a view sees the point."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Texture:
    """A surface cut into charts, and an image of its colours."""

    source: Int64[Tensor, "n"]
    """The surface's vertex that each vertex of the charts is: one a chart where charts meet."""

    faces: Int64[Tensor, "m 3"]
    """The triangles, in the order of the surface's, by vertices of the charts."""

    uv: Float[Tensor, "n 2"]
    """Position in the image, 0 to 1: u right, v up from the lower edge."""

    image: UInt8[Tensor, "height width 3"]
    """sRGB, the upper row first."""

    seen: float
    """Share of the texels on the surface that a view sees."""


@boundary
def bake_texture(
    surface: TriangleMesh, maps: Sequence[ViewMaps], id: int, *, tolerance: float, texel: float
) -> Texture:
    """Unwrap a surface and take the colour of each texel from the views.

    Charts are those of `unwrap`. Texels beside charts continue them, so that interpolation at a
    seam finds no background.

    Args:
        surface: The surface.
        maps: Views that show it.
        id: The object's id in the maps.
        tolerance: Largest difference between a point's z-depth and the view's, scene units.
        texel: Side of a texel on the surface, scene units; larger where the image would have
            more than 4 million.

    Raises:
        InputError: If the surface has no triangle, or the texel is not above 0.
        MissingPackageError: If xatlas is not installed.
    """
    atlas = unwrap(surface, texel)
    shape = (atlas.height, atlas.width)
    rows, columns, face, weights = _texels(atlas.texels[atlas.faces], shape)
    corners = surface.faces.numpy()[face]
    points = np.einsum("nk,nkj->nj", weights, surface.vertices.numpy()[corners])
    of_vertices = vertex_normals(surface)
    normals = np.einsum("nk,nkj->nj", weights, of_vertices.numpy()[corners])
    colours, seen = _mean_colours(points, normals, maps, id, tolerance)
    there = seen_colours(surface.vertices, of_vertices, maps, id, tolerance=tolerance)
    around = there.colours.numpy()[corners[~seen]]
    colours[~seen] = np.einsum("nk,nkj->nj", weights[~seen], around)
    image = np.zeros((*shape, 3), np.uint8)
    covered = np.zeros(shape, np.bool_)
    image[rows, columns] = np.rint(colours).clip(0, 255).astype(np.uint8)
    covered[rows, columns] = True
    return Texture(
        source=torch.from_numpy(atlas.source),
        faces=torch.from_numpy(atlas.faces),
        uv=torch.from_numpy(np.array([0, 1]) + atlas.texels * [1 / shape[1], -1 / shape[0]]),
        image=torch.from_numpy(_dilated(image, covered)),
        seen=float(seen.mean()) if len(face) else 0.0,
    )


@boundary
def seen_colours(
    points: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    maps: Sequence[ViewMaps],
    id: int,
    *,
    tolerance: float,
) -> SeenColours:
    """The colours that views see at points of an object, see the module.

    Args:
        points: World.
        normals: Outwards, of any length above 0.
        maps: Views that show the object.
        id: Its id in the maps.
        tolerance: Largest difference between a point's z-depth and the view's, scene units.
    """
    check_shape("normals", normals, tuple(points.shape))
    xyz = points.double().cpu().numpy()
    mean, seen = _mean_colours(xyz, normals.double().cpu().numpy(), maps, id, tolerance)
    colours = np.rint(mean).clip(0, 255).astype(np.uint8)
    if seen.any() and not seen.all():
        index = NeighbourIndex(torch.from_numpy(xyz[seen]))
        nearest = index.nearest(torch.from_numpy(xyz[~seen]), 1).indices[:, 0]
        colours[~seen] = colours[seen][nearest.numpy()]
    return SeenColours(colours=torch.from_numpy(colours), seen=torch.from_numpy(seen))


def _mean_colours(
    points: Array, normals: Array, maps: Sequence[ViewMaps], id: int, tolerance: float
) -> tuple[Array, NDArray[np.bool_]]:
    """The mean of the views that see each point, 0 without any, and whether one does."""
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    towards = normals / np.where(length > 0, length, 1)
    total, weight = np.zeros((len(points), 3)), np.zeros(len(points))
    for one in maps:
        own, colour = one.ids.numpy() == id, one.colour.numpy()
        for start in range(0, len(points), _CHUNK):
            rows = slice(start, start + _CHUNK)
            cosine, pixels = _visible(one, own, points[rows], towards[rows], tolerance=tolerance)
            hit = np.flatnonzero(cosine)
            total[start + hit] += cosine[hit, None] * _bilinear(colour, own, pixels[hit])
            weight[rows] += cosine
    seen = weight > 0
    return total / np.where(seen, weight, 1)[:, None], seen


def _visible(
    maps: ViewMaps, own: NDArray[np.bool_], points: Array, normals: Array, *, tolerance: float
) -> tuple[Array, Array]:
    """The cosine towards the camera of each point, 0 where it is not seen; and its pixel (u, v)."""
    depth = maps.depth.numpy()
    camera = maps.camera
    pixels, z = (found.numpy() for found in camera.project(torch.from_numpy(points)))
    size = np.array([camera.width, camera.height])
    inside = (z > 0) & (pixels >= 0).all(axis=1) & (pixels < size).all(axis=1)
    column, row = np.where(inside, pixels.T, 0).astype(np.int64)
    inside &= own[row, column] & (np.abs(depth[row, column] - z) <= tolerance)
    to_camera = camera.centre.numpy() - points
    cosine = (to_camera * normals).sum(axis=1) / np.linalg.norm(to_camera, axis=1).clip(1e-12)
    return np.where(inside & (cosine >= _MIN_COSINE), cosine, 0.0), pixels


def _bilinear(image: NDArray[np.uint8], own: NDArray[np.bool_], pixels: Array) -> Array:
    """Colours between the centres of pixels, of those alone that show the object.

    The pixel that a point falls into has a weight of at least a quarter, and shows it.
    """
    height, width = own.shape
    at = np.clip(pixels - 0.5, 0, [width - 1, height - 1])
    low = np.floor(at).astype(np.int64)
    right, down = (at - low).T
    total, weight = np.zeros((len(pixels), 3)), np.zeros(len(pixels))
    for step, share in (
        ((0, 0), (1 - right) * (1 - down)),
        ((1, 0), right * (1 - down)),
        ((0, 1), (1 - right) * down),
        ((1, 1), right * down),
    ):
        column, row = np.minimum(low + step, [width - 1, height - 1]).T
        share = share * own[row, column]
        total += share[:, None] * image[row, column]
        weight += share
    return total / weight[:, None]


@boundary
def vertex_normals(surface: TriangleMesh) -> Float[Tensor, "n 3"]:
    """Normals of vertices: the sum of those of their triangles, weighted by area; of length 1."""
    a, b, c = surface.vertices[surface.faces].unbind(1)
    of_faces = torch.linalg.cross(b - a, c - a)
    sums = torch.zeros_like(surface.vertices)
    for corner in range(3):
        sums.index_add_(0, surface.faces[:, corner], of_faces)
    length = torch.linalg.vector_norm(sums, dim=1, keepdim=True)
    return sums / torch.where(length > 0, length, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Atlas:
    """A surface cut into charts that lie beside each other in an image."""

    source: NDArray[np.int64]
    """The surface's vertex of each vertex of the charts, (n,)."""

    faces: NDArray[np.int64]
    """The surface's triangles by vertices of the charts, (m, 3)."""

    texels: Array
    """Position of each vertex in the image, (n, 2): right and down from the upper left corner."""

    width: int
    height: int


def unwrap(surface: TriangleMesh, texel: float) -> Atlas:
    """Cut a surface into charts, and pack them.

    A chart is a connected piece whose normals, averaged with those around, are nearest to the same
    one of the six directions of the axes; it is seen from that direction. Of surfaces of Gaussians,
    which are rough, xatlas's own charts take 40 s of 90 000 triangles, and these one; they are
    packed by xatlas.

    Args:
        surface: The surface.
        texel: Side of a texel, scene units; larger where there would be more than 4 million.

    Raises:
        InputError: If there is no triangle, or the texel is not above 0.
        MissingPackageError: If xatlas is not installed.
    """
    if not len(surface.faces):
        raise InputError("surface: expected triangles, got none.")
    if not texel > 0:
        raise InputError(f"texel: expected a length above 0, got {texel}.")
    xatlas = import_package("xatlas", "a texture", "mesh")
    vertices, faces = surface.vertices.numpy(), surface.faces.numpy()
    direction = _directions(surface)
    chart = _connected(faces, direction)
    # A vertex is there once a chart.
    count = len(vertices)
    keys, corners = np.unique(chart[:, None] * count + faces, return_inverse=True)
    corners = corners.reshape(-1, 3)
    source = keys % count
    of_vertex = np.zeros(len(keys), np.int64)
    of_vertex[corners] = direction[:, None]
    flat = np.einsum("nk,nkj->nj", vertices[source] - vertices.mean(axis=0), _PLANES[of_vertex])
    a, b, c = (flat[corners[:, i]] for i in range(3))
    area = np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).sum() / 2
    flat /= max(texel, np.sqrt(area / (_FILLED * _MAX_TEXELS)))
    atlas = xatlas.Atlas()
    atlas.add_uv_mesh(
        flat.astype(np.float32),
        corners.astype(np.uint32),
        face_materials=chart.astype(np.uint32)[:, None],
    )
    packing = xatlas.PackOptions()
    packing.texels_per_unit, packing.padding, packing.bilinear = 1.0, 2, True
    atlas.generate(xatlas.ChartOptions(), packing)
    mapped, packed, uv = atlas[0]
    width, height = int(atlas.width), int(atlas.height)
    return Atlas(
        source=source[mapped.astype(np.int64)],
        faces=packed.astype(np.int64),
        texels=uv.astype(np.float64) * [width, height],
        width=width,
        height=height,
    )


_MAX_TEXELS = 1 << 22
_FILLED = 0.7
"""Share of the image that charts fill, about; it serves to keep the image below `_MAX_TEXELS`."""

_SMOOTHING_ROUNDS = 10
"""How often normals are averaged with those of neighbours before charts are cut: fewer, larger
charts."""

_MIN_FACING = 0.2
"""Smallest cosine between a triangle's own normal and the direction that it is seen from."""

_AXES = np.concatenate((np.eye(3), -np.eye(3)))
_FIRST = np.roll(_AXES, 1, axis=1)
_PLANES = np.stack((_FIRST, np.cross(_AXES, _FIRST)), axis=2)
"""Of each direction two axes (columns) such that triangles that face it turn anticlockwise."""


def _directions(surface: TriangleMesh) -> NDArray[np.int64]:
    """The direction that each triangle is seen from, a row of `_AXES`."""
    from scipy import sparse

    faces, count = surface.faces.numpy(), len(surface.vertices)
    tails, heads = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    links = sparse.coo_matrix((np.ones(len(tails)), (tails, heads)), shape=(count, count)).tocsr()
    links = links + links.T + sparse.identity(count, format="csr")
    smooth = vertex_normals(surface).numpy()
    for _ in range(_SMOOTHING_ROUNDS):
        smooth = links @ smooth
        smooth /= np.linalg.norm(smooth, axis=1, keepdims=True).clip(1e-12)
    a, b, c = (surface.vertices.numpy()[faces[:, i]] for i in range(3))
    own = np.cross(b - a, c - a)
    own /= np.linalg.norm(own, axis=1, keepdims=True).clip(1e-300)
    wanted = smooth[faces].sum(axis=1) @ _AXES.T
    facing = own @ _AXES.T
    return np.where(facing >= _MIN_FACING, wanted, facing - 10).argmax(axis=1)


def _connected(faces: NDArray[np.int64], direction: NDArray[np.int64]) -> NDArray[np.int64]:
    """The chart of each triangle: those that share edges and have one direction."""
    from scipy import sparse

    tails, heads = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    low, high = np.minimum(tails, heads), np.maximum(tails, heads)
    key = low * (int(faces.max()) + 1) + high
    order = np.argsort(key, kind="stable")
    face = (np.arange(len(key)) // 3)[order]
    same = (np.diff(key[order]) == 0) & (direction[face[1:]] == direction[face[:-1]])
    one, two = face[:-1][same], face[1:][same]
    graph = sparse.coo_matrix((np.ones(len(one)), (one, two)), shape=(len(faces), len(faces)))
    _, chart = sparse.csgraph.connected_components(graph, directed=False)
    return chart.astype(np.int64)


def _texels(
    corners: Array, shape: tuple[int, int]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], Array]:
    """Row, column, triangle and barycentric weights of each texel whose centre is in a triangle.

    Every texel of every triangle's bounding box is tried, all triangles at once; of the triangles
    that share a texel the last counts.
    """
    size = np.array([shape[1], shape[0]])
    low = np.floor(corners.min(axis=1) - 0.5).astype(np.int64).clip(0, size - 1)
    high = np.ceil(corners.max(axis=1) + 0.5).astype(np.int64).clip(low + 1, size)
    wide, tall = (high - low).T
    count = wide * tall
    face = np.repeat(np.arange(len(corners)), count)
    place = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    column = low[face, 0] + place % wide[face]
    row = low[face, 1] + place // wide[face]
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    flat = area == 0
    dx, dy = column + 0.5 - a[face, 0], row + 0.5 - a[face, 1]
    scale = 1 / np.where(flat, 1, area)[face]
    second = (dx * (c - a)[face, 1] - dy * (c - a)[face, 0]) * scale
    third = (dy * (b - a)[face, 0] - dx * (b - a)[face, 1]) * scale
    weights = np.stack((1 - second - third, second, third), axis=1)
    kept = (weights >= -_MAX_OVERHANG).all(axis=1) & ~flat[face]
    return row[kept], column[kept], face[kept], weights[kept]


def _dilated(image: NDArray[np.uint8], covered: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """The image with each empty texel as the nearest one that is not."""
    from scipy import ndimage

    if not covered.any():
        return image
    nearest = cast(
        NDArray[np.int32],
        ndimage.distance_transform_edt(~covered, return_distances=False, return_indices=True),
    )
    return image[nearest[0], nearest[1]]
