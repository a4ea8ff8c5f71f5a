"""Open-vocabulary sparse voxels: features of pixels onto the voxels that show them.

Gaussians that stand for surfaces make a sparse grid of a number of cells (`grid`), which are solved
for together from the features of all views, or are the means of what first hits them, as published
(`lifting`); every Gaussian reads the nearest cell, and words are asked of the cells (`words`).
"""

from dataclasses import asdict

from splatseg.core import LEARNED_BYTES, LayerInfo, StoredPrecision, VoxelFeatures
from splatseg.core.options import Count, Positive, options
from splatseg.errors import InputError
from splatseg.methods._method import Method, MethodInputs
from splatseg.methods.voxels.grid import (
    Filter,
    nearest_voxels,
    surface_gaussians,
    voxelise,
    voxelise_to_count,
)
from splatseg.methods.voxels.lifting import HitRule, lift_to_voxels
from splatseg.methods.voxels.words import store

_CENTRES = "cells are made of the centres of Gaussians; those of depth gave the same"
_FILTER = "`filter` has the two rules that are used"
_FIXED = "it is fixed at the value that was best"


@options(
    removed={
        "cells": _CENTRES,
        "min_points": _CENTRES,
        "filtering": _FILTER,
        **dict.fromkeys(
            ("opaque_share", "min_opacity", "max_elongation", "scale_share", "min_neighbours"),
            _FILTER,
        ),
        "radius": _FILTER,
        "projection": "give `hits` itself",
        "max_hits": "several hits of a ray were no better",
        "average": "means of views were worse than means of hits",
        **dict.fromkeys(("blur", "smoothness", "near", "far"), _FIXED),
        "assignment": "a Gaussian reads the nearest voxel",
        "interpolation": "a Gaussian reads the nearest voxel; eight gave the same",
        "max_distance": "a Gaussian reads the nearest voxel however far it is, which was better",
        "parts": "a voxel of precision product takes at most 64 bytes",
    }
)
class VoxelOptions:
    """How features become voxels."""

    voxels: Count = 80_000
    """Number of cells, about; the size of a cell follows."""

    cell: Positive | None = None
    """Side of a cell, scene units; the number of cells follows. None takes `voxels`."""

    filter: Filter = "surfaces"
    """Gaussians whose centres make cells. surfaces: neither needles nor faint, nor floating alone.
    opaque: the more opaque half with four others within 0.2 scene units, as published."""

    hits: HitRule = "solved"
    """Which cells a pixel's feature goes to. first: the first one that the ray hits, as published.
    solved: all cells are solved for together, with neighbours of the same colour alike."""

    precision: StoredPrecision = "float16"
    """How features are stored: 4, 2 or 1 bytes a channel; product takes 64 bytes a cell at most."""


PUBLISHED = VoxelOptions(cell=0.04, filter="opaque", hits="first", precision="float32")
"""First hits, means over hits, the nearest voxel however far (sections 3.2, 3.4, 3.5.2); what the
paper leaves open as its code has it: half of the Gaussians by opacity, and four others within 0.2,
and cells of 0.04, in scenes whose unit is a metre."""


def run(inputs: MethodInputs, options: VoxelOptions) -> VoxelFeatures:
    """Lift feature maps onto voxels.

    Returns:
        The voxels that were hit, and for each Gaussian the one that it reads.

    Raises:
        InputError: If no voxel is hit, or no Gaussian stands for a surface.
    """
    gaussians = inputs.gaussians
    means = gaussians.means.detach().cpu()
    points = means[surface_gaussians(gaussians, rule=options.filter)]
    if options.cell is None:
        grid = voxelise_to_count(points, options.voxels)
    else:
        grid = voxelise(points, options.cell)
    lifted = lift_to_voxels(
        grid,
        inputs.views,
        inputs.evidence,  # pyright: ignore[reportArgumentType]  (of the kind that it takes)
        gaussians,
        hits=options.hits,
        backend=inputs.backend,
        progress=inputs.progress,
    )
    hit = lifted.totals > 0
    if not bool(hit.any()):
        raise InputError(
            f"evidence: expected views whose rays hit voxels, none of {len(grid)} was hit."
        )
    table = store(lifted.values[hit], precision=options.precision, seed=inputs.seed)
    rows = nearest_voxels(grid[hit], means).int()[:, None]
    return VoxelFeatures(
        grid=grid[hit],
        table=table,
        weights=lifted.totals[hit].float(),
        rows=rows,
        info=LayerInfo(
            method="voxels",
            options=asdict(options),
            views=tuple(sorted(view.name for view in inputs.views)),
            details={
                "voxels": len(grid),
                "hit": int(hit.sum()),
                "cell": grid.size,
                LEARNED_BYTES: table.nbytes + rows.nbytes,
            },
        ),
    )


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
