"""The default way from label maps to labels of Gaussians: votes, and relabelling."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from splatseg.core import ClassTable, Gaussians, Labels, LabelSource, View
from splatseg.lift.mass.confusion import DEFAULT_CONFUSION, ConfusionOptions, correct_confusion
from splatseg.lift.mass.uplift import UpliftOptions, uplift
from splatseg.render import RenderOptions

_CANDIDATES = 8
"""Ids of each Gaussian that relabelling chooses from."""


def lift_labels(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: LabelSource,
    *,
    options: UpliftOptions | None = None,
    confusion: ConfusionOptions | None = DEFAULT_CONFUSION,
    classes: ClassTable | None = None,
    render_options: RenderOptions | None = None,
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> Labels:
    """Label Gaussians by label maps: the method ``uplift``.

    The votes of `uplift`, relabelled by how often the evidence confuses ids
    (`correct_confusion`). `complete` labels what no view sees, after any method.

    Args:
        gaussians: The Gaussians of the scene.
        views: Those that vote: a method that is to be measured uses train views only.
        evidence: Their label maps, whose ids mean the same in all views.
        options: How votes become labels.
        confusion: How the evidence errs. None takes the ids with most votes, and so do rules
            other than ``share``.
        classes: Names of the ids, for the info.
        render_options: Switches of the blending model.
        backend: Name of the rendering backend.
        progress: Called with the views done and all there are to do.

    Returns:
        The layer; soft only if `options` ask for more than one candidate.

    Raises:
        InputError: If there are no views, if one has no label map, or no pixel has a label.
        ShapeError: If a label map does not have its photograph's proportions.
    """
    options = options or UpliftOptions()
    relabel = confusion is not None and options.label_rule == "share"
    hard = options.candidates < 2
    labels = uplift(
        gaussians,
        views,
        evidence,
        options=_with_candidates(options) if relabel and hard else options,
        classes=classes,
        render_options=render_options,
        backend=backend,
        progress=progress,
    )
    if relabel:
        labels = correct_confusion(
            labels, options=confusion, view_correlation=labels.info.view_correlation
        )
        if hard:
            labels = replace(labels, candidates=None, shares=None)
    return labels


def _with_candidates(options: UpliftOptions) -> UpliftOptions:
    """The same votes for a soft layer, as relabelling needs it."""
    return replace(options, candidates=_CANDIDATES, slots=max(options.slots, _CANDIDATES))
