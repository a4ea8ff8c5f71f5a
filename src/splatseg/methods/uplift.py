"""Uplift as a method: pixels vote for their label, or give their features, to what they show."""

from collections.abc import Callable, Sequence
from dataclasses import field, replace

import torch

from splatseg.core import (
    LOCAL,
    Camera,
    ClassTable,
    Executor,
    Features,
    Gaussians,
    Labels,
    LabelSource,
    View,
    camera_of_map,
)
from splatseg.core.options import options
from splatseg.errors import InputError
from splatseg.lift.voting.confusion import (
    CANDIDATES,
    DEFAULT_CONFUSION,
    ConfusionOptions,
    correct_confusion,
)
from splatseg.lift.voting.features import FeatureUpliftOptions, uplift_features
from splatseg.lift.voting.more_votes import with_votes
from splatseg.lift.voting.uplift import UpliftOptions, uplift
from splatseg.methods._method import Method, MethodInputs


@options
class UpliftMethodOptions:
    """Votes, and what corrects them."""

    votes: UpliftOptions = field(default_factory=UpliftOptions)
    """How votes become labels."""

    correct_confusion: bool = True
    """Relabel under how often the evidence takes one id for another, which finds small things
    that most views miss. Not with FlashSplat's rules."""

    confusion: ConfusionOptions = field(default_factory=ConfusionOptions)
    """How the evidence errs."""


def lift_labels(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: LabelSource,
    *,
    options: UpliftOptions | None = None,
    confusion: ConfusionOptions | None = DEFAULT_CONFUSION,
    classes: ClassTable | None = None,
    backend: str = "auto",
    executor: Executor = LOCAL,
    progress: Callable[[int, int], None] | None = None,
) -> Labels:
    """Label Gaussians by label maps: the votes of `uplift`, relabelled by `correct_confusion`.

    Args:
        gaussians: The Gaussians of the scene.
        views: Those that vote: a method that is to be measured uses train views only.
        evidence: Their label maps, whose ids mean the same in all views.
        options: How votes become labels.
        confusion: How the evidence errs. None takes the ids with most votes, and so do rules
            other than ``share``.
        classes: Names of the ids, for the info.
        backend: Name of the rendering backend.
        executor: Where the views are worked on; the layer does not depend on it.
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
        options=options.with_candidates(CANDIDATES) if relabel and hard else options,
        classes=classes,
        backend=backend,
        executor=executor,
        progress=progress,
    )
    if not relabel:
        return labels
    correlation = labels.info.view_correlation
    labels = correct_confusion(labels, options=confusion, view_correlation=correlation)
    return replace(labels, candidates=None, shares=None) if hard else labels


def run(inputs: MethodInputs, options: UpliftMethodOptions) -> Labels:
    """Label Gaussians by votes of pixels, see `lift_labels`."""
    return lift_labels(
        inputs.gaussians,
        inputs.views,
        inputs.evidence,
        options=options.votes,
        confusion=options.confusion if options.correct_confusion else None,
        classes=inputs.label_names,
        backend=inputs.backend,
        executor=inputs.executor,
        progress=inputs.progress,
    )


def camera(inputs: MethodInputs, options: UpliftMethodOptions, view: View) -> Camera:
    """The camera of a view's label map."""
    del options  # each map is lifted as it is
    label_map = inputs.evidence.label_map(view.name)
    return camera_of_map(view, label_map.height, label_map.width)


def update(inputs: MethodInputs, options: UpliftMethodOptions, layer: Labels) -> Labels:
    """Add the votes of further views, see `with_votes`; the ids known are not relabelled again."""
    votes = uplift(
        inputs.gaussians,
        inputs.views,
        inputs.evidence,
        options=options.votes.with_candidates(CANDIDATES),
        classes=inputs.label_names,
        backend=inputs.backend,
        executor=inputs.executor,
        progress=inputs.progress,
    )
    names = {**votes.info.names, **layer.info.names}
    return with_votes(replace(layer, info=replace(layer.info, names=names)), votes)


METHOD = Method(
    name="uplift",
    summary="every pixel votes for its id on the Gaussians it shows; one pass, memory bounded",
    reference="LUDVIG (Marrie et al. 2024), eq. 4; relabelling: Dawid and Skene (1979)",
    evidence=("labels", "tracked"),
    options=UpliftMethodOptions,
    run=run,
    update=update,
    keeps_ids=True,
    published=UpliftMethodOptions(correct_confusion=False),
    camera=camera,
)


def run_features(inputs: MethodInputs, options: FeatureUpliftOptions) -> Features:
    """Lift feature maps, see `uplift_features`."""
    return uplift_features(
        inputs.gaussians,
        inputs.views,
        inputs.evidence,
        options=options,
        backend=inputs.backend,
        executor=inputs.executor,
        progress=inputs.progress,
    )


def update_features(
    inputs: MethodInputs, options: FeatureUpliftOptions, layer: Features
) -> Features:
    r"""Add the features of further views: weighted means, :math:`(w f + w' f') / (w + w')`."""
    if layer.weights is None:
        raise InputError("update: expected features with the weights they rest on, got none.")
    more = run_features(inputs, options)
    if more.values.shape[1] != layer.values.shape[1] or more.weights is None:
        raise InputError(
            f"update: expected {layer.values.shape[1]} channels as the layer has, got "
            f"{more.values.shape[1]}."
        )
    weights = layer.weights + more.weights
    sums = layer.values * layer.weights.unsqueeze(1) + more.values * more.weights.unsqueeze(1)
    values = sums / torch.where(weights > 0, weights, 1.0).unsqueeze(1)
    return replace(layer, values=values, weights=weights)


FEATURES = Method(
    name="features",
    summary="each Gaussian takes the mean of the features that its pixels show",
    reference="LUDVIG (Marrie et al. 2024), eq. 4",
    evidence=("features",),
    options=FeatureUpliftOptions,
    run=run_features,
    update=update_features,
    returns="features",
)
