r"""True label maps from labelled surfaces: what rays through pixel centres meet first.

A surface is a field (`splatseg.core.Renderable`), so that views of it are rendered, written and
compared as those of Gaussians are, in the photograph's own pixels: the ray of a pixel is
`splatseg.core.Camera.rays` of its exact centre, lens distortion included.

Of a mesh a pixel takes the label of the face that its ray meets, or that of the corner with the
largest barycentric weight there. Points become hexagons in their tangent planes, and a pixel takes
the label of the labelled point that is nearest to where its ray meets the first of them: Surfels
(Pfister et al. 2000) that share the surface as Voronoi cells do.

References:
    Pfister, Zwicker, van Baar and Gross, Surfels: Surface Elements as Rendering Primitives (2000).
    Yeshwanth et al., ScanNet++ (2023), section 4: labels of the mesh, rasterised in the images.
"""

import math
from collections.abc import Iterator, Sequence
from types import TracebackType
from typing import Annotated, Self

import torch
from jaxtyping import Float, Int
from msgspec import Meta
from torch import Tensor

from splatseg.core import (
    UNLABELLED,
    Camera,
    LabelledMesh,
    LabelledPoints,
    LabelMap,
    LayerInfo,
    PointLabels,
    RenderableLayer,
    ViewSignals,
)
from splatseg.core.boundary import boundary
from splatseg.core.options import Positive, options
from splatseg.errors import InputError
from splatseg.neighbours import NeighbourIndex
from splatseg.raycast import RayCaster

_PIXELS = 1 << 17
"""Pixels whose rays are looked at together."""

_POINTS = 1 << 16
_SAME_SURFACE = 0.05
"""Share of its depth by which what is seen through a hole is farther."""

_OUTLIER = 3.0
"""How many times farther a point's neighbours may be than those of its neighbours are."""

_CORNERS = 6
_HEXAGON = ((0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5))


@options
class PointSurfaceOptions:
    """How labelled points become a surface."""

    radius: Positive | None = None
    """Of the hexagon that each point becomes, scene units. None takes `spread` times the distance
    to the point's `neighbours`-th neighbour, but no more than three times the median of that of
    its neighbours: points far from all others stay small."""

    spread: Positive = 0.6
    """Of the radius where none is given: larger closes holes, smaller keeps outlines."""

    neighbours: Annotated[int, Meta(ge=3)] = 6
    """Other points whose distance tells the radius and which tell the tangent plane of a point
    without a normal, at least 3."""

    fill: Annotated[int, Meta(ge=0, le=1000)] = 3
    """Holes of up to twice so many pixels across, through which nothing or what is farther is seen,
    take label and depth of the nearest pixel that is near enough; 0 fills none."""


class SurfaceField:
    """A labelled surface as a field: label maps, depth and alpha of any view.

    It has no colours. One layer a name of labels; ids are as they are in memory.

    Args:
        surface: The mesh or the points.
        points: How points become a surface.
        infos: What is known of layers, by their names: names of ids, ids of the files.

    Raises:
        InputError: If the surface has no labels, or `infos` names others.
        MissingPackageError: If embreex is not installed.

    Example:
        >>> mesh = LabelledMesh(
        ...     vertices=torch.tensor([[-9.0, -9, 2], [9, -9, 2], [0, 9, 2]]),
        ...     faces=torch.tensor([[0, 1, 2]]), face_labels={"label": torch.tensor([7])})
        >>> camera = Camera(width=2, height=1, fx=1, fy=1, cx=1, cy=0.5,
        ...                 cam_from_world=torch.eye(4))
        >>> with SurfaceField(mesh).view(camera) as view:
        ...     view.label_map("label").ids.tolist(), view.signals().depth.tolist()
        ([[7, 7]], [[2.0, 2.0]])
    """

    @boundary
    def __init__(
        self,
        surface: LabelledMesh | LabelledPoints,
        *,
        points: PointSurfaceOptions | None = None,
        infos: dict[str, LayerInfo] | None = None,
    ) -> None:
        if not surface.labels:
            raise InputError("surface: expected labels of vertices, faces or points, got none.")
        unknown = sorted(set(infos or {}) - set(surface.labels))
        if unknown:
            raise InputError(f"infos: expected names of labels, got {unknown[0]!r} too.")
        self._surface = surface
        self._infos = dict(infos or {})
        self._options = points or PointSurfaceOptions()
        self._nearest: NeighbourIndex | None = None
        if isinstance(surface, LabelledMesh):
            self._caster = RayCaster(surface.vertices, surface.faces)
        else:
            self._caster = RayCaster(*_hexagons(surface, self._options))

    @property
    def layer_names(self) -> Sequence[str]:
        """Names of the labels."""
        return tuple(self._surface.labels)

    def layer(self, layer: str) -> RenderableLayer:
        """Which ids the labels have.

        Raises:
            InputError: If there are no such labels.
        """
        ids = self._ids(layer).unique().tolist()
        return RenderableLayer(
            ids=tuple(id for id in ids if id != UNLABELLED),
            info=self._infos.get(layer, LayerInfo()),
        )

    def view(self, camera: Camera) -> "SurfaceView":
        """What a camera sees of it."""
        return SurfaceView(self, camera)

    @boundary
    def labels_at(self, points: Float[Tensor, "p 3"], layer: str) -> PointLabels:
        """The label of the nearest vertex, or labelled point.

        Raises:
            InputError: If there are no such labels, or they are of faces.
            ShapeError: If the points are not (p, 3).
        """
        ids = self._ids(layer)
        if isinstance(self._surface, LabelledMesh) and layer in self._surface.face_labels:
            raise InputError(
                f"layer: expected labels of vertices for labels at points, {layer!r} are of faces."
            )
        found = ids[self._nearest_index().nearest(points, 1).indices[:, 0].cpu()]
        return PointLabels(ids=found, confidence=(found != UNLABELLED).float())

    def _ids(self, layer: str) -> Tensor:
        labels = self._surface.labels
        if layer not in labels:
            raise InputError(
                f"layer: expected labels of the surface ({', '.join(labels)}), got {layer!r}."
            )
        return labels[layer]

    def _nearest_index(self) -> NeighbourIndex:
        if self._nearest is None:
            surface = self._surface
            is_mesh = isinstance(surface, LabelledMesh)
            self._nearest = NeighbourIndex(surface.vertices if is_mesh else surface.points)
        return self._nearest

    def look(self, camera: Camera) -> tuple[dict[str, Tensor], Tensor]:
        """Rows of labels that the pixels show, -1 none, and their z-depth, 0 none.

        Returns:
            int64 rows (H, W) of ``vertex`` and ``face`` of a mesh, or of ``point``; float32 depth
            (H, W).
        """
        rows: dict[str, list[Tensor]] = {}
        depths: list[Tensor] = []
        forward = camera.cam_from_world[2, :3].detach()
        for pixels in _pixel_centres(camera):
            origin, directions = camera.rays(pixels)
            origin, directions = origin.detach(), directions.detach()
            hits = self._caster.cast(origin, directions)
            hit = hits.faces >= 0
            distance = torch.where(hit, hits.distances, 0.0)
            depths.append((distance * (directions @ forward)).float())
            meets = origin + distance[:, None] * directions
            for name, found in self._rows_of(hits.faces, hits.weights, meets).items():
                rows.setdefault(name, []).append(found)
        size = (camera.height, camera.width)
        maps = {name: torch.cat(parts).reshape(size) for name, parts in rows.items()}
        depth = torch.cat(depths).reshape(size)
        if isinstance(self._surface, LabelledPoints) and self._options.fill:
            maps, depth = _filled(maps, depth, self._options.fill)
        return maps, depth

    def _rows_of(self, faces: Tensor, weights: Tensor, meets: Tensor) -> dict[str, Tensor]:
        hit = faces >= 0
        if isinstance(self._surface, LabelledMesh):
            corner = weights.argmax(dim=-1)
            vertex = self._surface.faces[faces.clamp_min(0), corner]
            return {"vertex": torch.where(hit, vertex, -1), "face": faces}
        point = torch.full_like(faces, -1)
        at = hit.nonzero()[:, 0]
        point[at] = self._nearest_index().nearest(meets[at], 1).indices[:, 0]
        return {"point": point}

    def read(self, maps: dict[str, Tensor], layer: str) -> Int[Tensor, "height width"]:
        """Ids of one of the labels, of what `look` found."""
        ids = self._ids(layer)
        if isinstance(self._surface, LabelledPoints):
            rows = maps["point"]
        else:
            rows = maps["face" if layer in self._surface.face_labels else "vertex"]
        return torch.where(rows >= 0, ids[rows.clamp_min(0)], UNLABELLED)


class SurfaceView:
    """One view of a surface: rays are cast when something is asked for first."""

    def __init__(self, field: SurfaceField, camera: Camera) -> None:
        self._field = field
        self._camera = camera
        self._seen: tuple[dict[str, Tensor], Tensor] | None = None

    def __enter__(self) -> Self:
        """Begin to look."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Forget what was seen."""
        self._seen = None

    def signals(self, *, colour: bool = True) -> ViewSignals:
        """Alpha is 1 where something is met; there are no colours."""
        _, depth = self._looked()
        alpha = (depth > 0).float()
        return ViewSignals(alpha=alpha, depth=depth, median_depth=depth)

    def features(self, layer: str) -> Float[Tensor, "height width channels"]:
        """None: labels are no features.

        Raises:
            InputError: Always.
        """
        raise InputError(f"layer: expected features, {layer!r} holds labels of a surface.")

    def label_map(self, layer: str) -> LabelMap:
        """Ids of what is met, -1 where nothing is met or its label is void.

        Raises:
            InputError: If there are no such labels.
        """
        ids = self._field.read(self._looked()[0], layer)
        return LabelMap(ids=ids, confidence=(ids != UNLABELLED).float())

    def confidence(self, layer: str) -> Float[Tensor, "height width"]:
        """1 where there is a label, 0 where it is void, -1 where nothing is met."""
        sure = (self._field.read(self._looked()[0], layer) != UNLABELLED).float()
        return torch.where(self._looked()[1] > 0, sure, -1.0)

    def _looked(self) -> tuple[dict[str, Tensor], Tensor]:
        if self._seen is None:
            self._seen = self._field.look(self._camera)
        return self._seen


def _pixel_centres(camera: Camera) -> Iterator[Float[Tensor, "n 2"]]:
    """Centres of all pixels, row by row, some at a time."""
    count = camera.width * camera.height
    for start in range(0, count, _PIXELS):
        index = torch.arange(start, min(start + _PIXELS, count))
        columns, rows = index % camera.width, index // camera.width
        yield torch.stack((columns, rows), dim=-1).double() + 0.5


def _hexagons(
    cloud: LabelledPoints, options: PointSurfaceOptions
) -> tuple[Float[Tensor, "v 3"], Int[Tensor, "m 3"]]:
    """Vertices and triangles of a hexagon at each point, in its tangent plane."""
    count = len(cloud)
    normals, reach = _tangent_planes(cloud, options)
    if options.radius is not None:
        radii = torch.full((count,), options.radius, dtype=torch.float64)
    else:
        if count < 2:
            raise InputError("radius: expected a radius for a point without neighbours, got None.")
        radii = options.spread * reach
    # Any direction across the normal: from the axis that the normal is farthest from.
    axis = torch.nn.functional.one_hot(normals.abs().argmin(dim=-1), 3).double()
    first = torch.nn.functional.normalize(torch.linalg.cross(normals, axis), dim=-1)
    second = torch.linalg.cross(normals, first)
    turn = torch.arange(_CORNERS, dtype=torch.float64) * (2 * math.pi / _CORNERS)
    spokes = turn.cos()[:, None] * first[:, None] + turn.sin()[:, None] * second[:, None]
    vertices = cloud.points[:, None] + radii[:, None, None] * spokes
    corners = torch.tensor(_HEXAGON)
    faces = _CORNERS * torch.arange(count)[:, None, None] + corners
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)


def _tangent_planes(
    cloud: LabelledPoints, options: PointSurfaceOptions
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
    """Unit normals, given or of the neighbours' plane, and how far the neighbours reach."""
    index = NeighbourIndex(cloud.points)
    normals = torch.empty(len(cloud), 3, dtype=torch.float64)
    reach = torch.empty(len(cloud), dtype=torch.float64)
    others: list[Int[Tensor, "m k"]] = []
    for rows in torch.arange(len(cloud)).split(_POINTS):
        found = index.nearest_others(options.neighbours, rows=rows)
        there = found.indices >= 0
        reach[rows] = torch.where(there, found.distances, 0.0).amax(dim=-1)
        # The point itself is one of those that the plane is put through.
        near = torch.where(there, found.indices, rows[:, None])
        near = torch.cat((rows[:, None], near), dim=1)
        others.append(near.int())
        offsets = cloud.points[near] - cloud.points[rows, None]
        weights = torch.cat((torch.ones_like(there[:, :1]), there), dim=1)[..., None].double()
        middle = (offsets * weights).sum(dim=1, keepdim=True) / weights.sum(dim=1, keepdim=True)
        apart = (offsets - middle) * weights
        normals[rows] = torch.linalg.eigh(apart.mT @ apart).eigenvectors[..., 0]
    usual = torch.cat([reach[near.long()].median(dim=-1).values for near in others])
    if cloud.normals is not None:
        lengths = torch.linalg.vector_norm(cloud.normals, dim=-1, keepdim=True)
        given = cloud.normals / lengths.clamp_min(1e-300)
        normals = torch.where(lengths > 0, given, normals)
    return normals, torch.minimum(reach, _OUTLIER * usual)


def _filled(
    maps: dict[str, Tensor], depth: Tensor, pixels: int
) -> tuple[dict[str, Tensor], Tensor]:
    """Holes in what is near, through which something farther or nothing is seen, closed.

    A hole is what the morphological closing of 1 / z by a square window fills. It takes the nearest
    pixel that is as near as the closing says.
    """
    from scipy.ndimage import grey_closing

    near = torch.where(depth > 0, 1 / depth.double().clamp_min(1e-300), 0.0)
    side = 2 * pixels + 1
    closed = torch.from_numpy(grey_closing(near.numpy(), size=(side, side), mode="nearest"))
    hole = near < closed * (1 - _SAME_SURFACE)
    rows, columns = hole.nonzero().unbind(-1)
    limit = closed[rows, columns] * (1 - _SAME_SURFACE)
    source = torch.full((len(rows), 2), -1)
    steps = sorted(
        ((y, x) for y in range(-pixels, pixels + 1) for x in range(-pixels, pixels + 1)),
        key=lambda step: (step[0] ** 2 + step[1] ** 2, step),
    )
    for y, x in steps:
        row, column = rows + y, columns + x
        inside = (row >= 0) & (row < near.shape[0]) & (column >= 0) & (column < near.shape[1])
        row, column = row.clamp(0, near.shape[0] - 1), column.clamp(0, near.shape[1] - 1)
        takes = inside & (source[:, 0] < 0) & (near[row, column] >= limit)
        source[takes] = torch.stack((row, column), dim=-1)[takes]
    found = (source[:, 0] >= 0).nonzero()[:, 0]
    to, of = (rows[found], columns[found]), tuple(source[found].unbind(-1))
    for values in (*maps.values(), depth):
        values[to] = values[of].clone()
    return maps, depth
