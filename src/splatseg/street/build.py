"""From points, depth, photographs and label maps to a mesh field: the paper's two stages."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import ClassTable, LayerInfo, View
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.options import Count, Natural, NonNegative, Positive, options
from splatseg.errors import InputError, RangeError
from splatseg.io.evidence import Evidence
from splatseg.street.depth_views import DepthView
from splatseg.street.field import MeshField, VertexRule, with_vertex_rule
from splatseg.street.geometry import (
    PUBLISHED_GEOMETRY,
    GeometryFit,
    GeometryOptions,
    GeometryRecord,
    fit_geometry,
)
from splatseg.street.primitives import PrimitiveMesh, Primitives, voxel_primitives
from splatseg.street.radiance import PUBLISHED_RADIANCE, RadianceOptions
from splatseg.street.radiance_training import RadianceFit, RadianceRecord, train_radiance
from splatseg.street.shape_files import load_shapes

Setting = Literal["fast", "published"]
"""fast: networks and rates that are sized for two cores.
published: those of the papers and of DNMP's public code."""


@options(
    removed={
        "coarse": "all levels have primitives in all voxels with points, as published",
        "start": "primitives start as near spheres, as published",
        "memory": "hits of more than 1 GiB lie in temporary files",
    }
)
class DnmpOptions:
    """How a mesh field is made: primitives in voxels, their shapes, their colours and classes."""

    setting: Setting = "fast"
    """fast: networks and rates for two cores. published: those of the papers. What is given below
    counts before it."""

    voxels: tuple[float, ...] = (0.5, 1.0)
    """Sides of the voxels of the levels, metres."""

    geometry_iterations: Natural | None = None
    """Steps of the fit of shapes to depth. None is the setting's."""

    carve: Positive | None = None
    """Primitives are removed through which this share of their rays sees further than a voxel; and
    those with a camera inside, which are refused without. None is 0.9, or none with published."""

    iterations: Count | None = None
    """Steps of the training of colours and classes. None is the setting's."""

    rays: Count | None = None
    """Rays of a step of that training. None is the setting's 4096."""

    semantic_weight: NonNegative | None = None
    """Weight of the cross-entropy of classes beside the squared error of colours. None is 0.3,
    or 0.1 with published."""

    radius: Positive | None = None
    """Of the ball around a point, metres, whose vertices label it. None is the side of the finest
    voxels."""

    vertex_rule: VertexRule | None = None
    """Which vertices in that ball are asked (eq. 9). adjusted: those whose features training
    adjusted, as published; a point with none has no label. weighed: all, each by how much training
    rays saw of it, 0.01 at least. all: all alike. None is weighed, or adjusted with published."""

    def __post_init__(self) -> None:
        if not self.voxels or not all(0 < side < math.inf for side in self.voxels):
            raise RangeError(f"voxels: expected positive lengths in metres, got {self.voxels}.")

    @property
    def geometry(self) -> GeometryOptions:
        """The same for `fit_geometry`."""
        fast = self.setting == "fast"
        options = replace(GeometryOptions(), carve=_CARVE) if fast else PUBLISHED_GEOMETRY
        return replace(options, **_given(iterations=self.geometry_iterations, carve=self.carve))

    @property
    def radiance(self) -> RadianceOptions:
        """The same for `train_radiance`."""
        options = RadianceOptions() if self.setting == "fast" else PUBLISHED_RADIANCE
        given = _given(
            iterations=self.iterations, rays=self.rays, semantic_weight=self.semantic_weight
        )
        return replace(options, **given)

    @property
    def effective_vertex_rule(self) -> VertexRule:
        """The rule of eq. 9, of the setting where none was given."""
        if self.vertex_rule is not None:
            return self.vertex_rule
        return "weighed" if self.setting == "fast" else "adjusted"


_CARVE = 0.9


def _given(**values: Any) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


PUBLISHED = DnmpOptions(setting="published")


METHOD_NAME = "dnmp"

Stage = Callable[[str, int, int], None]
"""Told of a stage (``geometry``, ``field``), steps done, and all there are."""

_ENOUGH = 10.0
"""Rays that saw a vertex which counts half."""

_LEAST_HALF = 2.0**-24
"""The least positive number of float16."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeshFieldFit:
    """A mesh field, and how it came to be."""

    field: MeshField

    start: Primitives
    """Primitives as voxels gave them, of all levels."""

    geometry: GeometryFit
    radiance: RadianceFit


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeshFieldInputs:
    """What a mesh field is built from."""

    points: Float[Tensor, "n 3"]
    """On surfaces, world, scene units."""

    depths: Iterable[DepthView]
    """Depth of views, read once."""

    views: Sequence[View]
    """Views to learn from, with photographs."""

    evidence: Evidence
    """Their label maps."""

    classes: ClassTable | None = None
    """The classes, of which a label that is not in the table is refused; None takes the ids of the
    maps."""

    metres_per_unit: float = 1.0
    """Length of a scene unit, metres."""

    def __post_init__(self) -> None:
        convert_fields(self)


@boundary
def build_mesh_field(
    inputs: MeshFieldInputs,
    *,
    options: DnmpOptions | None = None,
    layer: str = "semantic",
    seed: int = 0,
    progress: Stage | None = None,
) -> MeshFieldFit:
    """Put primitives at points, fit their shapes to depth, learn their colours and classes.

    Features of vertices are rounded to float16 in the end, so that a saved field is the same.

    Args:
        inputs: Points, depth, photographs and label maps.
        options: How it is made.
        layer: Name of the field's layer.
        seed: Of all random choices.
        progress: Told of the progress.

    Raises:
        InputError: If there are no points or all are in one voxel, a camera stands inside a
            primitive that is not carved, no view has depth, or photographs or label maps cannot
            be used.
    """
    options = options or DnmpOptions()
    shapes, metres, classes = load_shapes(), inputs.metres_per_unit, inputs.classes
    primitives = voxel_primitives(
        inputs.points, shapes=shapes, sizes=options.voxels, metres_per_unit=metres
    )
    _check_several(primitives, len(inputs.points), options, metres)

    steps = options.geometry.iterations * len(options.voxels)

    def shaping(record: GeometryRecord) -> None:
        if progress is not None:
            progress("geometry", round(steps * record.progress), steps)

    def learning(record: RadianceRecord) -> None:
        if progress is not None:
            progress("field", record.iteration, record.iterations)

    shaped = fit_geometry(
        primitives,
        shapes,
        inputs.depths,
        options=options.geometry,
        seed=seed,
        metres_per_unit=metres,
        progress=shaping,
    )
    mesh = shaped.primitives.mesh(shapes)
    trained = train_radiance(
        mesh,
        inputs.views,
        inputs.evidence,
        ids=None if classes is None else [row.id for row in classes.rows],
        options=options.radiance,
        seed=seed,
        progress=learning,
    )
    with torch.no_grad():
        trained.model.features.copy_(trained.model.features.half().float())
    seen = visible_shares(trained.seen)
    info = _record(inputs, options, shaped, mesh, trained, seed=seed)
    field = MeshField(
        mesh,
        trained.model,
        layer=layer,
        info=with_vertex_rule(info, options.effective_vertex_rule),
        radius=None if options.radius is None else options.radius / metres,
        seen=seen,
        vertex_rule=options.effective_vertex_rule,
    )
    return MeshFieldFit(field=field, start=primitives, geometry=shaped, radiance=trained)


def _record(
    inputs: MeshFieldInputs,
    options: DnmpOptions,
    shaped: GeometryFit,
    mesh: PrimitiveMesh,
    trained: RadianceFit,
    *,
    seed: int,
) -> LayerInfo:
    """What the field's layer records of how it was made."""
    names = {} if inputs.classes is None else {row.id: row.name for row in inputs.classes.rows}
    return LayerInfo(
        method=METHOD_NAME,
        options=asdict(options),
        views=tuple(view.name for view in inputs.views),
        names={id: names[id] for id in sorted(trained.model.ids) if id in names},
        seed=seed,
        details={
            "primitives": [int((mesh.levels == i).sum()) for i in range(len(mesh.sizes))],
            "points": len(inputs.points),
            "removed_around_cameras": shaped.enclosing,
            "removed_before_surfaces": shaped.carved,
            "rays": trained.rays,
            "hits": trained.hits,
            "vertices": len(trained.seen),
            "adjusted_vertices": int((trained.seen > 0).sum()),
        },
    )


def visible_shares(seen: Float[Tensor, "v"]) -> Float[Tensor, "v"]:
    """What vertices that so many rays saw count in eq. 9, in [0, 1], as float16 holds it.

    Above 0 exactly where a ray adjusted the vertex, however little it saw of it.
    """
    shares = (seen / (seen + _ENOUGH)).half().float()
    return torch.where(seen > 0, shares.clamp_min(_LEAST_HALF), 0.0)


def _check_several(
    primitives: Primitives, points: int, options: DnmpOptions, metres_per_unit: float
) -> None:
    """Refuse points that are all in one voxel: their unit is wrong, or there is no drive."""
    finest = int((primitives.levels == 0).sum())
    coarsest = int((primitives.levels == len(primitives.sizes) - 1).sum())
    if max(finest, coarsest) > 1:
        return
    raise InputError(
        f"points: expected points in several voxels of {min(options.voxels):g} m, got {points} in "
        f"one; a scene unit is taken for {metres_per_unit:g} m."
    )
