r"""Labels of points of the world from what views of a field show at them, and from their shapes.

1. Points are thinned to cells (`point_shapes.thin`); each cell is labelled once.
2. Views vote at the points x that they show, with the label c of the pixel that x projects to:

   .. math:: v_c(x) = \sum_{j:\; z_j(x) \le (1 + \rho)\, D_j(x) + \tau}
                      \min\!\left(1, \frac{r}{z_j(x)}\right) [L_j(x) = c]

   with z the z-depth of the point in view j, D the median depth of what the field shows in its
   pixel and L its label map there. What lies before the surface is seen, so that a surface that the
   field has too far away loses no points; what lies behind it by more than the tolerance is not.
   Far views, whose pixels cover more of the world, count less.
3. Cells that views saw teach a forest what shapes are called (`point_shapes`), and it answers for
   all, also for those that no view sees: a laser looks all around, cameras ahead.
4. Both are one table, :math:`y = (v + \lambda f) / (\sum_c v_c + \lambda)`, smoothed along
   surfaces.

Any `splatseg.core.Renderable` can be asked, Gaussians or surfaces: it shows label maps and depths.
"""

import math
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int, Int64
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core import (
    LOCAL,
    UNLABELLED,
    Camera,
    Executor,
    PointLabels,
    Renderable,
    RenderableLayer,
    RenderableView,
    ScanSource,
)
from splatseg.core.boundary import boundary
from splatseg.core.options import Count, Natural, Positive, options
from splatseg.errors import InputError, RangeError
from splatseg.lift.point_shapes import (
    LocalShapes,
    ShapeForest,
    ShapeSamples,
    Thinned,
    drawn,
    forest_package,
    local_shapes,
    smoothed,
    thin,
)

VOTE_TOLERANCE = 0.3
"""Tau of votes, metres."""

RELATIVE_TOLERANCE = 0.03
"""Rho: the depth of a pixel is that of its centre, and far ones cover more."""

FULL_DISTANCE = 10.0
"""R, metres: views up to here have a full vote at a point."""

SHAPE_VOTES = 2.0
"""Lambda: how many votes of views the word of shapes is worth."""

TREES = 40
SAMPLES = 10_000
"""Cells of each label that they learn from, at most."""

OVERLAP = 8
"""Scans on either side of a window that are looked at with it."""

SIGHT_TOLERANCE = 0.1
"""Tau of `points_in_view`, metres: noise of a laser, and of depth maps."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenPoints:
    """Points that a view saw, ascending, and where."""

    points: Int64[Tensor, "m"]
    columns: Int64[Tensor, "m"]
    rows: Int64[Tensor, "m"]
    depth: Float[Tensor, "m"]
    """Their z-depth, float64."""


def visible_points(
    points: Float[Tensor, "n 3"],
    camera: Camera,
    depth: Float[Tensor, "height width"],
    *,
    tolerance: float,
    near: float = 0.0,
) -> SeenPoints:
    """The points that one view saw.

    Args:
        points: World, float64.
        camera: Of the view.
        depth: Z-depth of its pixels, 0 where it is not known.
        tolerance: Tau, scene units.
        near: Z-depth up to which nothing is seen.
    """
    pixels, z = camera.project(points)
    size = pixels.new_tensor([camera.width, camera.height])
    inside = (z > near) & ((pixels >= 0) & (pixels < size)).all(dim=1)
    found = torch.nonzero(inside).squeeze(1)
    columns, rows = pixels[found].long().unbind(dim=1)
    surface = depth[rows, columns].double()
    seen = (surface > 0) & (z[found] <= (1 + RELATIVE_TOLERANCE) * surface + tolerance)
    return SeenPoints(
        points=found[seen], columns=columns[seen], rows=rows[seen], depth=z[found[seen]]
    )


@boundary
def points_in_view(
    points: Float[Tensor, "n 3"],
    views: Iterable[tuple[Camera, Float[Tensor, "height width"]]],
    *,
    metres_per_unit: float = 1.0,
) -> Bool[Tensor, "n"]:
    """Which points at least one view saw.

    Args:
        points: World, scene units.
        views: Cameras with z-depth maps of their size, scene units, 0 where it is not known; taken
            one at a time.
        metres_per_unit: Length of a scene unit.

    Raises:
        ShapeError: If the points are not (n, 3), or a map is not of its camera's size.
        RangeError: If a point is not finite.
    """
    check_shape("points", points, (None, 3))
    check_finite("points", points)
    at = points.detach().cpu().double()
    found = torch.zeros(len(at), dtype=torch.bool)
    for camera, depth in views:
        check_shape("depth", depth, (camera.height, camera.width))
        left = torch.nonzero(~found).squeeze(1)
        seen = visible_points(
            at[left],
            camera,
            depth,
            tolerance=SIGHT_TOLERANCE / metres_per_unit,
        )
        found[left[seen.points]] = True
    return found


_NEAR = 1e-3
"""z-depth, as a part of the length in which views count in full, below which nothing is seen."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointView:
    """What a view of a field shows: labels, and where."""

    camera: Camera

    columns: Int[Tensor, "height width"]
    """Columns of the table of votes, -1 where there is no label."""

    depth: Float[Tensor, "height width"]
    """Median z-depth, scene units, 0 where nothing is."""


def view_votes(
    views: Iterable[PointView],
    points: Float[Tensor, "n 3"],
    labels: int,
    *,
    metres_per_unit: float,
) -> Float[Tensor, "n c"]:
    """How many views vote for each label at each point, far ones less.

    Args:
        views: What they show, in the order in which votes are summed.
        points: World, scene units.
        labels: Columns of the table.
        metres_per_unit: Length of a scene unit.
    """
    votes = torch.zeros(len(points), labels)
    flat = votes.view(-1)
    at, full_distance = points.double(), FULL_DISTANCE / metres_per_unit
    for view in views:
        seen = visible_points(
            at,
            view.camera,
            view.depth,
            tolerance=VOTE_TOLERANCE / metres_per_unit,
            near=_NEAR * full_distance,
        )
        label = view.columns[seen.rows, seen.columns].long()
        named = label >= 0
        weight = (full_distance / seen.depth[named]).clamp_max(1).float()
        # A view names each point once, so that nothing is added twice to one number.
        flat[seen.points[named] * labels + label[named]] += weight
    return votes


_FIXED = "it is fixed at the value that was best"


@options(
    removed=dict.fromkeys(
        (
            "tolerance", "relative_tolerance", "full_distance", "shape_votes", "trees", "samples",
            "smoothing", "smoothing_width", "normal_width", "overlap",
        ),
        _FIXED,
    )
)  # fmt: skip
class ViewedPointOptions:
    """How points take labels from views and shapes."""

    cell: Positive = 0.1
    """Side of the cells that points are thinned to, metres; all points of a cell get one label."""

    shapes: bool = True
    """Learn what shapes are called from the points that views see, for those that none sees."""

    smoothing_steps: Natural = 10
    """Steps of smoothing along surfaces; 0 is none."""

    absent: tuple[str, ...] = ("sky",)
    """Names of classes that no point can have: what the laser hit is something."""

    window: Count = 32
    """Scans put together to be labelled, of a source of scans."""

    memory: Count = 1 << 29
    """Bytes of rendered views that are kept for later points."""

    seed: int = 0
    """Of the forest."""


class ViewedPoints:
    """A field whose points take labels from its views; a `splatseg.core.Renderable`.

    All else is the field's own.

    Args:
        field: What is looked at.
        cameras: From where; those of the training views, in an order that does not matter but for
            the last bit.
        options: How points take labels.
        up: Direction away from the ground, world.
        metres_per_unit: Length of a scene unit.

    Raises:
        InputError: If there are no cameras.
        MissingPackageError: If shapes are asked for without the extra `street`.
        RangeError: If up or the unit is no length.
    """

    @boundary
    def __init__(
        self,
        field: Renderable,
        cameras: Sequence[Camera],
        *,
        options: ViewedPointOptions | None = None,
        up: tuple[float, float, float] = (0.0, 0.0, 1.0),
        metres_per_unit: float = 1.0,
    ) -> None:
        if not cameras:
            raise InputError("cameras: expected views to look at the points from, got none.")
        self._up = torch.tensor(up, dtype=torch.float64)
        if not float(torch.linalg.vector_norm(self._up)) > 0:
            raise RangeError(f"up: expected a direction, got {up}.")
        if not (math.isfinite(metres_per_unit) and metres_per_unit > 0):
            raise RangeError(f"metres_per_unit: expected a length, got {metres_per_unit}.")
        self._field = field
        self._cameras = tuple(cameras)
        self._options = options or ViewedPointOptions()
        if self._options.shapes:  # refused before the views are drawn, not after
            forest_package()
        self._unit = metres_per_unit
        self._drawn: OrderedDict[tuple[str, int], PointView] = OrderedDict()

    def __getstate__(self) -> dict[str, Any]:
        """What another process gets: it draws views itself."""
        return self.__dict__ | {"_drawn": OrderedDict()}

    @property
    def layer_names(self) -> Sequence[str]:
        """Names of all layers."""
        return self._field.layer_names

    def layer(self, layer: str) -> RenderableLayer:
        """What there is to know of a layer."""
        return self._field.layer(layer)

    def view(self, camera: Camera) -> RenderableView:
        """What the field shows through a camera."""
        return self._field.view(camera)

    def labels_at(self, points: Float[Tensor, "p 3"], layer: str) -> PointLabels:
        """Labels of points of the world; all points of one call are one cloud.

        Args:
            points: World, scene units.
            layer: Address of a layer with labels.

        Returns:
            Ids, -1 where no view and no shape tells any, and as confidence the winner's share.

        Raises:
            InputError: If the field has no such layer, or it has no labels.
            ShapeError: If the points are not (p, 3).
            RangeError: If a point is not finite.
        """
        check_shape("points", points, (None, 3))
        check_finite("points", points)
        ids = self._ids(layer)
        cloud = self._cloud(points, layer, ids)
        return self._decided(cloud, self._forest([self._sample(cloud, slice(None))]), ids)

    def labels_of_scans(
        self, scans: ScanSource, layer: str, *, executor: Executor = LOCAL
    ) -> Iterator[tuple[str, PointLabels]]:
        """Labels of the points of every scan, by its name, in the order of the source.

        Scans are put together in windows with some of those before and after them; shapes are
        learnt from all windows, a bounded sample, before any is labelled. Nothing holds more
        than a window.

        Args:
            scans: Where they are read.
            layer: Address of a layer with labels.
            executor: Where windows are worked on.

        Raises:
            InputError: If the field has no such layer, it has no labels, or a scan is broken.
        """
        windows = _Windows(points=self, scans=scans, layer=layer, ids=self._ids(layer))
        starts = range(0, len(scans.scan_names), self._options.window)
        sample: list[ShapeSamples] = []
        if self._options.shapes:
            with closing(executor.map(ViewedPoints._samples, starts, shared=windows)) as found:
                for one in found:
                    sample = [drawn([*sample, one], SAMPLES)]
        windows = replace(windows, forest=self._forest(sample))
        with closing(executor.map(ViewedPoints._labels, starts, shared=windows)) as labelled:
            yield from labelled

    @staticmethod
    def _samples(windows: "_Windows", start: int) -> Iterator[ShapeSamples]:
        """Cells of a window to learn shapes from."""
        own = windows.points
        points, rows = own._window(windows.scans, windows.scans.scan_names, start)
        cloud = own._cloud(points, windows.layer, windows.ids)
        yield own._sample(cloud, slice(rows[0][1].start, rows[-1][1].stop))

    @staticmethod
    def _labels(windows: "_Windows", start: int) -> Iterator[tuple[str, PointLabels]]:
        """Labels of the scans of a window, by name."""
        own = windows.points
        points, rows = own._window(windows.scans, windows.scans.scan_names, start)
        cloud = own._cloud(points, windows.layer, windows.ids)
        labels = own._decided(cloud, windows.forest, windows.ids)
        for name, part in rows:
            yield name, PointLabels(ids=labels.ids[part], confidence=labels.confidence[part])

    def _window(
        self, scans: ScanSource, names: Sequence[str], start: int
    ) -> tuple[Tensor, list[tuple[str, slice]]]:
        """Points of a window with its surroundings, and where those of its own scans are."""
        end = start + self._options.window
        parts: list[Tensor] = []
        rows: list[tuple[str, slice]] = []
        count = 0
        for index in range(max(0, start - OVERLAP), len(names)):
            if index >= end + OVERLAP:
                break
            points = scans.scan(names[index]).points
            if start <= index < end:
                rows.append((names[index], slice(count, count + len(points))))
            count += len(points)
            parts.append(points)
        return torch.cat(parts), rows

    def _ids(self, layer: str) -> tuple[int, ...]:
        """Ids that points may have: the columns of tables of votes."""
        summary = self._field.layer(layer)
        names = summary.info.names or {}
        return tuple(id for id in summary.ids if names.get(id) not in self._options.absent)

    def _cloud(self, points: Float[Tensor, "p 3"], layer: str, ids: tuple[int, ...]) -> "_Cloud":
        cells = thin(points, self._options.cell / self._unit)
        shapes = local_shapes(cells.centres * self._unit, self._up)
        votes = view_votes(
            (self._seen(layer, index, ids) for index in range(len(self._cameras))),
            cells.centres,
            len(ids),
            metres_per_unit=self._unit,
        )
        return _Cloud(cells=cells, shapes=shapes, votes=votes)

    def _seen(self, layer: str, index: int, ids: tuple[int, ...]) -> PointView:
        """What a view shows, drawn once while memory lasts."""
        key = (layer, index)
        if key in self._drawn:
            self._drawn.move_to_end(key)
            return self._drawn[key]
        camera = self._cameras[index]
        with self._field.view(camera) as view:
            signals = view.signals(colour=False)
            shown = view.label_map(layer).ids.cpu()
        depth = signals.depth if signals.median_depth is None else signals.median_depth
        seen = PointView(camera=camera, columns=_columns(shown, ids), depth=depth.float())
        self._drawn[key] = seen
        size = 8 * camera.width * camera.height
        while len(self._drawn) > 1 and len(self._drawn) * size > self._options.memory:
            self._drawn.popitem(last=False)
        return seen

    def _sample(self, cloud: "_Cloud", own: slice) -> ShapeSamples:
        """Cells of some of its points that views saw, to learn shapes from."""
        total = cloud.votes.sum(dim=1)
        mine = torch.zeros(len(total), dtype=torch.bool)
        mine[cloud.cells.cell_of[own]] = True
        known = mine & (total > 0)
        best, label = cloud.votes[known].max(dim=1)
        whole = ShapeSamples(
            features=cloud.shapes.features[known],
            labels=label,
            weights=best / total[known],
            hashes=cloud.cells.hashes[known],
            totals=torch.bincount(label, minlength=cloud.votes.shape[1]).double(),
        )
        return drawn([whole], SAMPLES)

    def _forest(self, samples: Sequence[ShapeSamples]) -> ShapeForest | None:
        """What shapes are called; None where that is not asked for, or views saw nothing."""
        if not self._options.shapes or not sum(len(sample) for sample in samples):
            return None
        sample = drawn(samples, SAMPLES)
        return ShapeForest(sample, trees=TREES, seed=self._options.seed)

    def _decided(
        self, cloud: "_Cloud", forest: ShapeForest | None, ids: tuple[int, ...]
    ) -> PointLabels:
        options = self._options
        table, total = cloud.votes, cloud.votes.sum(dim=1, keepdim=True)
        if forest is not None:
            table = table + SHAPE_VOTES * forest.shares(cloud.shapes.features)
            total = total + SHAPE_VOTES
        shares = torch.where(total > 0, table / total.clamp_min(1e-30), 0.0)
        shares = smoothed(shares, cloud.shapes, steps=options.smoothing_steps)
        out = torch.full((len(shares),), UNLABELLED, dtype=torch.int32)
        confidence = torch.zeros(len(shares))
        if ids and len(shares):
            best, winner = shares.max(dim=1)
            known = torch.tensor(ids, dtype=torch.int32)
            out = torch.where(best > 0, known[winner], UNLABELLED).int()
            confidence = best.clamp(0, 1)
        return PointLabels(ids=out[cloud.cells.cell_of], confidence=confidence[cloud.cells.cell_of])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Windows:
    """What all windows of scans have in common; a window is where its own scans begin."""

    points: ViewedPoints
    scans: ScanSource
    layer: str
    ids: tuple[int, ...]
    forest: ShapeForest | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Cloud:
    """Cells of points, their shapes, and the votes of views."""

    cells: Thinned
    shapes: LocalShapes
    votes: Float[Tensor, "n c"]


def _columns(
    shown: Int[Tensor, "height width"], ids: tuple[int, ...]
) -> Int[Tensor, "height width"]:
    """Columns of the table for ids, -1 for those that it lacks, int32."""
    out = torch.full(shown.shape, -1, dtype=torch.int32)
    for column, id in enumerate(ids):
        out[shown == id] = column
    return out
