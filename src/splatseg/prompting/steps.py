"""The steps that clean a selection, joined: what each source needs of them.

Features match Gaussians one by one, so that what they select is thin and has specks: it is filtered
and grown as SAGA's section 3.5 says, by default with distances that one stray Gaussian does not
decide (`SelectionContext.post_processing`). Masks and layers have
memberships that were solved for through the pixels; of these only specks, holes and what no view
shows is left to mend.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatseg.core import LabelMap, Selection
from splatseg.lift.voting.segment_masses import view_masses
from splatseg.prompting.context import SelectionContext
from splatseg.prompting.filtering import statistical_filter
from splatseg.prompting.growing import ball_grow, region_grow
from splatseg.prompting.holes import complete_membership, holes, specks
from splatseg.prompting.next_click import NextClick, next_click
from splatseg.prompting.refine import refine

_IN = 0.501
"""What a Gaussian that a step brings in has at least."""

_OUT = 0.499
"""What one that a step takes out has at most."""

_INSIDE = 0.5
"""Share of what a view sees of a Gaussian that has to lie in its mask."""


def filtered(confidence: Float[Tensor, "n"], context: SelectionContext) -> Float[Tensor, "n"]:
    """Without outliers and specks."""
    mask = confidence > 0.5
    if context.source == "features":
        validated, excluded = _by_masks(context)
        if excluded is not None:
            mask &= ~excluded
        index = context.neighbours.index
        seeds = None if validated is None else validated & mask
        if seeds is not None and bool(seeds.any()):
            kept = region_grow(index, seeds, mask, context.post_processing.region)
        else:
            kept = statistical_filter(index, mask, context.post_processing.filtering)
        return _with_mask(confidence, kept)
    selection = Selection(mask=mask)
    clicked = context.pointed_at(positive=True) & selection
    return _with_mask(
        confidence, mask & ~specks(context.neighbours.graph, selection, clicked=clicked).mask
    )


def grown(confidence: Float[Tensor, "n"], context: SelectionContext) -> Float[Tensor, "n"]:
    """With what is as near to members as these are to each other, of features alone."""
    if context.source != "features":
        return confidence
    mask = confidence > 0.5
    _, excluded = _by_masks(context)
    growth = context.post_processing
    among = confidence > growth.joining
    if excluded is not None:
        among &= ~excluded
    kept = ball_grow(context.neighbours.index, mask, growth.balls, among=among)
    return _with_mask(confidence, kept)


def refined(confidence: Float[Tensor, "n"], context: SelectionContext) -> Float[Tensor, "n"]:
    """With a border where neighbours are least alike, of features alone."""
    if context.source != "features":
        return confidence
    inside = (context.pointed_at(positive=True) - context.pointed_at(positive=False)).ids
    outside = (context.pointed_at(positive=False) - context.pointed_at(positive=True)).ids
    return refine(
        context.neighbours.graph, confidence, inside=inside, outside=outside
    ).confidence.to(confidence)


def filled(confidence: Float[Tensor, "n"], context: SelectionContext) -> Float[Tensor, "n"]:
    """Without holes; what a negative prompt shows is none."""
    selection = Selection(mask=confidence > 0.5)
    found = holes(context.neighbours.graph, selection) - context.pointed_at(positive=False)
    return _with_mask(confidence, selection.mask | found.mask)


def completed(confidence: Float[Tensor, "n"], context: SelectionContext) -> Float[Tensor, "n"]:
    """With what the source knows nothing of and is inside; layers were completed when made."""
    if context.unseen is None or not bool(context.unseen.any()):
        return confidence
    return complete_membership(context.neighbours.graph, confidence, context.unseen).to(confidence)


def advised(confidence: Float[Tensor, "n"], context: SelectionContext) -> NextClick | None:
    """Where a click would settle most."""
    if not context.scene_views:
        return None
    return next_click(
        context.gaussians,
        context.scene_views,
        confidence,
        clicked=context.pointed_at(positive=True),
        rejected=context.pointed_at(positive=False),
        backend=context.views.backend,
    )


def _with_mask(confidence: Tensor, mask: Tensor) -> Tensor:
    """Confidences whose side of the border is that of a mask."""
    mask = mask.to(confidence.device)
    return torch.where(mask, confidence.clamp_min(_IN), confidence.clamp_max(_OUT)).where(
        mask != (confidence > 0.5), confidence
    )


def _by_masks(
    context: SelectionContext,
) -> tuple[Bool[Tensor, "n"] | None, Bool[Tensor, "n"] | None]:
    """Gaussians that the masks of prompts confirm, and those that they rule out.

    A Gaussian that a view sees belongs to its mask if most of what is seen of it lies inside. None
    where no prompt has a mask.
    """
    validated: Tensor | None = None
    excluded: Tensor | None = None
    for prompt in context.prompts:
        if prompt.inside is None or prompt.guessed:
            continue
        labels = LabelMap(ids=prompt.inside.to(torch.int32))
        found = view_masses(
            context.gaussians, prompt.view.camera, labels, backend=context.views.backend
        )
        own = found.segment == 1
        within = torch.zeros(len(context.gaussians))
        within[found.gaussian[own]] = found.weight[own]
        seen = found.visible > 0.05
        good = seen & (within >= _INSIDE * found.visible)
        bad = seen & (within < _INSIDE * found.visible)
        validated = good if validated is None else validated & good
        excluded = bad if excluded is None else excluded | bad
    return validated, excluded
