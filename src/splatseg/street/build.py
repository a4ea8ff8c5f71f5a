"""From points, depth, photographs and label maps to a mesh field: the paper's two stages."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import ClassTable, LayerInfo, View
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.io.evidence import Evidence
from splatseg.street.field import MeshField, with_vertex_rule
from splatseg.street.geometry import DepthView, GeometryFit, GeometryRecord, fit_geometry
from splatseg.street.options import DnmpOptions
from splatseg.street.primitives import Primitives, voxel_primitives
from splatseg.street.radiance import RadianceFit, RadianceRecord, train_radiance
from splatseg.street.shapes import load_shapes

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


@boundary
def build_mesh_field(
    points: Float[Tensor, "n 3"],
    depths: Iterable[DepthView],
    views: Sequence[View],
    evidence: Evidence,
    *,
    options: DnmpOptions | None = None,
    layer: str = "semantic",
    classes: ClassTable | None = None,
    metres_per_unit: float = 1.0,
    seed: int = 0,
    cache_folder: Path | None = None,
    progress: Stage | None = None,
) -> MeshFieldFit:
    """Put primitives at points, fit their shapes to depth, learn their colours and classes.

    Features of vertices are rounded to float16 in the end, so that a saved field is the same.

    Args:
        points: On surfaces, world, scene units.
        depths: Depth of views, read once.
        views: To learn from, with photographs.
        evidence: Their label maps.
        options: How it is made.
        layer: Name of the field's layer.
        classes: The classes, of which a label that is not in the table is refused; None takes
            the ids of the maps.
        metres_per_unit: Length of a scene unit.
        seed: Of all random choices.
        cache_folder: Where hits that exceed the memory given are kept for the next training.
        progress: Told of the progress.

    Raises:
        InputError: If there are no points or all are in one voxel, a camera stands inside a
            primitive that is not carved, no view has depth, or photographs or label maps cannot
            be used.
    """
    options = options or DnmpOptions()
    shapes = load_shapes()
    primitives = voxel_primitives(
        points,
        shapes=shapes,
        sizes=options.voxels,
        metres_per_unit=metres_per_unit,
        coarse=options.coarse,
        start=options.start,
    )
    _check_several(primitives, len(points), options, metres_per_unit)

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
        depths,
        options=options.geometry,
        seed=seed,
        metres_per_unit=metres_per_unit,
        progress=shaping,
    )
    mesh = shaped.primitives.mesh(shapes)
    trained = train_radiance(
        mesh,
        views,
        evidence,
        ids=None if classes is None else [row.id for row in classes.rows],
        options=options.radiance,
        seed=seed,
        cache_folder=cache_folder,
        progress=learning,
    )
    model = trained.model
    with torch.no_grad():
        model.features.copy_(model.features.half().float())
    seen = seen_shares(trained.seen)
    names = {} if classes is None else {row.id: row.name for row in classes.rows}
    info = LayerInfo(
        method=METHOD_NAME,
        options=asdict(options),
        views=tuple(view.name for view in views),
        names={id: names[id] for id in sorted(model.ids) if id in names},
        seed=seed,
        details={
            "primitives": [int((mesh.levels == i).sum()) for i in range(len(mesh.sizes))],
            "points": len(points),
            "removed_around_cameras": shaped.enclosing,
            "removed_before_surfaces": shaped.carved,
            "rays": trained.rays,
            "hits": trained.hits,
            "vertices": len(seen),
            "adjusted_vertices": int((seen > 0).sum()),
        },
    )
    radius = None if options.radius is None else options.radius / metres_per_unit
    return MeshFieldFit(
        field=MeshField(
            mesh,
            model,
            layer=layer,
            info=with_vertex_rule(info, options.asked_vertices),
            radius=radius,
            seen=seen,
            vertex_rule=options.asked_vertices,
        ),
        start=primitives,
        geometry=shaped,
        radiance=trained,
    )


def seen_shares(seen: Float[Tensor, "v"]) -> Float[Tensor, "v"]:
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
