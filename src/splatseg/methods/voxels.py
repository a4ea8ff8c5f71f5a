"""Open-vocabulary sparse voxels: features of pixels onto the voxels that their rays hit.

Gaussians that stand for surfaces make a sparse grid of a number of cells, which are solved for
together from the features of all views, or are the means of what first hits them, as published, and
every Gaussian reads the nearest cell; words are asked of the cells (`splatseg query`).
"""

from dataclasses import asdict, dataclass, field, replace
from typing import Literal

from splatseg._check import check_choice
from splatseg.core import LEARNED_BYTES, LayerInfo, StoredPrecision, VoxelFeatures
from splatseg.core.boundary import convert_fields
from splatseg.core.voxels import VoxelGrid
from splatseg.errors import InputError, RangeError
from splatseg.lift.voxels import (
    AssignmentOptions,
    FilterOptions,
    HitOptions,
    assign_voxels,
    lift_to_voxels,
    optical_depths,
    store,
    surface_gaussians,
    surface_points,
    voxelise,
    voxelise_to_count,
)
from splatseg.methods._method import Method, MethodInputs

_CELLS_A_HIT = 3
"""Cells that depth lies in for one that is kept and that a ray hits first, about."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VoxelOptions:
    """How features become voxels."""

    voxels: int = 80_000
    """Cells, about, which is what their size is found for; of centres at most."""

    cell: float | None = None
    """Side of a cell, scene units; the number of cells follows. None takes `voxels`."""

    cells: Literal["centres", "depth"] = "centres"
    """Of what cells are made. centres: of the centres of Gaussians. depth: of the points where the
    light of pixels is half stopped, so that no ray passes between them."""

    min_points: int = 6
    """Pixels of all views, every second along both axes, that must end in a cell of depth: those of
    few lie between things, where depth jumps, and hide what is behind them."""

    filtering: FilterOptions = field(default_factory=FilterOptions)
    """Which Gaussians make cells, where their centres do."""

    projection: HitOptions = field(default_factory=lambda: HitOptions(hits="solved"))
    """Which cells a pixel's feature goes to."""

    assignment: AssignmentOptions = field(default_factory=AssignmentOptions)
    """Which cells a Gaussian reads."""

    precision: StoredPrecision = "float16"
    """How features are kept: 4, 2 or 1 bytes a channel, or with product a byte for each part."""

    parts: int = 64
    """With product: bytes of a voxel, at most."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_choice("cells", self.cells, ("centres", "depth"))
        if self.min_points < 1:
            raise RangeError(f"min_points: expected at least 1, got {self.min_points}.")
        if self.voxels < 1:
            raise RangeError(f"voxels: expected at least 1, got {self.voxels}.")
        if self.cell is not None and not 0 < self.cell < float("inf"):
            raise RangeError(f"cell: expected above 0, got {self.cell}.")
        if self.parts < 1:
            raise RangeError(f"parts: expected at least 1, got {self.parts}.")


PUBLISHED = VoxelOptions(
    cell=0.04,
    filtering=FilterOptions(
        opaque_share=0.5,
        min_opacity=None,
        max_elongation=None,
        scale_share=None,
        min_neighbours=4,
        radius=0.2,
    ),
    projection=HitOptions(hits="first"),
    precision="float32",
)
"""First hits, means over hits, the nearest voxel however far (sections 3.2, 3.4, 3.5.2); what the
paper leaves open as its code has it: half of the Gaussians by opacity, and four others within 0.2,
and cells of 0.04, in scenes whose unit is a metre."""


def run(inputs: MethodInputs, options: VoxelOptions) -> VoxelFeatures:
    """Lift feature maps onto voxels.

    Returns:
        The voxels that were hit, and for each Gaussian those that it reads.

    Raises:
        InputError: If no voxel is hit, or no Gaussian stands for a surface.
    """
    gaussians = inputs.gaussians
    means = gaussians.means.detach().cpu()
    grid = _grid(inputs, options)
    projection = options.projection
    nearest = None
    if projection.hits != "first":
        one = replace(options.assignment, interpolation="nearest")
        nearest = assign_voxels(grid, means, options=one).rows[:, 0].long()
    depths_of = nearest if projection.hits == "several" else None
    lifted = lift_to_voxels(
        grid,
        inputs.views,
        inputs.evidence,  # pyright: ignore[reportArgumentType]  (of the kind that it takes)
        options=projection,
        depths=None if depths_of is None else optical_depths(grid, gaussians, depths_of),
        gaussians=gaussians,
        rows=nearest,
        backend=inputs.backend,
        progress=inputs.progress,
    )
    hit = lifted.totals > 0
    if not bool(hit.any()):
        raise InputError(
            f"evidence: expected views whose rays hit voxels, none of {len(grid)} was hit."
        )
    table = store(
        lifted.values[hit], precision=options.precision, parts=options.parts, seed=inputs.seed
    )
    read = assign_voxels(grid[hit], means, options=options.assignment)
    several = read.rows.shape[1] > 1
    return VoxelFeatures(
        grid=grid[hit],
        table=table,
        weights=lifted.totals[hit].float(),
        rows=read.rows,
        shares=read.shares if several else None,
        info=LayerInfo(
            method="voxels",
            options=asdict(options),
            views=tuple(sorted(view.name for view in inputs.views)),
            details={
                "voxels": len(grid),
                "hit": int(hit.sum()),
                "cell": grid.size,
                "without_voxel": int((read.shares.sum(dim=1) <= 0).sum()),
                LEARNED_BYTES: table.nbytes + read.rows.nbytes,
            },
        ),
    )


def _grid(inputs: MethodInputs, options: VoxelOptions) -> VoxelGrid:
    """Cells of the size, or as many as are asked for."""
    gaussians = inputs.gaussians
    if options.cells == "centres":
        kept = surface_gaussians(gaussians, options=options.filtering)
        points = gaussians.means.detach().cpu()[kept]
        if options.cell is None:
            return voxelise_to_count(points, options.voxels)
        return voxelise(points, options.cell)
    points = surface_points(gaussians, inputs.views, backend=inputs.backend)
    size = options.cell
    if size is None:
        size = voxelise_to_count(points, _CELLS_A_HIT * options.voxels).size
    return voxelise(points, size, min_points=options.min_points)


METHOD = Method(
    name="voxels",
    summary="sparse voxels are solved for from the features of the pixels that show them",
    reference="Open-vocabulary semantic novel view synthesis, sections 3.2 to 3.5",
    evidence=("features",),
    options=VoxelOptions,
    run=run,
    returns="features",
    seeded=True,
    published=PUBLISHED,
    published_differs=(
        "It differs: features are those at hand, not LSeg's; Gaussians are filtered by opacity and "
        "density alone, as the published code does, and not by scale."
    ),
    words="span",
    published_words="cosines",
    complete=False,
)
