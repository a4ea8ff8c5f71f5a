"""Uplift as a method: every pixel votes for its label on the Gaussians it shows."""

from dataclasses import dataclass, field

from splatseg.core import Labels
from splatseg.lift.mass.confusion import ConfusionOptions
from splatseg.lift.mass.uplift import UpliftOptions
from splatseg.lift.pipeline import lift_labels
from splatseg.methods._method import Method, MethodInputs


@dataclass(frozen=True, slots=True, kw_only=True)
class UpliftMethodOptions:
    """Votes, and what corrects them."""

    votes: UpliftOptions = field(default_factory=UpliftOptions)
    """How votes become labels."""

    correct_confusion: bool = True
    """Relabel under how often the evidence takes one id for another, which finds small things
    that most views miss. Not with FlashSplat's rules."""

    confusion: ConfusionOptions = field(default_factory=ConfusionOptions)
    """How the evidence errs."""


def run(inputs: MethodInputs, options: UpliftMethodOptions) -> Labels:
    """Label Gaussians by votes of pixels, see `lift.pipeline.lift_labels`."""
    confusion = options.confusion if options.correct_confusion else None
    return lift_labels(
        inputs.gaussians,
        inputs.views,
        inputs.evidence,
        options=options.votes,
        confusion=confusion,
        classes=inputs.label_names,
        backend=inputs.backend,
        progress=inputs.progress,
    )


METHOD = Method(
    name="uplift",
    summary="every pixel votes for its id on the Gaussians it shows; one pass, memory bounded",
    reference="LUDVIG (Marrie et al. 2024), eq. 4; relabelling: Dawid and Skene (1979)",
    evidence=("labels", "tracked"),
    options=UpliftMethodOptions,
    run=run,
    keeps_ids=True,
    published=UpliftMethodOptions(correct_confusion=False),
)
