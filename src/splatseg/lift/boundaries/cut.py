r"""Cuts: Gaussians that reach over a boundary are split, so that each side can go its own way.

A boundary is that of masks in the photographs (`cut_masks` for some ids, `cut_labels` for a
whole layer) or a box in the world (`cut_box`). A Gaussian straddles it if its lesser side has
at least `CutOptions.min_side`: of the evidence that masks give, or of the Gaussian's mass
beyond a plane. It is split in the direction that separates the two sides best (`_sides`,
`split`), its parts are held against the same boundary, and those that still straddle are split
again, for a few rounds.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg._check import check_range
from splatseg.core import (
    UNLABELLED,
    Camera,
    Edited,
    Gaussians,
    LabelMap,
    Labels,
    LabelSource,
    Selection,
    View,
    apply_rows,
)
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.lift.boundaries.geometry import (
    axes_of,
    directions_of_normals,
    seen_along,
    unit_or_main,
)
from splatseg.lift.boundaries.mixture import MIXTURES
from splatseg.lift.boundaries.sides import Sides, sides_of
from splatseg.lift.boundaries.split import split_along
from splatseg.render import RenderOptions, options_for

INSIDE, OUTSIDE = 1, 2


@dataclass(frozen=True, slots=True, kw_only=True)
class CutOptions:
    """Which Gaussians are split at a cut, and how."""

    parts: int = 3
    """Parts that a Gaussian is split into, 2 or 3."""

    rounds: int = 2
    """How often what still straddles is split again; 0 splits nothing."""

    min_side: float = 0.1
    """Least share, in [0, 0.5], of the lesser side for a Gaussian to straddle the cut."""

    min_pixels: float = 0.5
    """Least standard deviation, pixels, that a Gaussian must have across the cut in some view;
    smaller ones are not split. 0 splits all."""

    min_weight: float = 0.5
    """Least evidence that a Gaussian must have to be split at a mask, in pixels that show it
    fully, summed over views."""

    border_weight: float = 0.1
    """What a pixel at the border of a mask counts, in [0, 1]: it shows both sides."""

    keep_share: float = 0.5
    """Share of its evidence, in [0, 1], that must lie inside for a Gaussian to count as inside.
    Less takes more of what is near the boundary."""

    def __post_init__(self) -> None:
        if self.parts not in MIXTURES:
            known = ", ".join(map(str, MIXTURES))
            raise RangeError(f"parts: expected one of {known}, got {self.parts}.")
        if self.rounds < 0:
            raise RangeError(f"rounds: expected 0 or more, got {self.rounds}.")
        check_range("min_side", self.min_side, 0.0, 0.5)
        check_range("border_weight", self.border_weight, 0.0, 1.0)
        check_range("keep_share", self.keep_share, 0.0, 1.0)
        for name in ("min_pixels", "min_weight"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise RangeError(f"{name}: expected 0 or more, got {value}.")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cut:
    """Gaussians that were split at a boundary, and which of them are inside."""

    edited: Edited
    """The Gaussians after the splits; rows lead each part to what it is a part of."""

    share: Float[Tensor, "n"]
    """How much of each lies inside, in [0, 1]; 0 where nothing is known of it."""

    known: Float[Tensor, "n"]
    """How much that rests on: evidence in fully visible pixels, or 1 for a box."""

    inside: Selection
    """Those that count as inside."""

    split: int
    """How many Gaussians of before were split."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _TwoSides:
    """Label maps in which some ids are INSIDE and all others OUTSIDE."""

    evidence: LabelSource
    ids: tuple[int, ...]

    @property
    def view_names(self) -> Sequence[str]:
        return self.evidence.view_names

    def label_map(self, name: str) -> LabelMap:
        paper = self.evidence.label_map(name)
        inside = torch.isin(paper.ids, torch.tensor(self.ids, dtype=paper.ids.dtype))
        sides = torch.where(inside, INSIDE, OUTSIDE)
        return replace(paper, ids=torch.where(paper.ids == UNLABELLED, UNLABELLED, sides).int())


def cut_masks(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: LabelSource,
    ids: Sequence[int],
    *,
    options: CutOptions | None = None,
    render_options: RenderOptions | None = None,
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> Cut:
    """Split what straddles the boundary between the pixels of some ids and all others.

    Args:
        gaussians: The Gaussians of the scene.
        views: Those that vote, best all that the layer was lifted from.
        evidence: Label maps of them; pixels at -1 say nothing.
        ids: The ids that are inside.
        options: Which are split, and how.
        render_options: Switches of the blending model.
        backend: Who renders.
        progress: Called with the views done and all there are to do.

    Returns:
        The cut. A Gaussian is inside where its share of the evidence is more than
        `CutOptions.keep_share`.

    Raises:
        InputError: If there are no views or ids, or no view shows any of the ids.
    """
    options = options or CutOptions()
    _check_views(views, evidence)
    if not ids:
        raise InputError("ids: expected at least one, got none.")
    maps = _TwoSides(evidence=evidence, ids=tuple(int(i) for i in ids))

    def look(now: Gaussians, step: Callable[[], None]) -> Sides:
        ones = torch.ones(len(now), dtype=torch.int32)
        return sides_of(
            now,
            views,
            maps,
            ones * INSIDE,
            ones * OUTSIDE,
            border_weight=options.border_weight,
            options=render_options or options_for(now, backend),
            backend=backend,
            step=step,
        )

    edited, sides, count = _in_rounds(gaussians, views, look, options, progress)
    if not bool((sides.inside > 0).any()):
        shown = ", ".join(map(str, ids))
        raise InputError(f"ids: none of {len(views)} views shows a Gaussian with id {shown}.")
    return Cut(
        edited=edited,
        share=sides.share,
        known=sides.inside + sides.outside,
        inside=Selection(mask=sides.share > options.keep_share),
        split=count,
    )


def cut_labels(
    gaussians: Gaussians,
    labels: Labels,
    views: Sequence[View],
    evidence: LabelSource,
    *,
    options: CutOptions | None = None,
    render_options: RenderOptions | None = None,
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Edited, Labels]:
    """Split what straddles any boundary of a layer: every object's at once.

    A Gaussian stands between its two strongest candidates. Its parts get the one of the two
    that they show more of, with its share; Gaussians that are not split keep what they had.

    Args:
        gaussians: The Gaussians of the scene.
        labels: A layer with at least two candidates (`UpliftOptions.candidates`).
        views: Those that vote.
        evidence: Label maps of them, the ones that the layer was lifted from.
        options: Which are split, and how.
        render_options: Switches of the blending model.
        backend: Who renders.
        progress: Called with the views done and all there are to do.

    Returns:
        The edit, and the layer in step with it.

    Raises:
        ShapeError: If the layer is of other Gaussians.
        InputError: If the layer has no two candidates, or there are no views.
    """
    options = options or CutOptions()
    _check_views(views, evidence)
    if len(labels) != len(gaussians):
        raise ShapeError(f"labels: expected {len(gaussians)} rows, got {len(labels)}.")
    candidates, shares = labels.candidates, labels.shares
    if candidates is None or shares is None or candidates.shape[1] < 2:
        raise InputError("labels: expected a layer with two candidates a Gaussian or more.")
    rows = torch.arange(len(gaussians))
    edited, now = Edited.unchanged(gaussians), labels
    total = (options.rounds + 1) * len(views)
    done = 0

    def step() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    for turn in range(options.rounds + 1):
        first, second = candidates[rows, 0], candidates[rows, 1]
        sides = sides_of(
            edited.gaussians,
            views,
            evidence,
            first,
            second,
            border_weight=options.border_weight,
            options=render_options or options_for(gaussians, backend),
            backend=backend,
            step=step,
        )
        now = _relabelled(now, sides, first, second, edited)
        if turn == options.rounds:
            break
        straddling = _straddling(edited.gaussians, sides, views, options)
        if not straddling.count:
            break
        later = _split(edited.gaussians, straddling, sides, views, options)
        edited, now = edited.then(later), apply_rows(now, later)
        rows = edited.rows
    return edited, now


def _relabelled(
    labels: Labels, sides: Sides, first: Tensor, second: Tensor, edited: Edited
) -> Labels:
    """The layer with what the pixels say of parts: of rows whose fraction is below 1."""
    if edited.fractions is None or labels.candidates is None or labels.shares is None:
        return labels
    seen = sides.inside + sides.outside + sides.other
    part = (edited.fractions < 1) & (seen > 0)
    shares = torch.stack((sides.inside, sides.outside), 1) / seen.clamp_min(1e-9)[:, None]
    ids = torch.stack((first, second), dim=1)
    order = torch.argsort(shares, dim=1, descending=True, stable=True)
    ids, shares = ids.gather(1, order), shares.gather(1, order)
    width = labels.candidates.shape[1]
    padded_ids = torch.full_like(labels.candidates, UNLABELLED)
    padded_ids[:, :2] = ids.to(padded_ids)
    padded = torch.zeros_like(labels.shares)
    padded[:, :2] = shares.to(padded)
    padded_ids[padded == 0] = UNLABELLED
    mask = part.unsqueeze(1).expand(-1, width)
    return replace(
        labels,
        ids=torch.where(part, padded_ids[:, 0], labels.ids),
        confidence=torch.where(part, padded[:, 0], labels.confidence),
        candidates=torch.where(mask, padded_ids, labels.candidates),
        shares=torch.where(mask, padded, labels.shares),
        evidence=None if labels.evidence is None else torch.where(part, seen, labels.evidence),
        inferred=None if labels.inferred is None else labels.inferred & ~part,
    )


def cut_box(
    gaussians: Gaussians,
    low: Sequence[float],
    high: Sequence[float],
    *,
    among: Selection | None = None,
    options: CutOptions | None = None,
    cameras: Sequence[Camera] = (),
) -> Cut:
    r"""Split what straddles a face of a box whose sides are along the world's axes.

    A Gaussian's mass beyond a plane at a distance of t of its standard deviations along the
    plane's normal is :math:`\Phi(-|t|)`; the face where its lesser side is largest is the one
    it is split at, as long as it reaches that face itself.

    Args:
        gaussians: The Gaussians of the scene.
        low: Least x, y and z inside, scene units.
        high: Largest x, y and z inside.
        among: Only these are split; None is all.
        options: Which are split, and how.
        cameras: Those that the picture matters to and that sizes in pixels are of; without
            any, size does not count.

    Returns:
        The cut. A Gaussian is inside where its centre is.

    Raises:
        RangeError: If the box is empty or not finite.
        ShapeError: If `among` is of other Gaussians.
    """
    options = options or CutOptions()
    if among is not None and len(among) != len(gaussians):
        raise ShapeError(f"among: expected {len(gaussians)} rows, got {len(among)}.")
    lower, upper = box_corners(low, high)
    edited = Edited.unchanged(gaussians)
    first = torch.zeros(len(gaussians), dtype=torch.bool)
    for turn in range(options.rounds):
        now = edited.gaussians
        mass, normals = _nearest_face(now, lower, upper)
        directions = directions_of_normals(now, normals)
        large = seen_along(now, directions, cameras).pixels >= options.min_pixels
        mask = (mass >= max(options.min_side, 1e-6)) & large & (now.scales.amax(dim=1) > 0)
        straddling = Selection(mask=mask if among is None else mask & among.mask[edited.rows])
        if turn == 0:
            first = straddling.mask
        if not straddling.count:
            break
        later = split_along(
            now, straddling, directions[straddling.mask], parts=options.parts, cameras=cameras
        )
        edited = edited.then(later)
    centres = edited.gaussians.means.double()
    inside = ((centres >= lower) & (centres <= upper)).all(dim=1)
    return Cut(
        edited=edited,
        share=inside.float(),
        known=torch.ones(len(edited)),
        inside=Selection(mask=inside),
        split=int(first.sum()),
    )


def box_corners(low: Sequence[float], high: Sequence[float]) -> tuple[Tensor, Tensor]:
    """Corners of a box as float64, after a check that there is something between them."""
    lower = torch.tensor([float(v) for v in low], dtype=torch.float64)
    upper = torch.tensor([float(v) for v in high], dtype=torch.float64)
    if lower.shape != (3,) or upper.shape != (3,):
        raise ShapeError(f"box: expected two points, got {len(lower)} and {len(upper)} numbers.")
    if not bool(torch.isfinite(lower).all() and torch.isfinite(upper).all()):
        raise RangeError(f"box: expected finite numbers, got {lower.tolist()}, {upper.tolist()}.")
    if not bool((lower < upper).all()):
        raise RangeError(
            "box: expected a first corner below the second along every axis, got "
            f"{lower.tolist()} and {upper.tolist()}."
        )
    return lower, upper


def _nearest_face(gaussians: Gaussians, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Mass of the lesser side at the face that cuts most, and the normal of that face."""
    means = gaussians.means.double()
    deviations = axes_of(gaussians).pow(2).sum(dim=2).sqrt().clamp_min(1e-30)
    below, above = (means - low) / deviations, (high - means) / deviations
    # How much of the mass lies between the two faces of each axis.
    within = torch.special.ndtr(below) + torch.special.ndtr(above) - 1
    best = torch.zeros(len(gaussians), dtype=torch.float64)
    axis_of = torch.zeros(len(gaussians), dtype=torch.int64)
    for axis in range(3):
        others = [other for other in range(3) if other != axis]
        reach = within[:, others].prod(dim=1).clamp_min(0)
        for t in (below[:, axis], above[:, axis]):
            # The face is only as large as the box: what passes beside it is not cut.
            mass = torch.special.ndtr(-t.abs()) * reach
            better = mass > best
            best = torch.where(better, mass, best)
            axis_of = torch.where(better, axis, axis_of)
    return best, torch.nn.functional.one_hot(axis_of, 3).double()


def _in_rounds(
    gaussians: Gaussians,
    views: Sequence[View],
    look: Callable[[Gaussians, Callable[[], None]], Sides],
    options: CutOptions,
    progress: Callable[[int, int], None] | None,
) -> tuple[Edited, Sides, int]:
    """Look, split, look again; ends with a look."""
    edited, count, done = Edited.unchanged(gaussians), 0, 0
    total = (options.rounds + 1) * len(views)

    def step() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    for turn in range(options.rounds):
        sides = look(edited.gaussians, step)
        straddling = _straddling(edited.gaussians, sides, views, options)
        if turn == 0:
            count = straddling.count
        if not straddling.count:
            return edited, sides, count
        edited = edited.then(_split(edited.gaussians, straddling, sides, views, options))
    return edited, look(edited.gaussians, step), count


def _straddling(
    gaussians: Gaussians, sides: Sides, views: Sequence[View], options: CutOptions
) -> Selection:
    lesser = torch.minimum(sides.share, 1 - sides.share)
    mask = lesser >= max(options.min_side, 1e-6)
    mask &= sides.inside + sides.outside >= options.min_weight
    mask &= gaussians.scales.amax(dim=1) > 0
    rows = torch.nonzero(mask).squeeze(1)
    if options.min_pixels > 0 and len(rows):
        chosen = gaussians[rows]
        directions = unit_or_main(chosen, sides.direction[rows])
        size = seen_along(chosen, directions, [view.camera for view in views]).pixels
        mask[rows] = size >= options.min_pixels
    return Selection(mask=mask)


def _split(
    gaussians: Gaussians,
    straddling: Selection,
    sides: Sides,
    views: Sequence[View],
    options: CutOptions,
) -> Edited:
    return split_along(
        gaussians,
        straddling,
        sides.direction[straddling.mask],
        parts=options.parts,
        cameras=[view.camera for view in views],
    )


def _check_views(views: Sequence[View], evidence: LabelSource) -> None:
    if not views:
        raise InputError("views: expected at least one view that votes, got none.")
    known = set(evidence.view_names)
    missing = [view.name for view in views if view.name not in known]
    if missing:
        raise InputError(
            f"evidence: expected a label map of every view that votes, {len(missing)} of "
            f"{len(views)} have none, the first is {missing[0]}."
        )
