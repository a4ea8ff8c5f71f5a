r"""Cuts: Gaussians that reach over a boundary are split, so that each side can go its own way.

A boundary is that of masks in the photographs (`cut_masks` for some ids, `cut_labels` for a
whole layer) or a box in the world (`cut_box`). A Gaussian straddles it if its lesser side has
at least `CutOptions.min_side`: of the evidence that masks give, or of the Gaussian's mass
beyond a plane. It is split in the direction that separates the two sides best (`sides`,
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
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.lift.boundaries.geometry import (
    line_extent,
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
    """Minimum share, in [0, 0.5], of the lesser side for a Gaussian to straddle the cut."""

    min_pixels: float = 0.5
    """Minimum standard deviation, pixels, that a Gaussian must have across the cut in some view;
    smaller ones are not split. 0 splits all."""

    min_weight: float = 0.5
    """Minimum evidence that a Gaussian must have to be split at a mask, in pixels that show it
    fully, summed over views."""

    border_weight: float = 0.1
    """Weight of a pixel at the border of a mask, in [0, 1]: it shows both sides."""

    keep_share: float = 0.5
    """Share of its evidence, in [0, 1], that must lie inside for a Gaussian to count as inside.
    Less takes more of what is near the boundary."""

    def __post_init__(self) -> None:
        convert_fields(self)
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

    evidence: Float[Tensor, "n"]
    """What the share rests on: evidence in fully visible pixels, or 1 for a box."""

    inside: Selection
    """Those that count as inside."""

    split: int
    """How many Gaussians of before were split."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _InsideOutsideMaps:
    """Label maps in which some ids are INSIDE and all others OUTSIDE."""

    evidence: LabelSource
    ids: tuple[int, ...]

    @property
    def view_names(self) -> Sequence[str]:
        return self.evidence.view_names

    def label_map(self, name: str) -> LabelMap:
        label_map = self.evidence.label_map(name)
        inside = torch.isin(label_map.ids, torch.tensor(self.ids, dtype=label_map.ids.dtype))
        sides = torch.where(inside, INSIDE, OUTSIDE)
        return replace(
            label_map, ids=torch.where(label_map.ids == UNLABELLED, UNLABELLED, sides).int()
        )


@boundary
def cut_masks(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: LabelSource,
    ids: Sequence[int],
    *,
    among: Selection | None = None,
    options: CutOptions | None = None,
    render_options: RenderOptions | None = None,
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> Cut:
    """Split what straddles the boundary between the pixels of some ids and all others.

    Args:
        gaussians: The Gaussians of the scene.
        views: Those that vote, best all that the layer was lifted from.
        evidence: Label maps of them; pixels at -1 do not count.
        ids: The ids that are inside.
        among: Only these are split; None is all.
        options: Which are split, and how.
        render_options: Switches of the blending model.
        backend: Name of the rendering backend.
        progress: Called with the views done and all there are to do.

    Returns:
        The cut. A Gaussian is inside where its share of the evidence is more than
        `CutOptions.keep_share`.

    Raises:
        InputError: If there are no views or ids, or no view shows any of the ids.
        ShapeError: If `among` is of other Gaussians.
    """
    options = options or CutOptions()
    if among is not None and len(among) != len(gaussians):
        raise ShapeError(f"among: expected {len(gaussians)} rows, got {len(among)}.")
    _check_views(views, evidence)
    if not ids:
        raise InputError("ids: expected at least one, got none.")
    label_maps = _InsideOutsideMaps(evidence=evidence, ids=tuple(int(i) for i in ids))
    scan = _Scan(
        views,
        label_maps,
        options,
        render_options=render_options,
        backend=backend,
        progress=progress,
    )
    edited, sides, count = _split_in_rounds(gaussians, scan, among)
    if not bool((sides.inside > 0).any()):
        shown = ", ".join(map(str, ids))
        raise InputError(f"ids: none of {len(views)} views shows a Gaussian with id {shown}.")
    return Cut(
        edited=edited,
        share=sides.share,
        evidence=sides.inside + sides.outside,
        inside=Selection(mask=sides.share > options.keep_share),
        split=count,
    )


@boundary
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
        backend: Name of the rendering backend.
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
    scan = _Scan(
        views, evidence, options, render_options=render_options, backend=backend, progress=progress
    )
    rows = torch.arange(len(gaussians))
    edited, current = Edited.unchanged(gaussians), labels
    for round_index in range(options.rounds + 1):
        first, second = candidates[rows, 0], candidates[rows, 1]
        sides = scan.sides(edited.gaussians, first, second)
        current = _relabelled(current, sides, first, second, edited)
        if round_index == options.rounds:
            break
        straddling = scan.straddling(edited.gaussians, sides)
        if not straddling.count:
            break
        further = scan.split(edited.gaussians, straddling, sides)
        edited, current = edited.then(further), apply_rows(current, further)
        rows = edited.rows
    return edited, current


def _relabelled(
    labels: Labels, sides: Sides, first: Tensor, second: Tensor, edited: Edited
) -> Labels:
    """The layer with the labels of parts, the rows whose fraction is below 1, from their pixels."""
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


def _split_in_rounds(
    gaussians: Gaussians, scan: "_Scan", among: Selection | None
) -> tuple[Edited, Sides, int]:
    """Measure, split, measure again; ends with a measurement of what came out."""
    edited, count = Edited.unchanged(gaussians), 0
    for round_index in range(scan.options.rounds):
        sides = scan.inside_outside(edited.gaussians)
        straddling = scan.straddling(edited.gaussians, sides)
        if among is not None:
            straddling = straddling & among[edited.rows]
        if round_index == 0:
            count = straddling.count
        if not straddling.count:
            return edited, sides, count
        edited = edited.then(scan.split(edited.gaussians, straddling, sides))
    return edited, scan.inside_outside(edited.gaussians), count


class _Scan:
    """Goes through the views to measure sides, and splits what straddles them.

    Progress counts the views of all rounds.
    """

    def __init__(
        self,
        views: Sequence[View],
        evidence: LabelSource,
        options: CutOptions,
        *,
        render_options: RenderOptions | None,
        backend: str,
        progress: Callable[[int, int], None] | None,
    ) -> None:
        self.options = options
        self._views = views
        self._evidence = evidence
        self._render_options = render_options
        self._backend = backend
        self._progress = progress
        self._done = 0

    def sides(self, gaussians: Gaussians, first: Tensor, second: Tensor) -> Sides:
        """How much of each Gaussian the views show with its first and its second id."""
        return sides_of(
            gaussians,
            self._views,
            self._evidence,
            first,
            second,
            border_weight=self.options.border_weight,
            options=self._render_options or options_for(gaussians, self._backend),
            backend=self._backend,
            step=self._step,
        )

    def inside_outside(self, gaussians: Gaussians) -> Sides:
        """The same for label maps of INSIDE and OUTSIDE."""
        ones = torch.ones(len(gaussians), dtype=torch.int32)
        return self.sides(gaussians, ones * INSIDE, ones * OUTSIDE)

    def straddling(self, gaussians: Gaussians, sides: Sides) -> Selection:
        """Gaussians with enough evidence on both sides that are large enough to be split."""
        lesser = torch.minimum(sides.share, 1 - sides.share)
        mask = lesser >= max(self.options.min_side, 1e-6)
        mask &= sides.inside + sides.outside >= self.options.min_weight
        mask &= gaussians.scales.amax(dim=1) > 0
        rows = torch.nonzero(mask).squeeze(1)
        if self.options.min_pixels > 0 and len(rows):
            chosen = gaussians[rows]
            directions = unit_or_main(chosen, sides.direction[rows])
            size = line_extent(chosen, directions, self._cameras()).pixels
            mask[rows] = size >= self.options.min_pixels
        return Selection(mask=mask)

    def split(self, gaussians: Gaussians, straddling: Selection, sides: Sides) -> Edited:
        """Split along the directions that separate the sides."""
        return split_along(
            gaussians,
            straddling,
            sides.direction[straddling.mask],
            parts=self.options.parts,
            cameras=self._cameras(),
        )

    def _cameras(self) -> list[Camera]:
        return [view.camera for view in self._views]

    def _step(self) -> None:
        self._done += 1
        if self._progress is not None:
            self._progress(self._done, (self.options.rounds + 1) * len(self._views))


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
