"""A capture in blocks: cells of its plan, each fitted by itself, then refined among its neighbours.

The plan of the training cameras, seen along the capture's up axis, is halved again and again
between cameras, so that cells have equally many (VastGaussian, Lin et al. 2024, section 4.1;
CityGaussian, Liu et al. 2024), and there where least is seen from the other side, in a wall. The
outermost cells have no end: each point is in one cell.

A block is more than its cell. Its views are those that stand in its cell, which know that the
air in it is empty, and those that show enough of it. What they show is told by the blending
weights of Gaussians at the start points, so that walls hide what is behind them. Its start points
are those of its region, the cell with half an overlap around it, and those that its views see:
what is beyond would otherwise be fitted by floaters in front. Of its Gaussians only those of its
cell are kept (`fit._joining`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Bool, Float, Int
from msgspec import Meta
from torch import Tensor

from splatseg.core import Capture, Gaussians, PointCloud, View
from splatseg.core.boundary import boundary
from splatseg.core.partition import Cells, Gap, cut_plan
from splatseg.errors import InputError
from splatseg.fit._options import FitOptions
from splatseg.fit._parameters import final_gaussians
from splatseg.fit._start import initial_parameters
from splatseg.render import prepare

BlockCount = Literal["auto"] | Annotated[int, Meta(ge=1)]
"""How many blocks: a number, or as many as the capture's size asks for."""

_VIEWS, _GAUSSIANS = 150, 1_000_000
"""Of a block, at most, where their number is chosen: training views that stand in its cell, and its
part of `FitOptions.max_gaussians`."""

_MIN_SHARE = 0.25
"""Share of what a view shows that lies in the cell of a block, for it to be a view of it:
as VastGaussian has it of the area."""

_LITTLE_SHARE = 0.02
"""The same for views that a block is refined with among its neighbours. On a generated building of
four rooms a quarter leaves the surfaces at borders 1 dB worse, a tenth of this makes no difference
but of cost."""

_MINUTES = 0.75
"""Part of `FitOptions.minutes` that is left for the fits of blocks: views of the refinement are up
to half as many again, and its steps have all Gaussians."""

_MIN_WEIGHT = 0.5
"""Pixels of a reduced view that a start point must fill, for it to be one of those seen."""

_BY_VIEWS = ("steps", "densify_every", "densify_from", "reset_every")
"""Options that count steps."""

_LONGEST = 128
"""Longest side of the views that tell what is seen, pixels."""

_OPACITY = 0.95
_POINTS = 200_000
"""Start points by which it is told, at most."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CaptureBlock:
    """One block of a capture, and how it is fitted."""

    index: int
    capture: Capture
    """Its training views and its start points."""

    border_views: tuple[View, ...]
    """Training views that show at least a little of it: it is refined with them among its
    neighbours."""

    options: FitOptions
    """Its part of the steps and of the Gaussians."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CaptureBlocks:
    """A capture in blocks: `cut_capture`."""

    cells: Cells
    blocks: tuple[CaptureBlock, ...]
    capture: Capture
    """All of it."""

    options: FitOptions
    """Of all blocks together."""

    def __len__(self) -> int:
        return len(self.blocks)

    def record(self) -> dict[str, Any]:
        """What a scene remembers of it, in values that JSON holds."""
        views = [[view.name for view in block.capture.views] for block in self.blocks]
        return {**self.cells.record(), "views": views}


@boundary
def cut_capture(
    capture: Capture,
    count: BlockCount = "auto",
    *,
    options: FitOptions = FitOptions(),
    backend: str = "auto",
) -> CaptureBlocks:
    """Cut a capture into blocks that are fitted one by one.

    A block's part of the steps is that of its views among all of the capture, so that each
    view is learned from as often as in one fit; what several blocks learn from comes on top.
    Intervals of density control and Adam's bias correction follow it: each Gaussian is optimised
    as in one fit. Minutes are shared by the same numbers; a quarter is left for the refinement of
    the joined blocks. A block's part of the Gaussians is that of its start points: those of other
    cells come on top, and are left out when blocks are joined.

    Args:
        capture: With start points.
        count: How many blocks; ``auto`` has at most 150 training views and a million Gaussians in
            a cell.
        options: Of all blocks together.
        backend: Name of the renderer that tells what views see.

    Raises:
        InputError: If the capture has no training photographs or start points, fewer cameras at
            different places than blocks, or options cannot be used with blocks.
    """
    _check_options(options)
    views = tuple(view for view in capture.train_views if view.image is not None)
    if not views:
        raise InputError(f"{capture.path}: expected training views with photographs, got none.")
    points = capture.points
    if points is None or not len(points):
        raise InputError(
            f"{capture.path}: expected a capture with start points, by which blocks are cut, got "
            "one without."
        )
    if count == "auto":
        wanted = max(len(views) / _VIEWS, options.max_gaussians / _GAUSSIANS)
        count = min(math.ceil(wanted), len(views))
    if count > len(views):
        raise InputError(
            f"blocks: expected at most as many as training views with photographs, {len(views)}, "
            f"got {count}."
        )
    centres = torch.stack([view.camera.centre for view in views]).double()
    sight = _Sight.of(capture, views, options=options, backend=backend)
    cells = cut_plan(centres, count, up=capture.up, border=sight.border)
    shares = sight.shares(cells)
    at = torch.nn.functional.one_hot(cells.cell_of(centres), count).bool()
    of_view, little = ((at | (shares >= least)).T for least in (_MIN_SHARE, _LITTLE_SHARE))
    of_point = sight.points_of(of_view, cells, points.points)
    counts = of_view.sum(dim=1)
    blocks: list[CaptureBlock] = []
    for i in range(count):
        rows = of_point[i]
        colours = None if points.colours is None else points.colours[rows]
        part = replace(
            capture,
            views=_some(views, of_view[i]),
            points=replace(points, points=points.points[rows], colours=colours),
        )
        of_views = float(counts[i]) / len(views)
        of_points = float(rows.sum()) / len(points)
        minutes = options.minutes
        if minutes is not None:
            minutes *= _MINUTES ** (count > 1) * float(counts[i]) / float(counts.sum())
        mine = replace(
            options,
            minutes=minutes,
            **{name: _part(getattr(options, name), of_views) for name in _BY_VIEWS},
            max_gaussians=_part(options.max_gaussians, of_points),
            bias_correction_steps=options.bias_correction_steps / of_views,
        )
        near = _some(views, little[i])
        blocks.append(CaptureBlock(index=i, capture=part, border_views=near, options=mine))
    return CaptureBlocks(cells=cells, blocks=tuple(blocks), capture=capture, options=options)


def _some(views: Sequence[View], which: Bool[Tensor, "v"]) -> tuple[View, ...]:
    return tuple(view for view, is_one in zip(views, which.tolist(), strict=True) if is_one)


def _check_options(options: FitOptions) -> None:
    """Refuse what blocks would each decide in their own way."""
    for name in ("exposure", "refine_poses"):
        if getattr(options, name):
            raise InputError(f"{name}: expected none with blocks, which would not agree.")
    if options.strategy == "fixed":
        raise InputError("strategy: expected mcmc or classic with blocks, got fixed.")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Sight:
    """Which start points views see, one row a pair."""

    count: int
    """Of the views."""

    views: Int[Tensor, "m"]
    points: Int[Tensor, "m"]
    weights: Float[Tensor, "m"]
    """Pixels of the reduced view that the point fills."""

    told: Int[Tensor, "p"]
    """Rows of the start points that are asked about."""

    places: Float[Tensor, "p 3"]
    """Where these are, float64."""

    @classmethod
    def of(
        cls, capture: Capture, views: Sequence[View], *, options: FitOptions, backend: str
    ) -> "_Sight":
        """What the views see of the capture's start points."""
        points = torch.zeros(0, 3) if capture.points is None else capture.points.points
        told = torch.arange(0, len(points), max(1, math.ceil(len(points) / _POINTS)))
        some = replace(capture, views=tuple(views), points=PointCloud(points=points[told]))
        shown = _opaque_points(some, options)
        rows: list[Tensor] = []
        weights: list[Tensor] = []
        for view in views:
            found = _visibility(shown, view, backend)
            rows.append(torch.nonzero(found > 0).squeeze(1))
            weights.append(found[rows[-1]])
        numbers = torch.repeat_interleave(torch.tensor([len(row) for row in rows]))
        return cls(
            count=len(views),
            views=numbers,
            points=torch.cat(rows),
            weights=torch.cat(weights),
            told=told,
            places=points[told].double(),
        )

    def border(self, gap: Gap) -> float:
        """Where the least of what cameras see is on the other side: in a wall between rooms."""
        side = torch.zeros(self.count).double()
        side[gap.before], side[gap.behind] = -1.0, 1.0
        mass = torch.zeros(len(self.places)).double()
        mass.index_add_(0, self.points, self.weights.double() * side[self.views])
        along = self.places @ gap.direction
        inside = torch.nonzero((along > gap.first) & (along < gap.last)).squeeze(1)
        inside = inside[along[inside].argsort(stable=True)]
        ends = along[inside]
        ends = torch.cat((ends.new_tensor([gap.first]), ends, ends.new_tensor([gap.last])))
        middles = (ends[1:] + ends[:-1]) / 2
        misplaced = torch.cat((mass.new_zeros(1), mass[inside].cumsum(0)))
        best = misplaced <= misplaced.min() + 1e-9 * float(mass.abs().sum())
        off = (middles - (gap.first + gap.last) / 2).abs()
        return float(middles[int(torch.where(best, off, math.inf).argmin())])

    def shares(self, cells: Cells) -> Float[Tensor, "v b"]:
        """Share of what each view shows that lies in each cell."""
        found = torch.zeros(self.count, len(cells))
        cell = cells.cell_of(self.places)[self.points]
        found.index_put_((self.views, cell), self.weights, accumulate=True)
        return found / found.sum(dim=1, keepdim=True).clamp_min(1e-9)

    def points_of(
        self, of_view: Bool[Tensor, "b v"], cells: Cells, points: Float[Tensor, "n 3"]
    ) -> Bool[Tensor, "b n"]:
        """Which start points each block has, whose views are given."""
        of_point = cells.regions(points)
        clear = self.weights >= _MIN_WEIGHT
        for block, own in enumerate(of_view):
            seen = self.points[clear & own[self.views]]
            of_point[block, self.told[seen]] = True
        return of_point


def _opaque_points(capture: Capture, options: FitOptions) -> Gaussians:
    """Start points as blobs so large that those of a surface leave no gaps."""
    count = 0 if capture.points is None else len(capture.points)
    plain = replace(options, sh_degree=0, max_gaussians=max(1, count))
    start = initial_parameters(capture, options=plain, generator=torch.Generator())
    blobs = final_gaussians(start)
    return blobs.replace(opacities=torch.full_like(blobs.opacities, _OPACITY))


def _visibility(shown: Gaussians, view: View, backend: str) -> Float[Tensor, "n"]:
    """Pixels of the reduced view that each Gaussian fills, hidden ones none."""
    camera = view.camera
    factor = min(1.0, _LONGEST / max(camera.width, camera.height))
    width, height = (max(1, round(factor * side)) for side in (camera.width, camera.height))
    camera = camera.resized(width, height)
    with torch.no_grad(), prepare(shown, camera, backend=backend) as prepared:
        return prepared.back_project(torch.ones(height, width, 1)).weights.cpu()


def _part(value: int | None, share: float) -> int | None:
    """A part of a whole number, at least 1."""
    return None if value is None else max(1, round(value * share))
