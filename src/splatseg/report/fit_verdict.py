"""What a fit is good for, in a sentence: long enough, like its photographs, or not."""

from dataclasses import dataclass

from splatseg.evaluate.photographs import PhotographReport
from splatseg.fit import sensible_steps
from splatseg.report.words import counted

MIN_PSNR = 20.0
"""Renders less like the photographs than this, in dB, carry labels badly: in scenes of known truth
a fifth to two thirds of the mIoU of a longer fit was lost (``benchmarks/fit_length.py``, decision
0025)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FitVerdict:
    """What a fit is good for."""

    words: str
    """A word or two: ``Too short``."""

    sentence: str
    warns: bool
    """Whether something is to be done before labels are put on it."""

    too_short: bool
    """Whether it has fewer steps than make sense."""

    sensible_steps: int
    """How many make sense for so many training views."""


def fit_verdict(
    *,
    steps: int,
    train_views: int,
    interrupted: bool,
    scores: PhotographReport | None,
    held_out: int,
) -> FitVerdict:
    """Judge a fit by its length, and by its held-out views where there are scores.

    Args:
        steps: Steps done.
        train_views: Training views with photographs.
        interrupted: Whether it was stopped early.
        scores: Of held-out views.
        held_out: Held-out views there are, scored or not.
    """
    needed = sensible_steps(train_views)
    short = steps < needed
    of = "" if scores is None else _of(scores, held_out)
    if short:
        words = "Too short"
        onwards = "--resume goes on" if interrupted else f"--steps {needed} or more is"
        rest = " from here" if interrupted else " worth the time"
        sentence = (
            f"{counted(steps, 'step')} done, where {needed} or more make sense for "
            f"{counted(train_views, 'training view')}; {onwards}{rest}.{of}"
        )
    elif scores is not None and scores.psnr < MIN_PSNR:
        words = "Poor"
        sentence = (
            f"Renders are less like the photographs than the {MIN_PSNR:g} dB from which labels "
            f"hold: too few photographs, wrong poses or moving things, see the worst views.{of}"
        )
    elif scores is None:
        words = "Not judged"
        sentence = "Long enough, but no held-out view was scored."
    else:
        words = "Good enough to carry labels"
        sentence = of.strip()
    poor = scores is not None and scores.psnr < MIN_PSNR
    return FitVerdict(
        words=words,
        sentence=sentence,
        warns=short or poor,
        too_short=short,
        sensible_steps=needed,
    )


def _of(scores: PhotographReport, held_out: int) -> str:
    worst = min(scores.per_view, key=lambda score: score.psnr)
    mean = f" PSNR {scores.psnr:.2f} dB, SSIM {scores.ssim:.3f} on {scored_of(scores, held_out)}"
    return f"{mean}; the worst, {worst.name}, has {worst.psnr:.2f} dB."


def scored_of(scores: PhotographReport, held_out: int) -> str:
    """Of how many views scores are: ``12 held-out views``, ``5 of 12 held-out views``."""
    if len(scores.views) == held_out:
        return counted(held_out, "held-out view")
    return f"{len(scores.views)} of {counted(held_out, 'held-out view')}"
