r"""Points that take labels from what views of a field show at them, and from their own shapes.

1. Points are thinned to cells (`thin`); each cell is labelled once.
2. Views of the field vote where their depth says that they see a cell (`votes`).
3. Cells that views saw teach a forest what shapes are called (`forest`, `shapes`), and it tells
   its mind of all, above all of those that no view sees: a laser looks all around, cameras ahead.
4. Both are one table, :math:`y = (v + \lambda f) / (\sum_c v_c + \lambda)`, smoothed along
   surfaces (`smooth`).

Any `splatseg.core.Renderable` can be asked, Gaussians or surfaces: it shows label maps and depths.
"""

import math
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg._check import check_finite, check_range, check_shape
from splatseg.core import (
    UNLABELLED,
    Camera,
    PointLabels,
    Renderable,
    RenderableLayer,
    RenderableView,
    ScanSource,
)
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, RangeError
from splatseg.lift.points.forest import ShapeForest, ShapeSamples, drawn
from splatseg.lift.points.shapes import Surroundings, surroundings
from splatseg.lift.points.smooth import smoothed
from splatseg.lift.points.thin import Thinned, thin
from splatseg.lift.points.votes import SeenView, view_votes

_POSITIVE = ("cell", "full_distance", "smoothing_width", "normal_width")
_NOT_NEGATIVE = ("tolerance", "relative_tolerance", "shape_votes")
_AT_LEAST_ONE = ("trees", "samples", "memory", "window")


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewedPointOptions:
    """How points take labels from views and shapes. Lengths are metres."""

    cell: float = 0.1
    """Side of the cells that points are thinned to: a label for all points of a cell."""

    tolerance: float = 0.3
    """How far behind the surface that a view shows a point may lie to be seen."""

    relative_tolerance: float = 0.03
    """The same, as a part of the surface's depth; both together count."""

    full_distance: float = 10.0
    """Views up to here have a full vote at a point, others less in inverse proportion."""

    shapes: bool = True
    """Learn from the points that views see what shapes are called, for those that none sees."""

    shape_votes: float = 2.0
    """How many votes of views the word of shapes is worth."""

    trees: int = 40
    """Trees that learn shapes."""

    samples: int = 10_000
    """Cells of each label that they learn from, at most."""

    smoothing_steps: int = 10
    """Steps along surfaces; 0 is none."""

    smoothing: float = 0.7
    """What neighbours count together beside a cell's own votes, in [0, 1]."""

    smoothing_width: float = 0.3
    """Standard deviation of the distance at which neighbours count."""

    normal_width: float = 0.2
    """By how much of 1 - |cos| of their normals neighbours count e times less."""

    absent: tuple[str, ...] = ("sky",)
    """Names of classes that no point can have: what the laser hit is something."""

    window: int = 32
    """Scans put together to be labelled, of a source of scans."""

    overlap: int = 8
    """Scans on either side of these that are looked at with them."""

    memory: int = 1 << 29
    """Bytes of drawn views that are kept for later points."""

    seed: int = 0
    """Of the trees."""

    def __post_init__(self) -> None:
        convert_fields(self)
        for name in _POSITIVE:
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise RangeError(f"{name}: expected a positive number, got {value}.")
        for name in _NOT_NEGATIVE:
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise RangeError(f"{name}: expected 0 or more, got {value}.")
        for name in _AT_LEAST_ONE:
            if getattr(self, name) < 1:
                raise RangeError(f"{name}: expected at least 1, got {getattr(self, name)}.")
        for name in ("smoothing_steps", "overlap"):
            if getattr(self, name) < 0:
                raise RangeError(f"{name}: expected 0 or more, got {getattr(self, name)}.")
        check_range("smoothing", self.smoothing, 0.0, 1.0)


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
        self._unit = metres_per_unit
        self._drawn: OrderedDict[tuple[str, int], SeenView] = OrderedDict()

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

    def labels_of_scans(self, scans: ScanSource, layer: str) -> Iterator[tuple[str, PointLabels]]:
        """Labels of the points of every scan, by its name, in the order of the source.

        Scans are put together in windows with some of those before and after them; shapes are
        learnt from all windows, a bounded sample, before any is labelled. Nothing holds more
        than a window.

        Raises:
            InputError: If the field has no such layer, it has no labels, or a scan is broken.
        """
        ids = self._ids(layer)
        names = list(scans.scan_names)
        sample: list[ShapeSamples] = []
        if self._options.shapes:
            for start in range(0, len(names), self._options.window):
                points, rows = self._window(scans, names, start)
                own = slice(rows[0][1].start, rows[-1][1].stop)
                found = self._sample(self._cloud(points, layer, ids), own)
                sample = [drawn([*sample, found], self._options.samples)]
        forest = self._forest(sample)
        for start in range(0, len(names), self._options.window):
            points, rows = self._window(scans, names, start)
            labels = self._decided(self._cloud(points, layer, ids), forest, ids)
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
        for index in range(max(0, start - self._options.overlap), len(names)):
            if index >= end + self._options.overlap:
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
        around = surroundings(cells.centres * self._unit, self._up)
        votes = view_votes(
            (self._seen(layer, index, ids) for index in range(len(self._cameras))),
            cells.centres,
            len(ids),
            tolerance=self._options.tolerance / self._unit,
            relative_tolerance=self._options.relative_tolerance,
            full_distance=self._options.full_distance / self._unit,
        )
        return _Cloud(cells=cells, around=around, votes=votes)

    def _seen(self, layer: str, index: int, ids: tuple[int, ...]) -> SeenView:
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
        seen = SeenView(camera=camera, columns=_columns(shown, ids), depth=depth.float())
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
            features=cloud.around.features[known],
            labels=label,
            weights=best / total[known],
            hashes=cloud.cells.hashes[known],
            totals=torch.bincount(label, minlength=cloud.votes.shape[1]).double(),
        )
        return drawn([whole], self._options.samples)

    def _forest(self, samples: Sequence[ShapeSamples]) -> ShapeForest | None:
        """What shapes are called; None where that is not asked for, or views saw nothing."""
        if not self._options.shapes or not sum(len(sample) for sample in samples):
            return None
        sample = drawn(samples, self._options.samples)
        return ShapeForest(sample, trees=self._options.trees, seed=self._options.seed)

    def _decided(
        self, cloud: "_Cloud", forest: ShapeForest | None, ids: tuple[int, ...]
    ) -> PointLabels:
        options = self._options
        table, total = cloud.votes, cloud.votes.sum(dim=1, keepdim=True)
        if forest is not None:
            table = table + options.shape_votes * forest.shares(cloud.around.features)
            total = total + options.shape_votes
        shares = torch.where(total > 0, table / total.clamp_min(1e-30), 0.0)
        shares = smoothed(
            shares,
            cloud.around,
            steps=options.smoothing_steps,
            weight=options.smoothing,
            width=options.smoothing_width,
            normal_width=options.normal_width,
        )
        out = torch.full((len(shares),), UNLABELLED, dtype=torch.int32)
        confidence = torch.zeros(len(shares))
        if ids and len(shares):
            best, winner = shares.max(dim=1)
            known = torch.tensor(ids, dtype=torch.int32)
            out = torch.where(best > 0, known[winner], UNLABELLED).int()
            confidence = best.clamp(0, 1)
        return PointLabels(ids=out[cloud.cells.cell_of], confidence=confidence[cloud.cells.cell_of])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Cloud:
    """Cells of points, what is around them, and the votes of views."""

    cells: Thinned
    around: Surroundings
    votes: Float[Tensor, "n c"]


def _columns(
    shown: Int[Tensor, "height width"], ids: tuple[int, ...]
) -> Int[Tensor, "height width"]:
    """Columns of the table for ids, -1 for those that it lacks, int32."""
    out = torch.full(shown.shape, -1, dtype=torch.int32)
    for column, id in enumerate(ids):
        out[shown == id] = column
    return out
