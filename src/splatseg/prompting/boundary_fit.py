r"""Fitting a selection to the rim of masks: Gaussians that straddle it are dropped or split.

A Gaussian straddles the rim of a mask where pixels on both sides show it. How much of it lies
outside is measured by blending weights, over the views that have a mask,

.. math:: o_i = \frac{\sum_{v, p \notin M_v} w_{pi}}{\sum_{v, p} w_{pi}}

so that what others hide of it does not count.

`trim` takes what reaches out of the selection and leaves the scene as it is. `split` replaces it
by parts that lie on one side each: the scene changes, so it returns the new Gaussians with the
selection over them.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool
from torch import Tensor

from splatseg._check import check_range
from splatseg.core import Edited, Gaussians, LabelMap, Selection, View
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.lift.boundaries.cut import INSIDE, OUTSIDE, CutOptions, cut_masks, sides_of


@dataclass(frozen=True, slots=True, kw_only=True)
class TrimOptions:
    """Which Gaussians reach too far out of a mask."""

    max_outside: float = 0.5
    """Largest share, in [0, 1], of what is seen of a selected Gaussian that may lie outside."""

    min_weight: float = 0.5
    """Minimum evidence in the views with masks, in fully visible pixels; a Gaussian with less
    stays."""

    border_weight: float = 0.1
    """Weight of a pixel at the rim of a mask, in [0, 1]: it shows both sides."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_range("max_outside", self.max_outside, 0.0, 1.0)
        check_range("border_weight", self.border_weight, 0.0, 1.0)
        if not (math.isfinite(self.min_weight) and self.min_weight >= 0):
            raise RangeError(f"min_weight: expected 0 or more, got {self.min_weight}.")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewMasks:
    """Masks of one thing in some views, as label maps of INSIDE and OUTSIDE."""

    masks: Mapping[str, Bool[Tensor, "height width"]] = field(repr=False)
    """By name of the view: True where a pixel shows the thing; of the view's proportions."""

    def __post_init__(self) -> None:
        for name, mask in self.masks.items():
            if mask.ndim != 2 or mask.dtype != torch.bool:
                raise InputError(
                    f"masks: expected booleans (height, width) of {name}, "
                    f"got {mask.dtype} {tuple(mask.shape)}."
                )

    @property
    def view_names(self) -> Sequence[str]:
        """Names of the views that have a mask."""
        return tuple(self.masks)

    def label_map(self, name: str) -> LabelMap:
        """INSIDE where the mask is set, OUTSIDE elsewhere."""
        return LabelMap(ids=torch.where(self.masks[name], INSIDE, OUTSIDE).int())


@boundary
def trim(
    gaussians: Gaussians,
    selection: Selection,
    views: Sequence[View],
    masks: ViewMasks,
    *,
    options: TrimOptions | None = None,
    backend: str = "auto",
) -> Selection:
    """Drop selected Gaussians that lie too much outside of masks.

    Args:
        gaussians: The Gaussians of the scene.
        selection: What to trim.
        views: Those whose masks count.
        masks: Where each of them shows the selected thing, all of it.
        options: What is too much.
        backend: Name of the rendering backend.

    Returns:
        The selection without them.

    Raises:
        ShapeError: If the selection is of other Gaussians, or a mask has not its view's
            proportions.
        InputError: If there are no views, or one has no mask.
    """
    options = options or TrimOptions()
    _check(gaussians, selection, views, masks)
    sides = sides_of(
        gaussians, views, masks, [INSIDE], border_weight=options.border_weight, backend=backend
    )
    seen = sides.inside + sides.outside
    out = (seen > 0) & (seen >= options.min_weight) & (1 - sides.share > options.max_outside)
    return Selection(mask=selection.mask.cpu() & ~out)


@boundary
def split(
    gaussians: Gaussians,
    selection: Selection,
    views: Sequence[View],
    masks: ViewMasks,
    *,
    options: CutOptions | None = None,
    backend: str = "auto",
) -> tuple[Edited, Selection]:
    """Split selected Gaussians that straddle the rim of masks, and keep the parts inside.

    Args:
        gaussians: The Gaussians of the scene.
        selection: What is fitted; only its Gaussians are split.
        views: Those whose masks count.
        masks: Where each of them shows the selected thing, all of it.
        options: Which are split, and how; a part is kept where more than `keep_share` of what is
            seen of it lies inside.
        backend: Name of the rendering backend.

    Returns:
        The edit, whose `gaussians` are the new ones and whose `rows` lead each to its old row;
        and the selection over them. Those that were not split stay selected.

    Raises:
        ShapeError: If the selection is of other Gaussians, or a mask has not its view's
            proportions.
        InputError: If there are no views, one has no mask, or no mask shows a Gaussian.
    """
    options = options or CutOptions()
    _check(gaussians, selection, views, masks)
    cut = cut_masks(
        gaussians, views, masks, [INSIDE], among=selection, options=options, backend=backend
    )
    rows = cut.edited.rows
    fractions = cut.edited.fractions
    part = torch.zeros(len(rows), dtype=torch.bool) if fractions is None else fractions < 1
    kept = ~part | cut.inside.mask | (cut.evidence <= 0)
    return cut.edited, Selection(mask=selection.mask.cpu()[rows] & kept)


def _check(
    gaussians: Gaussians, selection: Selection, views: Sequence[View], masks: ViewMasks
) -> None:
    if len(selection) != len(gaussians):
        raise ShapeError(f"selection: expected {len(gaussians)} rows, got {len(selection)}.")
    if not views:
        raise InputError("views: expected at least one view with a mask, got none.")
    missing = [view.name for view in views if view.name not in masks.masks]
    if missing:
        raise InputError(
            f"masks: expected one of every view, {len(missing)} of {len(views)} have none, "
            f"the first is {missing[0]}."
        )
