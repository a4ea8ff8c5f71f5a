"""``segment --method dnmp``: labels of Gaussians from a mesh field of the same drive.

Primitives are put where the Gaussians show surfaces and fitted to the depth that they show; the
field learns from photographs and label maps, as the paper has it. A Gaussian takes the label of
its centre, by eq. 9; one without a vertex near it that the rule asks has none, and is completed as
usual. The layer's record has the rule (option ``vertex_rule``), and how many Gaussians eq. 9 left
undefined (``undefined``).

References:
    DNMP with semantics (papers/002).
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import UNLABELLED, Gaussians, Labels, ScanSource, View
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, RangeError
from splatseg.lift import GaussianField
from splatseg.lift.point_shapes import thin
from splatseg.methods import Method, MethodInputs
from splatseg.street.build import (
    METHOD_NAME,
    PUBLISHED,
    DnmpOptions,
    MeshFieldInputs,
    build_mesh_field,
)
from splatseg.street.depth_views import DepthView, field_views
from splatseg.street.field import MeshField
from splatseg.street.geometry import MAX_DEPTH

_CELLS = 5
"""Points are thinned to so many cells along the side of the finest voxel."""

_BACKGROUND_VIEWS = 8
_SHAPING = 300
_STEPS = 1000
"""Progress of the whole, of which the geometry is the first part."""


def run(inputs: MethodInputs, options: DnmpOptions) -> Labels:
    """Build a mesh field and read it at the centres of Gaussians."""
    if not len(inputs.gaussians):
        raise InputError("gaussians: expected Gaussians to label, got none.")
    metres = inputs.metres_per_unit or 1.0
    field = GaussianField(inputs.gaussians, backend=inputs.backend)  # pyright: ignore[reportArgumentType]

    def depths() -> Iterator[DepthView]:
        return field_views(field, [view.camera for view in inputs.views])

    points = depth_points(
        depths(),
        min(options.voxels) / metres / _CELLS,
        max_depth=MAX_DEPTH / metres,
    )
    made = build_mesh_field(
        MeshFieldInputs(
            points=points,
            depths=depths(),
            views=inputs.views,
            evidence=inputs.evidence,
            classes=inputs.label_names,
            metres_per_unit=metres,
        ),
        options=options,
        seed=inputs.seed,
        progress=None if inputs.progress is None else _told(inputs.progress),
    )
    labels = made.field.labels_at(inputs.gaussians.means.detach().cpu(), made.field.layer_names[0])
    info = made.field.info
    undefined = int((labels.ids == UNLABELLED).sum())
    return Labels(
        ids=labels.ids,
        confidence=labels.confidence,
        background=_background(made.field, inputs.views),
        info=replace(info, details={**info.details, "undefined": undefined}),
    )


def _told(progress: Callable[[int, int], None]) -> Callable[[str, int, int], None]:
    def told(stage: str, done: int, total: int) -> None:
        share = done / max(total, 1)
        whole = _SHAPING * share if stage == "geometry" else _SHAPING + (_STEPS - _SHAPING) * share
        progress(round(whole), _STEPS)

    return told


def _background(field: MeshField, views: tuple[View, ...]) -> int:
    """What most pixels without a primitive show, in a few views; -1 where there are none."""
    seen: Counter[int] = Counter()
    for view in views[:: max(1, len(views) // _BACKGROUND_VIEWS)]:
        with field.view(view.camera) as looked_at:
            alpha = looked_at.signals(colour=False).alpha
            shown = looked_at.label_map(field.layer_names[0]).ids
        ids, counts = torch.unique(shown[alpha == 0], return_counts=True)
        seen.update(dict(zip(ids.tolist(), counts.tolist(), strict=True)))
    # Of equally frequent ones the smallest id.
    return min(seen, key=lambda id: (-seen[id], id), default=UNLABELLED)


METHOD = Method(
    name=METHOD_NAME,
    summary="primitives of a mesh learn colour and classes along rays; Gaussians take the label "
    "of the vertices around their centre",
    reference="DNMP with semantics (papers/002); Lu et al. (ICCV 2023)",
    evidence=("labels",),
    options=DnmpOptions,
    run=run,
    keeps_ids=True,
    seeded=True,
    published=PUBLISHED,
    published_differs=(
        "It differs: shapes are decoded by our own weights, surfaces come from scans or the depth "
        "of Gaussians instead of multi-view stereo, and labels are those at hand."
    ),
)


# Points that primitives are put at: of scans, of depth maps, of Gaussians.


_MIN_OPACITY = 0.5
_HELD = 2_000_000
"""Points that are held before they are thinned."""


class ThinnedCloud:
    """Points of many sources as one cloud, a point a cell: memory is that of the cells.

    The same points in the same portions give the same cloud.

    Args:
        cell: Side of a cell, scene units, positive.
    """

    def __init__(self, cell: float) -> None:
        if not cell > 0:
            raise RangeError(f"cell: expected a positive length, got {cell}.")
        self._cell = cell
        self._parts: list[Tensor] = []
        self._held = 0
        self._limit = _HELD

    def add(self, points: Float[Tensor, "n 3"]) -> None:
        """Take more points, world, scene units."""
        self._parts.append(thin(points, self._cell).centres)
        self._held += len(self._parts[-1])
        if self._held > self._limit:
            self._parts = [self._together()]
            self._held = len(self._parts[0])
            self._limit = max(_HELD, 2 * self._held)

    def points(self) -> Float[Tensor, "n 3"]:
        """The points so far, ordered by their cells, float64."""
        return self._together()

    def _together(self) -> Tensor:
        if not self._parts:
            return torch.zeros(0, 3, dtype=torch.float64)
        return thin(torch.cat(self._parts), self._cell).centres


@boundary
def scan_points(scans: ScanSource, cell: float) -> Float[Tensor, "n 3"]:
    """Points of all scans, thinned; scans are read one at a time.

    Args:
        scans: In the world of the views.
        cell: Side of the cells of which each gives one point, scene units.

    Raises:
        InputError: If a scan is broken.
    """
    cloud = ThinnedCloud(cell)
    for name in scans.scan_names:
        cloud.add(scans.scan(name).points)
    return cloud.points()


@boundary
def depth_points(
    depths: Iterable[DepthView], cell: float, *, max_depth: float
) -> Float[Tensor, "n 3"]:
    """Points of depth maps, thinned; maps are taken one at a time.

    Args:
        depths: Depth of views.
        cell: Side of the cells of which each gives one point, scene units.
        max_depth: z-depth above which no point is taken, scene units.
    """
    cloud = ThinnedCloud(cell)
    for view in depths:
        row, column = torch.nonzero((view.depth > 0) & (view.depth <= max_depth), as_tuple=True)
        pixels = torch.stack((column, row), dim=1).double() + 0.5
        cloud.add(view.camera.unproject(pixels, view.depth[row, column].double()))
    return cloud.points()


@boundary
def gaussian_points(gaussians: Gaussians, cell: float) -> Float[Tensor, "n 3"]:
    """Centres of the Gaussians that are at least half opaque, thinned.

    Args:
        gaussians: Of a scene.
        cell: Side of the cells of which each gives one point, scene units.
    """
    solid = gaussians.opacities.detach().cpu() >= _MIN_OPACITY
    cloud = ThinnedCloud(cell)
    cloud.add(gaussians.means.detach().cpu()[solid])
    return cloud.points()
