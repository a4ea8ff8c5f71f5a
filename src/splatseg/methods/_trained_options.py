"""Switches that methods share which are trained on label maps."""

import math
from dataclasses import dataclass
from typing import Literal

from splatseg._check import check_choice, check_range
from splatseg.errors import RangeError
from splatseg.lift.training import Sampling, SamplingOptions, Schedule, TrainingOptions


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelTrainingOptions:
    """How a method is trained on label maps."""

    readout: Literal["hard", "rendered"] = "hard"
    """hard: the layer has each Gaussian's id. rendered: it has what was trained, with the
    classifier that reads it, by which views are rendered first and decided then."""

    steps: int = 1000
    """Steps of Adam at most."""

    batch: int = 4096
    """Pixels a step, from all views."""

    pixels: int = 4000
    """Labelled pixels of each view that are drawn at a time."""

    sampling: Sampling = "uniform"
    """uniform: all labelled pixels alike. groups: equally many of each id in a view. strata: one
    of each of as many equal parts of the picture."""

    passes: int = 4
    """How often drawn pixels are gone through before new ones are drawn; 0 draws once."""

    min_weight: float = 0.01
    """Blending weight in [0, 1] below which a Gaussian is left out of a pixel; 0 keeps all."""

    memory: int = 1 << 30
    """Bytes of drawn rows kept in memory; more go to temporary files."""

    schedule: Schedule = "cosine"
    """How rates fall: constant, exponential or cosine."""

    final_rate: float = 0.1
    """Share of the rates that is left at the last step."""

    held_out: float = 0.1
    """Share of the views that is not learnt from but scored, to stop in time; 0 holds out none
    and does all steps."""

    score_every: int = 100
    """Steps from one score to the next."""

    patience: int = 3
    """Scores in a row without a better one before training stops, and the best is kept; 0
    never stops."""

    min_share: float = 0.0
    """Least probability in [0, 1] that a Gaussian's winner needs; below it there is no label."""

    def __post_init__(self) -> None:
        check_choice("readout", self.readout, ("hard", "rendered"))
        self.training()
        self.drawing()
        check_range("min_share", self.min_share, 0.0, 1.0)

    def training(self) -> TrainingOptions:
        """How training goes."""
        return TrainingOptions(
            steps=self.steps,
            batch=self.batch,
            passes=self.passes,
            schedule=self.schedule,
            final_rate=self.final_rate,
            held_out=self.held_out,
            score_every=self.score_every,
            patience=self.patience,
        )

    def drawing(self) -> SamplingOptions:
        """Which pixels are drawn."""
        return SamplingOptions(
            pixels=self.pixels,
            sampling=self.sampling,
            min_weight=self.min_weight,
            memory=self.memory,
        )


def check_rate(name: str, value: float) -> None:
    """Refuse a rate or weight below 0.

    Raises:
        RangeError: If it is below 0 or not finite.
    """
    if not (math.isfinite(value) and value >= 0):
        raise RangeError(f"{name}: expected 0 or more, got {value}.")
