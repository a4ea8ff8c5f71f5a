"""Primitives to the depth of views (eq. 2)."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch

from splatseg._check import check_range
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.threads import one_torch_thread
from splatseg.errors import InputError, RangeError
from splatseg.street.geometry.depth_views import DepthRays, DepthView, collect_rays
from splatseg.street.geometry.inside import enclosing
from splatseg.street.geometry.level_fit import LevelFit
from splatseg.street.geometry.options import GeometryOptions
from splatseg.street.primitives import Primitives
from splatseg.street.shapes import ShapeAutoEncoder

_RECORDED = 100
"""Records of each level's fit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GeometryRecord:
    """How far the fit of one level is."""

    level: int
    """Level of the primitives, 0 the finest; levels are fitted one after the other."""

    step: int
    """Steps of this level that are done."""

    loss: float
    """Mean error of the depth of this step's rays, scene units (or as `GeometryOptions` has it)."""

    hit_share: float
    """Share of this step's rays that met a primitive of the level."""

    progress: float
    """Share of the whole fit that is done, in [0, 1]."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GeometryFit:
    """Primitives that were fitted to depth."""

    primitives: Primitives
    """With the shapes and centres that were found, those that were removed left out."""

    records: tuple[GeometryRecord, ...]
    """The loss on its way, about a hundred records a level."""

    rays: int
    """Rays with depth that were kept to fit to."""

    enclosing: int
    """Primitives that were removed because a camera stood inside."""

    carved: int
    """Primitives that were removed because they stood before measured surfaces."""

    def __post_init__(self) -> None:
        convert_fields(self)


@boundary
def fit_geometry(
    primitives: Primitives,
    shapes: ShapeAutoEncoder,
    depths: Iterable[DepthView],
    *,
    options: GeometryOptions | None = None,
    seed: int = 0,
    metres_per_unit: float = 1.0,
    progress: Callable[[GeometryRecord], None] | None = None,
) -> GeometryFit:
    """Fit shapes and centres of primitives to depth, each level by itself.

    The same arguments give the same bits, whatever the number of threads.

    Args:
        primitives: Where they start.
        shapes: The auto-encoder of their codes, which stays as it is.
        depths: Depth of views, read once, one at a time.
        options: How they are fitted.
        seed: Of the rays that are drawn, 0 or more.
        metres_per_unit: Length of a scene unit.
        progress: Told every record.

    Raises:
        InputError: If there are no primitives, no view has depth, a camera stands inside a
            primitive and primitives are not carved, or all of them would be removed.
        ShapeError: If codes have not the size of the shapes' codes.
        RangeError: If a depth is NaN.
    """
    options = GeometryOptions() if options is None else options
    if not len(primitives):
        raise InputError("primitives: expected at least one to fit, got none.")
    check_range("seed", seed, 0, 2**63 - 1)
    if not 0 < metres_per_unit < float("inf"):
        raise RangeError(f"metres_per_unit: expected a positive length, got {metres_per_unit:g}.")
    with one_torch_thread():
        rays = collect_rays(
            depths,
            max_rays=options.max_rays,
            max_depth=options.max_depth / metres_per_unit,
            generator=_generator(seed, 0),
        )
        around = enclosing(primitives.mesh(shapes), rays.origins)
        if bool(around.any()) and options.carve > 1:
            row = int(around.nonzero()[0])
            raise InputError(
                f"primitives: expected none around a camera, got primitive {row} (and "
                f"{int(around.sum()) - 1} more) with one inside; carving would remove it."
            )
        left = _left(primitives, ~around)
        fitted: list[Primitives] = []
        records: list[GeometryRecord] = []
        carved = 0
        levels = torch.unique(left.levels).tolist()
        for i, level in enumerate(levels):
            generator = _generator(seed, 1 + level)
            fit = LevelFit(left.subset(left.levels == level), shapes, options)
            for record in _records(fit, rays, options, generator):
                told = replace(record, level=level, progress=(i + record.progress) / len(levels))
                records.append(told)
                if progress is not None:
                    progress(told)
            found = fit.primitives()
            if options.carve <= 1:
                before = fit.before_surfaces(rays, generator)
                carved += int(before.sum())
                found = found.subset(~before)
            fitted.append(found)
    return GeometryFit(
        primitives=_joined(fitted),
        records=tuple(records),
        rays=len(rays),
        enclosing=int(around.sum()),
        carved=carved,
    )


def _generator(seed: int, stream: int) -> torch.Generator:
    """Random numbers of its own for what is independent of all else."""
    state = np.random.SeedSequence([seed, stream]).generate_state(1)
    return torch.Generator().manual_seed(int(state[0]))


def _records(
    fit: LevelFit, rays: DepthRays, options: GeometryOptions, generator: torch.Generator
) -> Iterable[GeometryRecord]:
    every = max(1, options.iterations // _RECORDED)
    for step, (loss, share) in enumerate(fit.steps(rays, generator), start=1):
        if step % every == 0 or step == options.iterations:
            yield GeometryRecord(
                level=0,
                step=step,
                loss=loss,
                hit_share=share,
                progress=step / options.iterations,
            )


def _left(primitives: Primitives, kept: torch.Tensor) -> Primitives:
    left = primitives.subset(kept)
    if not len(left):
        raise InputError(
            f"primitives: expected some without a camera inside, got {len(primitives)} that have."
        )
    return left


def _joined(parts: list[Primitives]) -> Primitives:
    joined = Primitives(
        codes=torch.cat([part.codes for part in parts]),
        centres=torch.cat([part.centres for part in parts]),
        scales=torch.cat([part.scales for part in parts]),
        levels=torch.cat([part.levels for part in parts]),
        sizes=parts[0].sizes,
    )
    if not len(joined):
        raise InputError("primitives: expected some on measured surfaces, got all before them.")
    return joined
